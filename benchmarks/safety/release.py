"""How a loop is released at every end of every operation, judged at the registers of a PLC of another maker.

The PLC is a program of its own whose Modbus side shares no code with ours: a command that takes `--tcp`, `--control`,
`--plant`, `--scan`, `--noise`, `--auto`, `--own-pid` and `--sp`, and answers `get` on its control port with one JSON
line. The end comes in the middle of the operation: in the relay, in the verification, between a write of gains and its
answer, or at the first operating point of a schedule. Set point and gains are judged wherever they may be written.

    python benchmarks/safety/release.py --peer PLC.py [--scan 0.05] [--operation NAME ...] [--case NAME ...] [--manual]

    output    of the PLC at the end; found: the mean while its own controller drove it, or what stood in manual
    mode      of the PLC at the end
    away      largest distance of the PV from where it was found after the end came, beyond the largest before it, PV
    after     s from the end until output and mode are as they were found; `-` when that was not seen
    gains     `old`, `new`, or `torn`: neither all old nor all new
    sp        set point of the PLC at the end
    said      exit code of the command, or verdict of the schedule; `-` when nobody was left to say anything
    true      whether that agrees with the PLC: 0 or `done` says done, all else says that the old gains are there
    restored  yes, or NO: output, mode, set point or gains are not as found or as asked for
"""

import argparse
import contextlib
import json
import os
import resource
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import httpx

PATIENCE_S = 60.0
NEAR = 0.25
"""Largest difference of the output from the found one that counts as restored in manual, output units."""
BYTES = 4096
"""Of a file, on a disk that is full: what is there may be written over, nothing may be added."""
SET_POINT = 80.0
CONFIGURATION = """
[service]
data_directory = "{folder}/data"

[loops.TIC-101]
driver = "modbus"
sample_time_s = 0.05
limits = {{ output = [0.0, 100.0], pv = [-100.0, 300.0] }}
relay = {{ amplitude = 10.0, quiet_s = 1.0, min_periods = {periods}, check = false }}

[loops.TIC-101.device]
host = "127.0.0.1"
port = {port}
timeout_s = 1.0

[loops.TIC-101.device.registers]
pv = {{ table = "input", address = 0, type = "int16", scale = 0.1 }}
output = {{ table = "holding", address = 0, type = "int16", scale = 0.1 }}
auto = {{ table = "coil", address = 0 }}
"""
GAINS = """set_point = {table = "holding", address = 1, type = "int16", scale = 0.1}
kp = {table = "holding", address = 10, type = "float32"}
ti = {table = "holding", address = 12, type = "float32"}
td = {table = "holding", address = 14, type = "float32"}

[loops.TIC-101.gains]
form = "ideal"
scan_s = 0.05
"""
"""What is added to the configuration for operations that write gains or set points."""
NEW_GAINS = "0.4,4,0"
POINTS = (84.0, 80.0)
"""Set points of the schedule; the end comes at the first, which is not the one found."""
SLOW = "fault slow=0.4 60"
"""What holds a write of gains long enough that an end comes before its answer."""


@dataclass
class Plc:
    """The peer, watched by a thread of its own through its control port."""

    process: subprocess.Popen
    port: int
    control: int
    seen: list = field(default_factory=list)

    def ask(self, line):
        """Return the answer of the control port to a line."""
        with socket.create_connection(("127.0.0.1", self.control), timeout=5.0) as link:
            link.sendall(f"{line}\n".encode())
            return json.loads(link.makefile().readline())

    @property
    def gains(self):
        """Return the gains in the PLC."""
        told = self.ask("get")
        return tuple(told[name] for name in ("kp", "ti", "td"))

    @property
    def set_point(self):
        """Return the set point, which only a Modbus request tells."""
        with socket.create_connection(("127.0.0.1", self.port), timeout=5.0) as link:
            link.sendall(struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, 1, 1))
            return struct.unpack(">h", link.makefile("rb").read(11)[-2:])[0] / 10.0

    def watch(self):
        """Note PV, output and mode every 20 ms until the peer ends."""
        with contextlib.suppress(OSError, ValueError), socket.create_connection(("127.0.0.1", self.control)) as link:
            answers = link.makefile()
            while self.process.poll() is None:
                link.sendall(b"get\n")
                told = json.loads(answers.readline())
                self.seen.append((time.monotonic(), told["y_true"], told["u_cmd"], bool(told["auto"])))
                time.sleep(0.02)


