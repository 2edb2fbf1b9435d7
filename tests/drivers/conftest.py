"""Shared by the tests of the drivers: a scripted device, other people's peers as processes."""

import asyncio
import contextlib
import json
import os
import shutil
import subprocess
import sys

import pytest

REAL_TIME = ("chrt", "--fifo", "20") if os.name == "posix" and os.geteuid() == 0 and shutil.which("chrt") else ()
"""A peer's plant falls behind the clock on a busy machine, unless it runs as a real PLC does."""

MAP = {
    "pv": {"table": "input", "address": 0, "type": "int16", "scale": 0.1},
    "applied": {"table": "input", "address": 1, "type": "int16", "scale": 0.1},
    "scans": {"table": "input", "address": 2, "type": "uint16"},
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


class ScriptedDevice:
    """A Modbus TCP server that answers as a test says.

    `script(device, frame, writer)` is awaited for every request; `frame` is the whole request with its header.
    """

    def __init__(self, script):
        self.script = script
        self.requests = []
        self.connections = 0
        self._clients = {}

    @contextlib.asynccontextmanager
    async def serving(self, port=1502):
        server = await asyncio.start_server(self._serve, "device", port)
        try:
            yield self
        finally:
            server.close()
            for task in self._clients:
                task.cancel()
            await asyncio.gather(*self._clients, return_exceptions=True)
            for writer in self._clients.values():
                writer.close()
            await asyncio.sleep(0.01)

    def hang_up(self):
        """Close every connection."""
        for writer in self._clients.values():
            writer.close()

    async def _serve(self, reader, writer):
        self.connections += 1
        self._clients[asyncio.current_task()] = writer
        with contextlib.suppress(asyncio.IncompleteReadError, asyncio.CancelledError, ConnectionError):
            while True:
                header = await reader.readexactly(6)
                frame = header + await reader.readexactly(int.from_bytes(header[4:6], "big"))
                self.requests.append(frame)
                await self.script(self, frame, writer)


@pytest.fixture
def scripted_device():
    return ScriptedDevice


@pytest.fixture
def peer(shared):
    """Return a function that starts one of the shared peers and returns its ready line."""
    with contextlib.ExitStack() as running:

        def start(script, *arguments):
            process = subprocess.Popen(
                [*REAL_TIME, sys.executable, str(shared / "peers" / script), *map(str, arguments)],
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
