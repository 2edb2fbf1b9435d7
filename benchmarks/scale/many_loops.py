"""What a Modbus loop costs: tens to hundreds of them in one process, each with its own connection, at 10 Hz.

    python benchmarks/scale/many_loops.py [--loops N ...] [--seconds S]

A loop reads PV and output and writes the output, once a period, through the Modbus driver and the ticker; all loops are
spread over the period. The server answers at once, in a process of its own. Printed: processor time of the loops'
process as a share of one core and by cycle, and the time from a deadline to the end of its cycle. The limit is the same
exchange of bytes over bare asyncio streams. Both have what keeps deadlines in a loop process
(`autotuner.control.clock.real_time`). Each on Python's usual event loop, and on `uvloop` where it is installed.
"""

import argparse
import asyncio
import importlib
import importlib.util
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from autotuner.control.clock.real_time import PERIOD_S as LOOKED_AFTER_S
from autotuner.control.clock.real_time import Upkeep, fine_timers
from autotuner.control.clock.ticker import Stop, Ticker
from autotuner_drivers.modbus import create

PERIOD_S = 0.1
EVENT_LOOPS = {"usual": asyncio.new_event_loop}
if importlib.util.find_spec("uvloop"):
    EVENT_LOOPS["uvloop"] = importlib.import_module("uvloop").new_event_loop
REGISTERS = {
    "pv": {"table": "holding", "address": 0, "scale": 0.1},
    "output": {"table": "holding", "address": 1, "scale": 0.1},
}
READ, WRITE = bytes.fromhex("000100000006010300000002"), bytes.fromhex("000200000006010600010007")


class Ours:
    def __init__(self, port):
        self._device = create({"host": "127.0.0.1", "port": port, "registers": REGISTERS})

    async def open(self):
        await self._device.open()

    async def cycle(self):
        await self._device.read(("pv", "output"))
        await self._device.write({"output": 0.7})

    async def close(self):
        await self._device.close()


class Bare:
    def __init__(self, port):
        self._port = port

    async def open(self):
        self._reader, self._writer = await asyncio.open_connection("127.0.0.1", self._port)

    async def cycle(self):
        self._writer.write(READ)
        await self._reader.readexactly(13)
        self._writer.write(WRITE)
        await self._reader.readexactly(12)

    async def close(self):
        self._writer.close()
        await self._writer.wait_closed()


async def flat_out(kind, port, count, cycles):
    """Return processor time by cycle, s, of loops that begin a cycle as soon as the last one has ended."""
    devices = [kind(port) for _ in range(count)]

    async def drive(device):
        for _ in range(cycles):
            await device.cycle()

    for device in devices:
        await device.open()
    begun = time.process_time()
    await asyncio.gather(*map(drive, devices))
    spent_s = time.process_time() - begun
    for device in devices:
        await device.close()
    return spent_s / (count * cycles)


async def driven(kind, port, count, seconds):
    """Return processor time, s, and the times from deadline to end of all cycles, s."""
    with fine_timers():
        return await _driven(kind, port, count, seconds)


async def _driven(kind, port, count, seconds):
    devices, stop, took_s = [kind(port) for _ in range(count)], Stop(), []

    async def drive(device, delay_s):
        await asyncio.sleep(delay_s)
        ticker = Ticker(PERIOD_S)
        while (tick := await ticker.tick(stop)) is not None:
            await device.cycle()
            took_s.append(ticker.now_s - tick.t + tick.lateness_s)

    async def collect():
        while not await stop.wait(LOOKED_AFTER_S):
            upkeep.look(busy=True)

    for device in devices:
        await device.open()
    upkeep = Upkeep(awake=False)
    upkeep.look(busy=True)
    driving = [asyncio.create_task(drive(device, PERIOD_S * k / count)) for k, device in enumerate(devices)]
    driving.append(asyncio.create_task(collect()))
    await asyncio.sleep(2.0 * PERIOD_S)
    took_s.clear()
    begun = time.process_time()
    await asyncio.sleep(seconds)
    spent_s, kept = time.process_time() - begun, list(took_s)
    stop.set()
    await asyncio.gather(*driving)
    upkeep.look(busy=False)
    for device in devices:
        await device.close()
    return spent_s, kept


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--loops", type=int, nargs="+", default=[10, 30, 100, 300, 1000])
    parser.add_argument("--on", nargs="+", choices=EVENT_LOOPS, default=list(EVENT_LOOPS), help="event loops")
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--flat-out", type=int, metavar="CYCLES", help="no period: processor time of so many cycles")
    args = parser.parse_args()
    file = Path(__file__).with_name("_quick_plc.py")
    plc = subprocess.Popen([sys.executable, str(file)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)  # noqa: S603
    port = int(plc.stdout.readline())
    try:
        compare_costs(port, args) if args.flat_out else drive_all(port, args)
    finally:
        plc.communicate()


def compare_costs(port, args):
    """Print processor time by cycle; other programs on the machine change it little."""
    print(f"{'loops':>5} {'':6} {'driver':>8} {'limit':>8}, us a cycle")
    for count in args.loops:
        for on in args.on:
            costs = []
            for kind in (Ours, Bare):
                with asyncio.Runner(loop_factory=EVENT_LOOPS[on]) as runner:
                    costs.append(1e6 * runner.run(flat_out(kind, port, count, args.flat_out)))
            print(f"{count:5} {on:6} {costs[0]:8.0f} {costs[1]:8.0f}")


def drive_all(port, args):
    print(f"{'loops':>5} {'':13} {'core':>7} {'us a cycle':>11} {'cycles lost':>12} {'done p50':>9} {'p99, ms':>9}")
    for count in args.loops:
        for on in args.on:
            for name, kind in (("driver", Ours), ("limit", Bare)):
                with asyncio.Runner(loop_factory=EVENT_LOOPS[on]) as runner:
                    spent_s, took_s = runner.run(driven(kind, port, count, args.seconds))
                p50, p99 = 1e3 * np.percentile(took_s, (50.0, 99.0))
                lost = max(1.0 - len(took_s) * PERIOD_S / (count * args.seconds), 0.0)
                share, us = spent_s / args.seconds, 1e6 * spent_s / len(took_s)
                print(f"{count:5} {on:6} {name:6} {share:7.1%} {us:11.0f} {lost:12.1%} {p50:9.2f} {p99:9.2f}")


if __name__ == "__main__":
    main()
