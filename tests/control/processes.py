"""Programs of ours as processes, a PLC with a plant among them, a line to it, and waiting for what they do."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace

from pyModbusTCP.client import ModbusClient

from autotuner.control.records.journal import Journal

REST = 40.0
PATIENCE_S = 300.0
"""Longest wait for a process to do what it must; nothing is asserted of how long it took.

A computation of 5 s takes 100 s where other programs use the processors as well.
"""
POLL_S = 0.02
"""Time between two looks at another process: half the requests that a service takes from one client, 100/s."""
ANSWER_S = 60.0
"""Longest wait for an answer of the PLC, the longest there is: who is stopped meanwhile shall find others waiting."""
REGISTERS = """pv = {{ table = "input", address = 0, type = "int16", scale = 0.1 }}
output = {{ table = "holding", address = 0, type = "int16", scale = 0.1 }}
auto = {{ table = "coil", address = 0 }}
"""
"""Registers of the simulated PLC that every tuning needs; braces doubled, for a text that is formatted."""
CONTROLLER_REGISTERS = """set_point = {{ table = "holding", address = 1, type = "int16", scale = 0.1 }}
kp = {{ table = "holding", address = 10, type = "float32" }}
ti = {{ table = "holding", address = 12, type = "float32" }}
td = {{ table = "holding", address = 14, type = "float32" }}
"""
"""Those of its own controller."""
CONFIGURATION = """
[service]
port = 0
data_directory = "{folder}/data"

[loops.TIC-101]
driver = "modbus"
own_process = true
sample_time_s = 0.02
limits = {{ output = [0.0, 100.0], pv = [-100.0, 300.0] }}
relay = {{ amplitude = 10.0, quiet_s = 0.5, {relay} }}
safety = {{ max_lateness_s = {patience_s}, pv_timeout_s = {patience_s} }}

[loops.TIC-101.device]
host = "127.0.0.1"
port = {port}
timeout_s = {answer_s}

[loops.TIC-101.device.registers]
"""
OF_ITS_CONTROLLER = """
[loops.TIC-101.gains]
form = "ideal"
derivative_filter = 8.0
scan_s = 0.05
"""
"""How the gains of the PLC's own controller are to be read."""


def spawn(stack, *words, **keys):
    """Start `autotuner ...`; it is killed at the end of the test if it still lives."""
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **keys}
    process = subprocess.Popen([sys.executable, "-m", "autotuner", *words], text=True, **streams)
    stack.callback(process.communicate)
    stack.callback(process.kill)
    return process


def until(condition):
    """Wait for what another process does."""
    deadline = time.monotonic() + PATIENCE_S  # noqa: TID251 - other processes live on the wall clock
    while not (seen := condition()):
        assert time.monotonic() < deadline, "it did not happen"  # noqa: TID251
        time.sleep(POLL_S)  # noqa: TID251
    return seen


def plc_with_plant(stack, folder, *, auto=False, relay="min_periods = 12", gains=None):
    """Start a simulated PLC, with a client that looks at it and the configuration of its loop, kept in a folder.

    Its own controller is part of the configuration where it has gains.
    """
    mode = ["--auto"] if auto else []
    words = ["--plant", "K=2", "T=1", "D=0.2", "--output0", str(REST), "--gains", *(gains or ["0", "0", "0"])]
    plc = spawn(stack, "plc", "--port", "0", *words, *mode)
    port = json.loads(plc.stdout.readline())["port"]
    client = ModbusClient(host="127.0.0.1", port=port, auto_open=True, timeout=ANSWER_S)
    stack.callback(client.close)
    config = folder / "loops.toml"
    text = CONFIGURATION + REGISTERS + (CONTROLLER_REGISTERS + OF_ITS_CONTROLLER if gains else "")
    config.write_text(text.format(folder=folder, port=port, relay=relay, patience_s=PATIENCE_S, answer_s=ANSWER_S))
    return SimpleNamespace(
        process=plc,
        config=str(config),
        output=lambda: client.read_holding_registers(0, 1)[0] / 10.0,
        auto=lambda: client.read_coils(0, 1)[0],
        set_point=lambda: client.read_holding_registers(1, 1)[0] / 10.0,
        gains=lambda: client.read_holding_registers(10, 6),
        journal=Journal(folder / "data"),
        port=port,
        text=text,
    )


