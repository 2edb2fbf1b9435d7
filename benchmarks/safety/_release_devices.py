"""The devices of the release bench, each a program of another maker that is watched beside ours: a PLC and a board.

`Plc` answers `get` on a control port of its own. `Board` speaks TCLab on a pseudo-terminal; between it and the command
lies `socat`, which writes down every byte: its log shows the heater that the board reported.
"""

import contextlib
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections import deque

PERIOD_S = 0.04
"""Time between two looks at a device, s."""
SET_POINT, REST = 80.0, 40.0
OLD_GAINS = (0.5, 3.0, 0.0)
SLOW = "fault slow=0.4 60"
"""What holds a write of gains long enough that an end comes before its answer."""


def started(command):
    """Start a peer; return it and its first line."""
    words = [sys.executable, *map(str, command)]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)  # noqa: S603 - the user names it
    return process, json.loads(process.stdout.readline())


def state_of(told):
    """Return output, mode and gains of an answer of the PLC."""
    return told["u_cmd"], bool(told["auto"]), tuple(told[name] for name in ("kp", "ti", "td"))


class Plc:
    """A PLC with a lag of 3 s behind 0.4 s, at rest at an output of 40, watched through its control port.

    `seen` has rows of time, true PV, output, mode and gains.
    """

    def __init__(self, peer, _folder, scan_s, auto):
        self.seen = []
        self._command = [peer, "--plant", 2, 3, 0.4, "--scan", scan_s, "--noise", 0.05, "--u0", REST, "--ubias", REST]
        self._command += ["--y0", SET_POINT, "--sp", SET_POINT, "--own-pid", *OLD_GAINS, *(["--auto"] if auto else [])]
        self._process, ready = started([*self._command, "--tcp", 0, "--control", 0])
        self.port, self._control = ready["tcp"], ready["control"]
        self._ended = False
        threading.Thread(target=self._watch, daemon=True).start()

    def settle(self):
        """Be watched at rest."""
        time.sleep(1.0)

    def ask(self, line):
        """Return the answer of the control port to a line."""
        with socket.create_connection(("127.0.0.1", self._control), timeout=5.0) as link:
            link.sendall(f"{line}\n".encode())
            return json.loads(link.makefile().readline())

    def cut(self, seconds):
        self.ask(f"fault refuse {seconds}")

    def silence(self, seconds):
        self.ask(f"fault silent {seconds}")

    def reboot(self, seconds):
        self.ask(f"fault reboot {seconds}")

    def die(self, seconds):
        """Be killed, and be started again with the values of its first start."""
        self._process.kill()
        self._process.communicate()
        time.sleep(seconds)
        self._process, _ = started([*self._command, "--tcp", self.port, "--control", self._control])

    def hold_up(self):
        """Answer slowly from now on."""
        self.ask(SLOW)

    def state(self):
        """Return output, mode, gains and set point; only Modbus tells the set point."""
        self.ask("clear")
        time.sleep(1.0)
        told = self.ask("get")
        with socket.create_connection(("127.0.0.1", self.port), timeout=5.0) as link:
            link.sendall(struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, 1, 1))
            point = struct.unpack(">h", link.makefile("rb").read(11)[-2:])[0] / 10.0
        return (*state_of(told), point)

    def _watch(self):
        while not self._ended:
            with contextlib.suppress(OSError, ValueError):
                self._look()
            time.sleep(PERIOD_S)

    def _look(self):
        with socket.create_connection(("127.0.0.1", self._control), timeout=1.0) as link:
            answers = link.makefile()
            while not self._ended:
                link.sendall(b"get\n")
                told = json.loads(answers.readline())
                self.seen.append((time.monotonic(), told["y_true"], *state_of(told)))
                time.sleep(PERIOD_S)

    def close(self):
        self._ended = True
        self._process.kill()
        self._process.communicate()


class Board:
    """A board with a heater behind a serial line, at rest at 40 %, watched through what its line carries."""

    def __init__(self, peer, folder, _scan_s, _auto):
        self.seen, self._far, self.port = [], folder / "tty-board", folder / "tty"
        self._peer = [peer, "--protocol", "tclab", "--plant", 2, 1.5, 0.3, "--y0", 0, "--noise", 0.05]
        self._peer += ["--link", self._far]
        self._log = folder / "line.log"
        self._asked, self._pv, self._output = deque(), 0.0, REST
        self._ended = False
        self._process, _ = started(self._peer)
        self._connect()
        threading.Thread(target=self._watch, daemon=True).start()
        self._say("Q1 40")

    def _connect(self):
        self.port.unlink(missing_ok=True)
        self._asked.clear()
        with self._log.open("a") as log:
            near = f"PTY,link={self.port},raw,echo=0"
            words = ["socat", "-x", near, f"FILE:{self._far},raw,echo=0"]
            self._line = subprocess.Popen(words, stderr=log)  # noqa: S603 - our own words
        while not self.port.exists():
            time.sleep(0.01)

    def settle(self):
        """Come to rest, and be asked for the PV there."""
        time.sleep(10.0)
        for _ in range(5):
            self._say("T1")

    def _say(self, text):
        line = os.open(self.port, os.O_RDWR | os.O_NOCTTY)
        os.write(line, f"{text}\r".encode())
        time.sleep(0.1)
        os.close(line)

    def _disconnect(self):
        self._line.kill()
        self._line.wait()

    def cut(self, seconds):
        self._disconnect()
        self.port.unlink(missing_ok=True)
        time.sleep(seconds)
        self._connect()

    def silence(self, seconds):
        self._line.send_signal(signal.SIGSTOP)
        time.sleep(seconds)
        self._line.send_signal(signal.SIGCONT)

    def die(self, seconds):
        """Lose its supply; the heater is off afterwards."""
        self._disconnect()
        self._process.kill()
        self._process.communicate()
        self.port.unlink(missing_ok=True)
        self._output = 0.0
        time.sleep(seconds)
        self._process, _ = started(self._peer)
        self._connect()

    def state(self):
        """Ask the board for its heater, when nobody else does any more."""
        self._say("R1")
        time.sleep(0.3)
        return self._output, False, OLD_GAINS, SET_POINT

    def _watch(self):
        unread = {"<": "", ">": ""}
        with self._log.open() as log:
            mark, text = "<", ""
            while not self._ended:
                text += log.read()
                *lines, text = text.split("\n")
                for line in lines:
                    if line[:1] in unread:
                        mark = line[0]
                    else:
                        said = unread[mark] + bytes.fromhex(line).decode("ascii", "replace")
                        *whole, unread[mark] = said.replace("\r", "\n").split("\n")
                        self._take(mark, [words for words in map(str.split, whole) if words])
                time.sleep(PERIOD_S)

    def _take(self, mark, lines):
        """Take what went to the board, or its answers: what it says of `T1`, `R1` and `Q1` is what it is."""
        for words in lines:
            if mark == ">":
                self._asked.append(words[0].upper())
            elif self._asked:
                self._hear(self._asked.popleft(), words[0])
        self.seen.append((time.monotonic(), self._pv, self._output, False, OLD_GAINS))

    def _hear(self, asked, answer):
        with contextlib.suppress(ValueError):
            if asked in {"Q1", "R1"}:
                self._output = float(answer)
            elif asked == "T1":
                self._pv = float(answer)

    def close(self):
        self._ended = True
        for process in (self._line, self._process):
            process.kill()
            process.wait()
