"""Commands of the tuner as forks of one program that has imported them: they start at once.

A start of `autotuner` imports for more than a second of processor time, and a test on the wall clock starts several.
The template is a program without threads and without an event loop; each command is a fork of it that runs
`python -m autotuner WORD ...`. Only the imports are shared: the command has its own folder, environment, session and
files, is a child of the caller, and ends as every Python program does. Tests of the start itself use `subprocess`.
"""

import ctypes
import functools
import gc
import importlib
import json
import os
import runpy
import signal
import socket
import subprocess
import sys
from pathlib import Path

SET_CHILD_SUBREAPER = 36
"""Number of `prctl` for "children of an ended child become mine", see prctl(2)."""
MOST_BYTES = 1 << 20
"""Longest request: words and environment."""
ADOPTED = b"adopted"
"""Answer once the process between the template and a command has ended, which makes the command the caller's."""
USUAL = {signal.SIGINT: signal.default_int_handler, signal.SIGHUP: signal.SIG_DFL}
"""Signals that a program ignores if its starter does, and how Python handles them otherwise."""
MODULES = (
    "autotuner.cli",
    "autotuner.commands.tuning",
    "autotuner.service.serve",
    "autotuner_drivers.modbus.backend",
    "autotuner_drivers.simulated",
    "autotuner_sim.plc_command",
)
"""Modules that the template imports."""


TEMPLATE = []
"""The running template, while a test needs it: see the fixture `template`."""


class Forked(subprocess.Popen):
    """A `Popen` of `python -m autotuner WORD ...` whose process is forked from the template."""

    def _execute_child(self, args, executable, preexec_fn, close_fds, pass_fds, cwd, env, *others):
        files = {1: others[6], 2: others[8]}  # of the new program, -1: those of the template
        request = {
            "words": args,
            "cwd": str(cwd or Path.cwd()),
            "env": dict(os.environ if env is None else env),
            "session": others[-2],
            "files": [number for number, file in files.items() if file != -1],
            "ignored": [number for number in USUAL if signal.getsignal(number) is signal.SIG_IGN],
        }
        self.pid = TEMPLATE[0].fork(request, [file for file in files.values() if file != -1])
        self._child_created = True
        self._close_pipe_fds(*others[3:9])


class Template:
    """The program that is forked; it ends with this one, or with its line."""

    def __init__(self):
        self._line, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            program = [sys.executable, "-P", __file__, str(theirs.fileno())]
            self._process = subprocess.Popen(program, stdin=subprocess.DEVNULL, pass_fds=[theirs.fileno()])

    def fork(self, request, files):
        """Return the process number of a command, which is made a child of this process."""
        adopt = functools.partial(ctypes.CDLL(None).prctl, SET_CHILD_SUBREAPER)
        adopt(1, 0, 0, 0)
        try:
            socket.send_fds(self._line, [json.dumps(request).encode()], files)
            number = int(self._line.recv(MOST_BYTES))
            assert self._line.recv(MOST_BYTES) == ADOPTED
            return number
        finally:
            adopt(0, 0, 0, 0)

    def close(self):
        """End it."""
        self._line.close()
        self._process.wait()


def serve(line):
    """Fork a command for each request; return the request and the files of the command in its process."""
    while True:
        data, files, _, _ = socket.recv_fds(line, MOST_BYTES, 2)
        if not data:
            sys.exit()
        if (between := os.fork()) == 0:
            if (child := os.fork()) == 0:
                return json.loads(data), files
            line.send(str(child).encode())
            os._exit(0)
        os.waitpid(between, 0)
        line.send(ADOPTED)
        for file in files:
            os.close(file)


def become(request, files):
    """Run a command as its own program would."""
    if request["session"]:
        os.setsid()
    for number, file in zip(request["files"], files, strict=True):
        os.dup2(file, number)
        os.close(file)
    sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115 - open to the end of the program
    sys.stderr = open(2, "w", buffering=1, closefd=False, errors="backslashreplace")  # noqa: SIM115
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["env"])
    for number, usual in USUAL.items():
        signal.signal(number, signal.SIG_IGN if number in request["ignored"] else usual)
    sys.argv = ["autotuner", *request["words"]]
    runpy.run_module("autotuner", run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    for module in MODULES:
        importlib.import_module(module)
    gc.freeze()
    with socket.socket(fileno=int(sys.argv[1])) as own:
        told = serve(own)
    become(*told)