@contextlib.contextmanager
def full_pipe():
    """The writing end of a full pipe that nobody reads: standard error under a supervisor that stands still."""
    reading, writing = os.pipe()
    try:
        os.set_blocking(writing, False)
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(writing, bytes(4096))
        os.set_blocking(writing, True)
        yield writing
    finally:
        os.close(reading)
        os.close(writing)


@contextlib.contextmanager
def port_of_nobody():
    """A port on loopback at which nobody listens, and that nobody else can have meanwhile."""
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        yield held.getsockname()[1]


def children_of(process):
    """The processes that a process has started: workers, and the loop process."""
    lists = Path(f"/proc/{process.pid}/task").glob("*/children")
    return [int(number) for one in lists for number in one.read_text().split()]


def loop_process_of(service):
    """The process that drives the loops of a service that computes nothing: its only child but Python's own tracker."""
    (one,) = [n for n in children_of(service) if b"resource_tracker" not in Path(f"/proc/{n}/cmdline").read_bytes()]
    return one


def lives(number):
    """Whether a process runs; one that has ended may wait for whoever adopted it, without a command line."""
    with contextlib.suppress(FileNotFoundError):
        return bool(Path(f"/proc/{number}/cmdline").read_bytes())
    return False


def kill_all(process):
    """End a program with all that it has started, as the end of a container does."""
    for number in [*children_of(process), process.pid]:
        os.kill(number, signal.SIGKILL)
    process.wait()


class Line:
    """A Modbus TCP line to a PLC that keeps back one write, or the answer to it, and lets all pass behind `mend`.

    What it keeps back is lost unless it lets go of it.

    Parameters
    ----------
    port : int
        The port of the PLC.
    keeps_back : callable
        Whether a write is the one, by the address of its first register and by its bytes.
    arrives : bool
        Whether the PLC gets the write, and only the answer is kept back.

    Attributes
    ----------
    port : int
        Where it listens.
    kept_back : threading.Event
        Set when it is; whoever sent the write waits for an answer.
    """

    def __init__(self, port, keeps_back, *, arrives=False):
        self._plc, self._keeps_back, self._arrives = port, keeps_back, arrives
        self._whole, self._silent, self._pass_on = False, False, None
        self.kept_back = threading.Event()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._ends, self._threads = [], []
        self._begin(self._listen)

    def lead(self, plc):
        """Have the configuration of a PLC's loop name this line."""
        config = Path(plc.config)
        config.write_text(config.read_text().replace(f"port = {self._plc}", f"port = {self.port}"))

    def keep_back(self):
        """Keep back that write again from now on."""
        self._whole = False
        self.kept_back.clear()

    def mend(self):
        """Let everything pass from now on."""
        self._whole = True

    def let_go(self):
        """Pass on what was kept back."""
        self._pass_on()

    def close(self):
        """Hang up."""
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for end in self._ends:
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join()
        for end in self._ends:
            end.close()

    def _begin(self, work, *args):
        thread = threading.Thread(target=work, args=args)
        self._threads.append(thread)
        thread.start()

    def _listen(self):
        with contextlib.suppress(OSError):
            while True:
                ours = self._listener.accept()[0]
                self._ends.append(ours)
                theirs = socket.create_connection(("127.0.0.1", self._plc))  # of a dead one nobody is let in any more
                self._ends.append(theirs)
                self._begin(self._carry, ours, theirs, self._passes)
                self._begin(self._carry, theirs, ours, self._passes_back)

    def _carry(self, source, sink, passes):
        with contextlib.suppress(OSError):
            while data := source.recv(4096):  # a client sends one request at a time
                if passes(data):
                    sink.sendall(data)
                else:
                    self._pass_on = partial(sink.sendall, data)
                    self.kept_back.set()
            sink.shutdown(socket.SHUT_WR)

    def _passes(self, request):
        words = {6: request[10:], 16: request[13:]}.get(request[7])
        if self._whole or words is None or not self._keeps_back(int.from_bytes(request[8:10], "big"), words):
            return True
        self._silent = self._arrives
        return self._arrives

    def _passes_back(self, _answer):
        return self._whole or not self._silent
