"""Shared by the tests of the drivers: a scripted device, other people's peers as processes."""

import asyncio
import contextlib
import itertools
import json
import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest

PEERS = Path(__file__).parent / "peers"
"""Devices on other people's libraries, for the tests alone."""

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


PORTS = (20_000 + (97 * os.getpid() + k) % 12_000 for k in itertools.count())
"""Ports below 32768, where Linux begins to give ports to whoever names none; other systems begin higher."""


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


@pytest.fixture
def peers():
    """The folder of devices on other people's libraries."""
    return PEERS


@pytest.fixture
def node_peer(tmp_path):
    """Return a function that starts a peer on Node.js and returns its ready line, or skips without its package.

    Packages are looked for as Node.js does: npm install --prefix FOLDER node-opcua; NODE_PATH=FOLDER/node_modules.
    """
    with contextlib.ExitStack() as running:

        def start(script, package, *arguments):
            if shutil.which("node") is None:
                pytest.skip("node is not installed")
            resolve = ["node", "-e", f"require.resolve('{package}')"]
            if subprocess.run(resolve, check=False, capture_output=True).returncode:
                pytest.skip(f"the package {package} is not installed for node")
            process = subprocess.Popen(
                [*REAL_TIME, "node", str(PEERS / script), *map(str, arguments)],
                env={**os.environ, "PKI_FOLDER": str(tmp_path / "pki")},
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
            )
            running.callback(_end, process)
            line = next(line for line in process.stdout if line.startswith("{"))
            return json.loads(line) | {"process": process}

        yield start


@pytest.fixture(scope="session")
def certificate(tmp_path_factory):
    """A certificate for `plc.test` and `localhost`, signed by itself, and its key."""
    return make_certificate(tmp_path_factory.mktemp("tls"))


@pytest.fixture(scope="session")
def another_certificate(tmp_path_factory):
    """The same for the same names, of another authority."""
    return make_certificate(tmp_path_factory.mktemp("tls-other"))


def make_certificate(folder):
    """Return a certificate that is signed by itself, and its key."""
    openssl = shutil.which("openssl")
    if openssl is None:
        pytest.skip("openssl is not installed")
    made = subprocess.run(
        [
            openssl, "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=plc.test",
            "-addext", "subjectAltName=DNS:plc.test,DNS:localhost",
            "-keyout", folder / "key.pem", "-out", folder / "cert.pem",
        ],
        capture_output=True,
        check=False,
    )  # fmt: skip
    if made.returncode:
        pytest.skip(f"openssl makes no certificate here: {made.stderr!r}")
    return folder / "cert.pem", folder / "key.pem"


@pytest.fixture
def free_port():
    """A port on which nobody listens.

    It is below those that a system gives to whoever names none, so nobody gets it before it is used; each process of
    the tests begins elsewhere.
    """
    return next(filter(_is_free, PORTS))


def _is_free(port):
    with socket.socket() as probe, contextlib.suppress(OSError):
        probe.bind(("127.0.0.1", port))
        return True
    return False


def _end(process):
    process.terminate()
    try:
        process.wait(5.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    for pipe in (process.stdin, process.stdout, process.stderr):
        if pipe is not None:
            pipe.close()
