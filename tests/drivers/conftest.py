"""Shared by the tests of the drivers: virtual time, a scripted device, other people's peers as processes."""

import asyncio
import contextlib
import json
import subprocess
import sys
from pathlib import Path

import async_solipsism
import pytest

PEERS = Path(__file__).parents[2].parent / "shared" / "peers"

MAP = {
    "pv": {"table": "input", "address": 0, "type": "int16", "scale": 0.1},
    "applied": {"table": "input", "address": 1, "type": "int16", "scale": 0.1},
    "heartbeat": {"table": "input", "address": 2, "type": "uint16"},
    "output": {"table": "holding", "address": 0, "type": "int16", "scale": 0.1},
    "set_point": {"table": "holding", "address": 1, "type": "int16", "scale": 0.1},
    "kp": {"table": "holding", "address": 10, "type": "float32"},
    "ti": {"table": "holding", "address": 12, "type": "float32"},
    "td": {"table": "holding", "address": 14, "type": "float32"},
    "auto": {"table": "coil", "address": 0},
}


@pytest.fixture
def default_map():
    """The map of `autotuner plc` and of the libmodbus peer."""
    return MAP


@pytest.fixture
def virtual():
    """Return a function that runs a coroutine on a loop whose clock jumps to the next timer."""

    def run(main):
        async def checked():
            result = await main
            await asyncio.sleep(1.0)
            left = asyncio.all_tasks() - {asyncio.current_task()}
            assert not left, f"tasks left behind: {left}"
            return result

        with asyncio.Runner(loop_factory=async_solipsism.EventLoop) as runner:
            return runner.run(checked())

    return run


class ScriptedDevice:
    """A Modbus TCP server that answers as a test says.

    `script(device, frame, writer)` is awaited for every request; `frame` is the whole request with its header.
    """

    def __init__(self, script):
        self.script = script
        self.requests = []
        self.connections = 0

    @contextlib.asynccontextmanager
    async def serving(self, port=1502):
        server = await asyncio.start_server(self._serve, "device", port)
        try:
            yield self
        finally:
            server.close()
            await server.wait_closed()

    async def _serve(self, reader, writer):
        self.connections += 1
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            while True:
                header = await reader.readexactly(6)
                frame = header + await reader.readexactly(int.from_bytes(header[4:6], "big"))
                self.requests.append(frame)
                await self.script(self, frame, writer)
        writer.close()


def reply(frame: bytes, pdu: bytes) -> bytes:
    """Return the answer `pdu` under the header of a request."""
    return frame[:4] + (len(pdu) + 1).to_bytes(2, "big") + frame[6:7] + pdu


@pytest.fixture
def scripted_device():
    return ScriptedDevice


@pytest.fixture
def peer():
    """Return a function that starts one of the shared peers and returns its ready line."""
    with contextlib.ExitStack() as running:

        def start(script, *arguments):
            path = PEERS / script
            if not path.exists():
                pytest.skip(f"the shared peers are absent: {path}")
            process = subprocess.Popen(
                [sys.executable, str(path), *map(str, arguments)],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
            running.callback(_end, process)
            line = process.stdout.readline()
            if not line:
                pytest.skip(f"{script} does not start here: {process.stderr.read().strip()}")
            return json.loads(line)

        yield start


def _end(process):
    process.terminate()
    try:
        process.wait(5.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    process.stdout.close()
    process.stderr.close()
