"""What a Modbus TCP line of 200 ms each way costs: one request after another, and overlapping.

    python benchmarks/latency/slow_line.py [--delay 0.2] [--seconds 10]

The device is a PLC on libmodbus (../shared/peers/plc_libmodbus.py). The line delays every byte by the same time without
holding back the next ones, as a long cable or a satellite does. Printed is what `autotuner probe` reports.
"""

import argparse
import asyncio
import contextlib
import json
import subprocess
import sys
from pathlib import Path

from autotuner_drivers.modbus import create
from autotuner_drivers.testing.probe import judge, probe

PEER = Path(__file__).parents[3] / "shared" / "peers" / "plc_libmodbus.py"
REGISTERS = {
    "pv": {"table": "input", "address": 0, "scale": 0.1},
    "output": {"table": "holding", "address": 0, "scale": 0.1},
    "set_point": {"table": "holding", "address": 1, "scale": 0.1},
    "kp": {"table": "holding", "address": 10, "type": "float32"},
    "ti": {"table": "holding", "address": 12, "type": "float32"},
    "auto": {"table": "coil", "address": 0},
}


class DelayLine:
    """Forwards one device's connections; every byte arrives `delay_s` later."""

    def __init__(self, port, delay_s):
        self._port, self._delay_s = port, delay_s

    async def serve(self, reader, writer):
        far_reader, far_writer = await asyncio.open_connection("127.0.0.1", self._port)
        await asyncio.gather(self.forward(reader, far_writer), self.forward(far_reader, writer))

    async def forward(self, reader, writer):
        loop = asyncio.get_running_loop()
        with contextlib.suppress(OSError, asyncio.CancelledError):
            while data := await reader.read(65536):
                loop.call_later(self._delay_s, writer.write, data)
            await asyncio.sleep(self._delay_s)
        writer.close()


async def measure(port, args):
    line = await asyncio.start_server(DelayLine(port, args.delay).serve, "127.0.0.1", 0)
    async with line:
        there = {"host": "127.0.0.1", "port": line.sockets[0].getsockname()[1], "timeout_s": 5.0}
        for overlap in (1, 2, 4):
            backend = create(there | {"registers": REGISTERS, "overlap": overlap})
            report = judge(await probe(backend, args.seconds))
            print(
                f"overlap {overlap}: a reading of four requests lasts {report.took_median_s:.3f} s (median of "
                f"{report.readings}), sample time {report.sample_time_s:.2g} s, {backend.repeated} repeated"
            )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--delay", type=float, default=0.2)
    parser.add_argument("--seconds", type=float, default=10.0)
    args = parser.parse_args()
    words = [sys.executable, str(PEER), "--tcp", "0", "--plant", "2", "10", "1.5"]
    plc = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)  # noqa: S603
    try:
        asyncio.run(measure(json.loads(plc.stdout.readline())["tcp"], args))
    finally:
        plc.kill()
        plc.wait()


if __name__ == "__main__":
    main()