@contextlib.contextmanager
def plc(peer, scan_s, auto):
    """Yield a PLC with a lag of 3 s behind 0.4 s, at rest at an output of 40."""
    command = [sys.executable, peer, "--tcp", "0", "--control", "0", "--plant", "2", "3", "0.4", "--scan", str(scan_s)]
    command += ["--noise", "0.05", "--u0", "40", "--y0", str(SET_POINT), "--ubias", "40", "--sp", str(SET_POINT)]
    command += ["--own-pid", "0.5", "3", "0", *(["--auto"] if auto else [])]
    quiet = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
    process = subprocess.Popen(command, **quiet)  # noqa: S603 - the program that the user names
    try:
        ready = json.loads(process.stdout.readline())
        one = Plc(process, ready["tcp"], ready["control"])
        threading.Thread(target=one.watch, daemon=True).start()
        yield one
    finally:
        process.kill()
        process.communicate()


def children(number):
    """Return a process's children and theirs."""
    lists = Path(f"/proc/{number}/task").glob("*/children")
    direct = [int(word) for one in lists for word in one.read_text().split()]
    return [*direct, *(deeper for one in direct for deeper in children(one))]


def loop_process(number):
    """Return the process that drives the loop: the child with the most threads' time."""

    def spent(one):
        fields = Path(f"/proc/{one}/stat").read_text().rpartition(")")[2].split()
        return int(fields[11]) + int(fields[12])

    names = {one: Path(f"/proc/{one}/cmdline").read_bytes() for one in children(number)}
    spawned = [one for one, line in names.items() if b"spawn_main" in line]
    connected = [one for one in spawned if has_connection(one)]
    return (connected or sorted(spawned, key=spent))[-1]


def has_connection(number):
    """Return whether a process has a TCP connection open."""
    held = set()
    for link in Path(f"/proc/{number}/fd").iterdir():
        with contextlib.suppress(OSError):
            held.add(str(link.readlink()))
    table = [line.split() for line in Path(f"/proc/{number}/net/tcp").read_text().splitlines()[1:]]
    return any(f"socket:[{row[9]}]" in held for row in table if row[3] == "01")


