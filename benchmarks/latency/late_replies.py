"""A thousand mixed reads over RTU from a slave that replies 0.8 s late now and then, at a time limit of 0.5 s.

The slave is the libmodbus PLC of the shared peers, at rest, on a pseudo-terminal; every register holds a value of its
own, so a late reply that is taken for the reply to another request shows as a wrong value: their count must be 0.

    python benchmarks/latency/late_replies.py [reads [share of late replies]]
"""

import asyncio
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from numpy.random import default_rng

from autotuner.errors import LinkError
from autotuner_drivers.modbus import create

PEERS = Path(__file__).parents[3] / "shared" / "peers"
TRUTH = {"pv": 80.0, "applied": 30.0, "set_point": 50.0, "kp": 1.5, "ti": 20.0, "td": 0.25, "output": 30.0, "auto": 0.0}
REGISTERS = {
    "pv": {"table": "input", "address": 0, "scale": 0.1},
    "applied": {"table": "input", "address": 1, "scale": 0.1},
    "output": {"table": "holding", "address": 0, "scale": 0.1},
    "set_point": {"table": "holding", "address": 1, "scale": 0.1},
    "kp": {"table": "holding", "address": 10, "type": "float32"},
    "ti": {"table": "holding", "address": 12, "type": "float32"},
    "td": {"table": "holding", "address": 14, "type": "float32"},
    "auto": {"table": "coil", "address": 0},
}


def main():
    reads = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    late = float(sys.argv[2]) if len(sys.argv) > 2 else 0.3
    with tempfile.TemporaryDirectory() as folder:
        port = Path(folder) / "ttyPLC"
        command = [
            sys.executable, PEERS / "plc_libmodbus.py", "--rtu-link", port, "--unit", 7, "--baud", 9600,
            "--parity", "E", "--plant", 2, 10, 1.5, "--u0", 30, "--own-pid", 1.5, 20, 0.25, "--control", 0,
        ]  # fmt: skip
        plc = subprocess.Popen([str(word) for word in command], stdout=subprocess.PIPE, text=True)  # noqa: S603 - our own
        try:
            control = json.loads(plc.stdout.readline())["control"]
            values, errors, wrong, took_s = asyncio.run(mixed(port, control, reads, late))
        finally:
            plc.terminate()
            plc.wait()
            plc.stdout.close()
    print(f"{reads} reads, {late:.0%} of the requests answered 0.8 s late, time limit 0.5 s: {took_s:.0f} s")
    print(f"values {values}, timeouts {errors}, values of another register {len(wrong)} {wrong[:5]}")


async def mixed(port, control, reads, late):
    random = default_rng(1)
    reader, writer = await asyncio.open_connection("127.0.0.1", control)

    async def tell(line):
        writer.write(line.encode() + b"\n")
        await reader.readline()

    options = {
        "transport": "rtu",
        "serial_port": str(port),
        "baudrate": 9600,
        "unit": 7,
        "timeout_s": 0.5,
        "retries": 0,
    }
    loop = create(options | {"registers": REGISTERS})
    await loop.open()
    clock = asyncio.get_running_loop().time
    started, values, errors, wrong = clock(), 0, 0, []
    for _ in range(reads):
        name = list(TRUTH)[random.integers(len(TRUTH))]
        await tell("fault slow=0.8 0.02" if random.random() < late else "clear")
        try:
            seen = (await loop.read([name]))[name]
        except LinkError:
            errors += 1
            continue
        values += 1
        if abs(seen - TRUTH[name]) > 0.001:
            wrong.append(f"{name} read {seen}")
    await loop.close()
    writer.close()
    await writer.wait_closed()
    return values, errors, wrong, clock() - started


if __name__ == "__main__":
    main()
