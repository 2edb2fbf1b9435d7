"""What a Modbus loop costs: tens to hundreds of them in one process, at 10 Hz, on devices of their own and on few.

    python benchmarks/scale/many_loops.py [--loops N ...] [--devices M ...] [--write-every C] [--seconds S]

A loop reads PV and output once a period, through the Modbus driver and the ticker, and writes the output when it
changes, as `autotuner.control.driving.lease` does: here every tenth period, a relay with a half period of 1 s. The
loops of one device share its connection; their periods begin together, and devices are spread over the period. The
server answers at once, in a process of its own. Printed: processor time of the loops' process as a share of one core
and by cycle, and the time from a deadline to the end of its cycle. The limit is the same exchange of bytes over bare
asyncio streams, one connection and one request for each loop. Both have what keeps deadlines in a loop process
(`autotuner.control.clock.real_time`). Each on Python's usual event loop, and on `uvloop` where it is installed.
"""

import argparse
import asyncio
import importlib
import importlib.util
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from autotuner.control.clock.real_time import PERIOD_S as LOOKED_AFTER_S
from autotuner.control.clock.real_time import Upkeep, fine_timers
from autotuner.control.clock.ticker import Stop, Ticker
from autotuner.control.driving.lease import ticker_of
from autotuner_drivers.modbus import create

PERIOD_S = 0.1
LOOPS_OF_A_DEVICE = 50
EVENT_LOOPS = {"usual": asyncio.new_event_loop}
if importlib.util.find_spec("uvloop"):
    EVENT_LOOPS["uvloop"] = importlib.import_module("uvloop").new_event_loop
READ, WRITE = bytes.fromhex("000100000006010300000002"), bytes.fromhex("000200000006010600010007")


class Ours:
    """Loop `number` of its device: two registers of its own."""

    def __init__(self, port, device, number, alone):
        registers = {
            name: {"table": "holding", "address": 2 * number + k, "scale": 0.1}
            for k, name in enumerate(("pv", "output"))
        }
        connection = "own" if alone else "shared"
        options = {"host": "127.0.0.1", "port": port, "unit": device % 256, "connection": connection}
        self._device = create(options | {"registers": registers})

    async def open(self):
        await self._device.open()

    def ticker(self):
        return ticker_of(self._device, PERIOD_S)

    async def cycle(self, writing):
        await self._device.read(("pv", "output"))
        if writing:
            await self._device.write({"output": 0.7})

    async def close(self):
        await self._device.close()


class Bare:
    def __init__(self, port, _device, _number, _alone):
        self._port = port

    async def open(self):
        self._reader, self._writer = await asyncio.open_connection("127.0.0.1", self._port)

    def ticker(self):
        return Ticker(PERIOD_S)

    async def cycle(self, writing):
        self._writer.write(READ)
        await self._reader.readexactly(13)
        if writing:
            self._writer.write(WRITE)
            await self._reader.readexactly(12)

    async def close(self):
        self._writer.close()
        await self._writer.wait_closed()