@dataclass
class Run:
    """An operation under way, and its PLC."""

    plc: Plc
    config: Path
    command: subprocess.Popen | None = None
    link: str = ""
    found: tuple = ()

    def spawn(self, *words):
        """Start a command of ours."""
        return subprocess.Popen(  # noqa: S603 - ourselves
            [sys.executable, "-m", "autotuner.cli", *words, "--config", str(self.config), "--json"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    @property
    def state(self):
        """Return the verdict of the schedule, None while it runs and where nobody answers."""
        with contextlib.suppress(httpx.HTTPError):
            verdict = httpx.get(self.link, timeout=2.0).json()["verdict"]
            return verdict and verdict["code"]
        return None

    @property
    def over(self):
        """Return whether the operation has ended."""
        return self.command.poll() is not None or bool(self.link and self.state)

    def all(self):
        """Return all its processes."""
        return [self.command.pid, *children(self.command.pid)]

    def send(self, number, *names):
        """Send signals to a process."""
        for name in names:
            with contextlib.suppress(ProcessLookupError):
                os.kill(number, getattr(signal, name))

    def again(self):
        """Start the service, which restores what was left, until it has had time for that."""
        with subprocess.Popen(  # noqa: S603 - ourselves
            [sys.executable, "-m", "autotuner.cli", "serve", "--json", "--port", "0", "--config", str(self.config)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        ) as service:
            time.sleep(12.0)
            service.terminate()


def commanded(*words):
    """Return what starts an operation that is a command."""

    def start(run):
        run.command = run.spawn(*words)

    return start


def apply_slowly(run):
    run.plc.ask(SLOW)
    run.command = run.spawn("apply", "TIC-101", "--gains", NEW_GAINS)


def roll_back_slowly(run):
    run.spawn("apply", "TIC-101", "--gains", NEW_GAINS).communicate(timeout=PATIENCE_S)
    run.found = run.plc.gains
    run.plc.ask(SLOW)
    run.command = run.spawn("rollback", "TIC-101")


def schedule(run):
    run.command = run.spawn("serve", "--port", "0")
    url = json.loads(run.command.stdout.readline())["listening"]
    asked = {"set_points": POINTS, "structure": "fopdt", "check": False}
    started = httpx.post(f"{url}/v1/loops/TIC-101/schedules", json=asked, timeout=PATIENCE_S)
    started.raise_for_status()
    run.link = url + started.headers["Location"]


def in_relay(run):
    return moved(run.plc)


def gains_written(run):
    return run.plc.gains != run.found


@dataclass(frozen=True)
class Operation:
    """What an end comes to: how it starts, when the end comes, and whether it is to leave other gains.

    `into_s` is the time from `begun` to the end; `periods` those of the relay; `omits` the ends that make no sense.
    """

    start: Callable
    begun: Callable
    into_s: float
    periods: int
    writes: bool
    omits: tuple = ("abort",)


INSTANT = ("abort", "Ctrl-Z", "disk full", "disk full, kill -9 of all, next start", "kill -9 loop process")
"""Ends left out for a command that writes gains: it has no process for the loop, no run to abort, nothing to pause."""
OPERATIONS = {
    "tune": Operation(commanded("tune", "TIC-101"), in_relay, 4.0, 11, writes=False),
    "tune --verify": Operation(
        commanded("tune", "TIC-101", "--verify", "--structure", "fopdt"), gains_written, 3.0, 3, writes=True
    ),
    "apply": Operation(apply_slowly, gains_written, 0.0, 3, writes=True, omits=INSTANT),
    "rollback": Operation(roll_back_slowly, gains_written, 0.0, 3, writes=True, omits=INSTANT),
    "schedule": Operation(schedule, in_relay, 4.0, 3, writes=False, omits=("Ctrl-Z",)),
}


def kill_all(run):
    for number in run.all():
        run.send(number, "SIGKILL")


def disk_full(run):
    for number in run.all():
        resource.prlimit(number, resource.RLIMIT_FSIZE, (BYTES, BYTES))


def pause(seconds):
    time.sleep(seconds)


def stopped(number, run, seconds):
    run.send(number, "SIGSTOP")
    time.sleep(seconds)
    run.send(number, "SIGCONT")


CASES = {
    "done": lambda _run: None,
    "abort": lambda run: httpx.post(f"{run.link}/abort", timeout=10.0),
    "Ctrl-C": lambda run: run.send(run.command.pid, "SIGINT"),
    "Ctrl-C twice": lambda run: (
        run.send(run.command.pid, "SIGINT"),
        pause(0.3),
        run.send(run.command.pid, "SIGINT"),
    ),
    "Ctrl-Z": lambda run: [run.send(number, "SIGTSTP") for number in run.all()],
    "SIGTERM": lambda run: run.send(run.command.pid, "SIGTERM"),
    "SIGHUP": lambda run: run.send(run.command.pid, "SIGHUP"),
    "kill -9 front": lambda run: run.send(run.command.pid, "SIGKILL"),
    "kill -9 loop process": lambda run: run.send(loop_process(run.command.pid), "SIGKILL"),
    "kill -9 of all, next start": lambda run: (kill_all(run), run.again()),
    "disk full, kill -9 of all, next start": lambda run: (disk_full(run), pause(4.0), kill_all(run), run.again()),
    "disk full": lambda run: (disk_full(run), pause(4.0), run.send(run.command.pid, "SIGINT")),
    "SIGSTOP front 3 s": lambda run: stopped(run.command.pid, run, 3.0),
    "SIGSTOP front 30 s": lambda run: stopped(run.command.pid, run, 30.0),
    "SIGSTOP loop process 3 s": lambda run: stopped(loop_process(run.command.pid), run, 3.0),
    "SIGSTOP loop process 30 s": lambda run: stopped(loop_process(run.command.pid), run, 30.0),
    "link cut 10 s": lambda run: run.plc.ask("fault refuse 10"),
    "PLC silent 10 s": lambda run: run.plc.ask("fault silent 10"),
    "PLC reboots, 5 s": lambda run: run.plc.ask("fault reboot 5"),
}


def conduct(peer, scan_s, operation, name, auto):
    """Return the row of one case."""
    what = OPERATIONS[operation]
    with tempfile.TemporaryDirectory() as folder, plc(peer, scan_s, auto) as device:
        run = Run(device, Path(folder) / "loops.toml", found=device.gains)
        periods = 3 if name == "done" else what.periods
        text = CONFIGURATION.format(folder=folder, port=device.port, periods=periods)
        run.config.write_text(text + ("" if operation == "tune" else GAINS))
        time.sleep(1.0)
        rest = sum(seen[1] for seen in device.seen) / len(device.seen)
        said = ("", "")
        try:
            what.start(run)
            until(lambda: what.begun(run) or run.over)
            time.sleep(what.into_s)
            if run.over:
                return (operation, name, *["not under way"] * 9)
            came_s = time.monotonic()
            before = max(abs(seen[1] - rest) for seen in device.seen)
            CASES[name](run)
            until(lambda: run.over and restored(device.seen[-1], auto), 2 * PATIENCE_S if name == "done" else 40.0)
            time.sleep(3.0)
            told = run.state if run.link else run.command.poll()
        finally:
            said = ended(run)
        row, good = judged(run, what, told, (came_s, before, rest), auto)
        if not good:
            sys.stderr.write(f"{operation}, {name}: {said[0][-1500:]}\n{said[1][-1500:]}\n")
        return (operation, name, *row)


def ended(run):
    """End what is left of a command, and return what it said."""
    if run.command is None:
        return "", ""
    with contextlib.suppress(ProcessLookupError):
        for number in run.all():
            os.kill(number, signal.SIGCONT)
    run.command.terminate()
    with contextlib.suppress(subprocess.TimeoutExpired):
        run.command.wait(10.0)
    run.command.kill()
    return run.command.communicate()


def judged(run, what, told, at, auto):
    """Return the columns of a row, and whether all is well."""
    (came_s, before, rest), device = at, run.plc
    device.ask("clear")
    after = [seen for seen in device.seen if seen[0] > came_s]
    away = max([0.0, *(abs(seen[1] - rest) - before for seen in after)])
    _, _, output, mode = device.seen[-1]
    lost = [seen[0] for seen in after if not restored(seen, auto)]
    loose = not restored(device.seen[-1], auto)
    gains, point = device.gains, device.set_point
    same = [new == old for new, old in zip(gains[:2], run.found[:2], strict=True)]
    kept = "old" if gains == run.found else "torn" if any(same) else "new"
    claims = told in {0, "done"}
    silent = told is None or told == -signal.SIGKILL
    true = silent or kept == ("new" if claims and what.writes else "old")
    good = not loose and kept != "torn" and abs(point - SET_POINT) < NEAR and true
    after_s = "-" if loose else f"{lost[-1] - came_s if lost else 0.0:.1f}"
    state = (f"{output:.1f}", "auto" if mode else "manual", f"{away:.2f}", after_s, kept, f"{point:.1f}")
    return (*state, "-" if silent else str(told), "-" if silent else yes(true), yes(good)), good


def yes(holds):
    return "yes" if holds else "NO"


def moved(device):
    """Return whether the relay has begun."""
    return any(not auto and abs(output - 40.0) > 6.0 for _, _, output, auto in device.seen[-5:])


def restored(seen, auto):
    """Return whether output and mode are as they were found."""
    _, _, output, mode = seen
    return mode if auto else abs(output - 40.0) < NEAR and not mode


def until(holds, limit_s=PATIENCE_S):
    """Wait until something holds; return when that was, None where it did not."""
    end_s = time.monotonic() + limit_s
    while time.monotonic() < end_s:
        if holds():
            return time.monotonic()
        time.sleep(0.02)
    return None


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--peer", required=True, help="the PLC: a Python program")
    parser.add_argument("--scan", type=float, default=0.05, help="scan of the PLC, s")
    parser.add_argument("--operation", action="append", choices=OPERATIONS, help="only this one")
    parser.add_argument("--case", action="append", choices=CASES, help="only this end")
    parser.add_argument("--manual", action="store_true", help="found in manual instead of automatic")
    args = parser.parse_args()
    heads = ("operation", "end", "output", "mode", "away", "after", "gains", "sp", "said", "true", "restored")
    print(f"| {' | '.join(heads)} |\n{'|---' * len(heads)}|")
    rows = []
    for operation in args.operation or OPERATIONS:
        for name in args.case or CASES:
            if name not in OPERATIONS[operation].omits:
                rows.append(conduct(args.peer, args.scan, operation, name, not args.manual))
                print("| " + " | ".join(rows[-1]) + " |", flush=True)
    print(f"\n{sum(row[-1] == 'yes' for row in rows)} of {len(rows)} restored; scan {args.scan:g} s")


if __name__ == "__main__":
    main()
