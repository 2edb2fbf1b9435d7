"""How soon the loss of a device is decided upon, and its output put back once the device is there again.

    python benchmarks/safety/peer_loss.py [--runs N] [--away S]

A Modbus TCP device (`autotuner plc`) in a process of its own, behind a relay in another one that forwards its bytes, is
driven by a relay test. At a random moment of a sample period the relay closes the connection, by FIN, by RST, or by
being killed (SIGKILL), and takes no new one for a while. The moment is taken on the system's clock before the close.

ours      a tuning: until it has decided to end and to give the loop back, and from the moment at which connections are
          taken again to its first attempt that is answered
pymodbus  its own client with the defaults, asked for a register once a period: until its call has failed
limit     a bare asyncio transport: until its `connection_lost`
"""

import argparse
import asyncio
import contextlib
import json
import logging
import random
import socket
import statistics
import subprocess
import sys
import time
from pathlib import Path

from pymodbus.client import AsyncModbusTcpClient
from pymodbus.exceptions import ModbusException

from autotuner.application.computing.compute_pool import InPlace
from autotuner.application.tuning_run import TuningRequest, TuningRun
from autotuner.configuration import parse_configuration
from autotuner.control.devices.plugins import make_backend

PERIOD_S = 0.1
ENDS = ("FIN", "RST", "killed")


class Forwarder:
    """What stands before the device, in a process of its own."""

    def __init__(self, target):
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        file = Path(__file__).with_name("_forwarder.py")
        self._command = [sys.executable, "-S", str(file), str(self.port), str(target)]
        self.begin()

    def begin(self):
        """Start it; return the moment from which it takes connections."""
        self._process = subprocess.Popen(self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)  # noqa: S603
        self._process.stdout.readline()
        return time.monotonic()

    def end(self, how):
        """End the connection, and take no new one; return the moment."""
        moment_s = time.monotonic()
        if how == "killed":
            self._process.kill()
        else:
            self._process.stdin.write(f"{how}\n")
            self._process.stdin.flush()
            moment_s = float(self._process.stdout.readline())
        self.close()
        return moment_s

    def close(self):
        self._process.kill()
        self._process.communicate()


def loop_table(port):
    registers = {
        "pv": {"table": "input", "address": 0, "type": "int16", "scale": 0.1},
        "output": {"table": "holding", "address": 0, "type": "int16", "scale": 0.1},
    }
    table = {
        "driver": "modbus",
        "sample_time_s": PERIOD_S,
        "limits": {"output": [0.0, 100.0]},
        "relay": {"amplitude": 10.0, "quiet_s": 2.0},
        "device": {"host": "127.0.0.1", "port": port, "registers": registers},
    }
    return parse_configuration({"loops": {"loop": table}}, "bench").loop("loop")


class Noted(TuningRun):
    """A tuning that notes the moment of each event."""

    def publish(self, event):
        self.__dict__.setdefault("noted", []).append((asyncio.get_running_loop().time(), event))
        TuningRun.publish(self, event)


async def ours(forwarder, how, away_s):
    """Return the time to the decision, and from the return of the device to the restored output, s."""
    await asyncio.sleep(4.0)  # the process comes to rest after the run before
    loop = loop_table(forwarder.port)
    tuning = Noted("T", "loop", TuningRequest(loop.experiment_settings()))
    work = asyncio.create_task(tuning.conduct(loop, make_backend("modbus", loop.device, "loop"), InPlace()))
    async for event in tuning.follow():
        assert event.type != "ended", event
        if event.type == "sample" and event.output != tuning.before.output:
            break
    await asyncio.sleep(random.uniform(0.0, PERIOD_S))  # noqa: S311 - no secret
    lost_s = await asyncio.to_thread(forwarder.end, how)
    await asyncio.sleep(away_s)
    back_s = await asyncio.to_thread(forwarder.begin)
    verdict = await work
    assert verdict.code == "device_gone", verdict
    decided_s = next(moment_s for moment_s, event in tuning.noted if event.type == "phase" and event.phase == "restore")
    restored_s = next(moment_s for moment_s, event in tuning.noted if event.type == "restored")
    return decided_s - lost_s, restored_s - back_s


async def theirs(forwarder, how, _away_s):
    client = AsyncModbusTcpClient("127.0.0.1", port=forwarder.port)
    await client.connect()
    lost = asyncio.create_task(_until_failed(client))
    await asyncio.sleep(1.0 + random.uniform(0.0, PERIOD_S))  # noqa: S311 - no secret
    lost_s = await asyncio.to_thread(forwarder.end, how)
    noticed_s = await lost
    client.close()
    await asyncio.to_thread(forwarder.begin)
    return noticed_s - lost_s, None


async def _until_failed(client):
    loop, answered = asyncio.get_running_loop(), True
    with contextlib.suppress(ModbusException):
        while answered:
            due_s = loop.time() + PERIOD_S
            answered = not (await client.read_input_registers(0, count=1)).isError()
            await asyncio.sleep(due_s - loop.time() if answered else 0.0)
    return loop.time()


async def bare(forwarder, how, _away_s):
    lost = asyncio.get_running_loop().create_future()

    class Watch(asyncio.Protocol):
        def connection_lost(self, _error):
            lost.set_result(asyncio.get_running_loop().time())

    transport, _ = await asyncio.get_running_loop().create_connection(Watch, "127.0.0.1", forwarder.port)
    await asyncio.sleep(0.2)
    lost_s = await asyncio.to_thread(forwarder.end, how)
    noticed_s = await lost
    transport.close()
    await asyncio.to_thread(forwarder.begin)
    return noticed_s - lost_s, None


WAYS = {"pymodbus": theirs, "ours": ours, "limit": bare}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=10, help="of each way and each kind of loss, in turns (10)")
    parser.add_argument("--away", type=float, default=3.0, help="for how long the device is away, s (3)")
    args = parser.parse_args()
    logging.disable()  # the losses are wanted
    command = [sys.executable, "-m", "autotuner", "plc", "--port", "0", "--plant", "K=2", "T=0.5", "D=0.2"]
    command += ["--noise", "0"]
    plc = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)  # noqa: S603 - ourselves
    forwarder = Forwarder(json.loads(plc.stdout.readline())["port"])
    found = {(name, how): [] for how in ENDS for name in WAYS}
    try:
        for _ in range(args.runs):
            for (name, how), rows in found.items():
                with asyncio.Runner() as runner:
                    rows.append(runner.run(WAYS[name](forwarder, how, args.away)))
    finally:
        forwarder.close()
        plc.terminate()
        plc.wait()
    times = f"{'decided after, ms':>19} {'largest':>8}  {'restored after, ms':>18} {'largest':>8}"
    print(f"{'loss by':8} {'':9} {'runs':>4} {times}")
    for (name, how), rows in found.items():
        decided = [1e3 * row[0] for row in rows]
        line = f"{how:8} {name:9} {len(rows):4} {statistics.median(decided):19.2f} {max(decided):8.2f}"
        restored = [1e3 * row[1] for row in rows if row[1] is not None]
        print(line + (f"  {statistics.median(restored):18.0f} {max(restored):8.0f}" if restored else ""))


if __name__ == "__main__":
    main()