@dataclass(frozen=True)
class Plant:
    """So many loops on so many devices, of which each writes once in so many cycles."""

    port: int
    loops: int
    devices: int
    write_every: int

    def made(self, kind):
        """Return the loops, those of one device one after another."""
        of_one = -(-self.loops // self.devices)
        return [kind(self.port, k // of_one, k % of_one, self.devices == self.loops) for k in range(self.loops)]

    def writes(self, loop, cycle):
        """Return whether a loop writes in a cycle: in every one as many as in any other."""
        return (loop + cycle) % self.write_every == 0


async def flat_out(kind, plant, cycles):
    """Return processor time by cycle, s, of loops that begin a cycle as soon as the last one has ended."""
    loops = plant.made(kind)

    async def drive(number, loop):
        for cycle in range(cycles):
            await loop.cycle(plant.writes(number, cycle))

    for loop in loops:
        await loop.open()
    begun = time.process_time()
    await asyncio.gather(*(drive(*pair) for pair in enumerate(loops)))
    spent_s = time.process_time() - begun
    for loop in loops:
        await loop.close()
    return spent_s / (plant.loops * cycles)


async def driven(kind, plant, seconds):
    """Return processor time, s, and the times from deadline to end of all cycles, s."""
    with fine_timers():
        return await _driven(kind, plant, seconds)


async def _driven(kind, plant, seconds):
    loops, stop, took_s = plant.made(kind), Stop(), []

    async def drive(number, loop, delay_s):
        await asyncio.sleep(delay_s)
        ticker, cycle = loop.ticker(), 0
        while (tick := await ticker.tick(stop)) is not None:
            await loop.cycle(plant.writes(number, cycle))
            took_s.append(ticker.now_s - tick.t + tick.lateness_s)
            cycle += 1

    async def collect():
        while not await stop.wait(LOOKED_AFTER_S):
            upkeep.look(busy=True)

    for loop in loops:
        await loop.open()
    upkeep = Upkeep(awake=False)
    upkeep.look(busy=True)
    tasks = [asyncio.create_task(drive(k, loop, PERIOD_S * k / plant.loops)) for k, loop in enumerate(loops)]
    tasks.append(asyncio.create_task(collect()))
    await asyncio.sleep(3.0 * PERIOD_S)
    took_s.clear()
    begun = time.process_time()
    await asyncio.sleep(seconds)
    spent_s, kept = time.process_time() - begun, list(took_s)
    stop.set()
    await asyncio.gather(*tasks)
    upkeep.look(busy=False)
    for loop in loops:
        await loop.close()
    return spent_s, kept


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--loops", type=int, nargs="+", default=[10, 30, 100, 300, 1000])
    parser.add_argument("--devices", type=int, nargs="+", help="by default a device for each loop, and one for each 50")
    parser.add_argument("--write-every", type=int, default=10, metavar="CYCLES", help="cycles from write to write")
    parser.add_argument("--on", nargs="+", choices=EVENT_LOOPS, default=list(EVENT_LOOPS), help="event loops")
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--flat-out", type=int, metavar="CYCLES", help="no period: processor time of so many cycles")
    args = parser.parse_args()
    file = Path(__file__).with_name("_quick_plc.py")
    plc = subprocess.Popen([sys.executable, str(file)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)  # noqa: S603
    port = int(plc.stdout.readline())
    plants = [
        Plant(port, loops, devices, args.write_every)
        for loops in args.loops
        for devices in args.devices or sorted({loops, max(loops // LOOPS_OF_A_DEVICE, 1)}, reverse=True)
    ]
    try:
        compare_costs(plants, args) if args.flat_out else drive_all(plants, args)
    finally:
        plc.communicate()


def compare_costs(plants, args):
    """Print processor time by cycle; other programs on the machine change it little."""
    print(f"{'loops':>5} {'devices':>8} {'':6} {'driver':>8} {'limit':>8}, us a cycle")
    for plant in plants:
        for on in args.on:
            costs = []
            for kind in (Ours, Bare):
                with asyncio.Runner(loop_factory=EVENT_LOOPS[on]) as runner:
                    costs.append(1e6 * runner.run(flat_out(kind, plant, args.flat_out)))
            print(f"{plant.loops:5} {plant.devices:8} {on:6} {costs[0]:8.0f} {costs[1]:8.0f}", flush=True)


def drive_all(plants, args):
    """Print what loops at 10 Hz cost, and when their cycles are done."""
    head = f"{'core':>7} {'us a cycle':>11} {'cycles lost':>12} {'done p50':>9} {'p99, ms':>9}"
    print(f"{'loops':>5} {'devices':>8} {'':13} {head}")
    for plant in plants:
        for on in args.on:
            for name, kind in (("driver", Ours), ("limit", Bare)):
                with asyncio.Runner(loop_factory=EVENT_LOOPS[on]) as runner:
                    spent_s, took_s = runner.run(driven(kind, plant, args.seconds))
                p50, p99 = 1e3 * np.percentile(took_s, (50.0, 99.0))
                lost = max(1.0 - len(took_s) * PERIOD_S / (plant.loops * args.seconds), 0.0)
                share, us = spent_s / args.seconds, 1e6 * spent_s / len(took_s)
                print(
                    f"{plant.loops:5} {plant.devices:8} {on:6} {name:6} {share:7.1%} {us:11.0f} {lost:12.1%} "
                    f"{p50:9.2f} {p99:9.2f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
