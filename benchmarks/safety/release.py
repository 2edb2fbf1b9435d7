"""How a loop is released at every end of a tuning, judged at the registers of a PLC of another maker.

The PLC is a program of its own whose Modbus side shares no code with ours: a command that takes `--tcp`, `--control`,
`--plant`, `--scan`, `--noise`, `--auto`, `--own-pid` and `--sp`, and answers `get` on its control port with one JSON
line. `autotuner tune` drives it in the relay when the end comes.

    python benchmarks/safety/release.py --peer PLC.py [--scan 0.05] [--case NAME ...] [--manual]

    output    of the PLC at the end; found: the mean while its own controller drove it, or what stood in manual
    mode      of the PLC at the end
    away      largest distance of the PV from where it was found after the end came, beyond the largest before it, PV
    after     s from the end until output and mode are as they were found; `-` when that was not seen
    restored  yes, or what is wrong
"""

import argparse
import contextlib
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

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
    """A command that tunes, and its PLC."""

    plc: Plc
    command: subprocess.Popen
    config: Path

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


def conduct(peer, scan_s, name, auto):
    """Return the row of one case."""
    with tempfile.TemporaryDirectory() as folder, plc(peer, scan_s, auto) as device:
        config = Path(folder) / "loops.toml"
        periods = 3 if name == "done" else 11
        config.write_text(CONFIGURATION.format(folder=folder, port=device.port, periods=periods))
        time.sleep(1.0)
        found = device.seen[:]
        rest = sum(seen[1] for seen in found) / len(found)
        command = subprocess.Popen(  # noqa: S603 - ourselves
            [sys.executable, "-m", "autotuner.cli", "tune", "TIC-101", "--config", str(config), "--json"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        try:
            until(lambda: moved(device) or command.poll() is not None)
            time.sleep(4.0)  # a swing of the relay
            came_s = time.monotonic()
            before = max(abs(seen[1] - rest) for seen in device.seen)
            CASES[name](Run(device, command, config))
            wait_s = PATIENCE_S if name == "done" else 25.0
            until(lambda: restored(device.seen[-1], auto), wait_s)
            time.sleep(3.0)
        finally:
            with contextlib.suppress(ProcessLookupError):
                for number in [*children(command.pid), command.pid]:
                    os.kill(number, signal.SIGCONT)
            command.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                command.wait(10.0)
            command.kill()
            said = command.communicate()
        after = [abs(seen[1] - rest) for seen in device.seen if seen[0] > came_s]
        away = max([0.0, *(one - before for one in after)])
        _, _, output, mode = device.seen[-1]
        good = restored(device.seen[-1], auto)
        lost = [seen[0] for seen in device.seen if seen[0] > came_s and not restored(seen, auto)]
        after_s = f"{lost[-1] - came_s if lost else 0.0:.1f}" if good else "-"
        row = (name, f"{output:.1f}", "auto" if mode else "manual", f"{away:.2f}", after_s, "yes" if good else "NO")
        if not good:
            sys.stderr.write(f"{name}: {said[1][-1500:]}\n")
        return row


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
    parser.add_argument("--case", action="append", choices=CASES, help="only this one")
    parser.add_argument("--manual", action="store_true", help="found in manual instead of automatic")
    args = parser.parse_args()
    print("| end | output | mode | away | after | restored |\n|---|---|---|---|---|---|")
    rows = []
    for name in args.case or CASES:
        rows.append(conduct(args.peer, args.scan, name, not args.manual))
        print("| " + " | ".join(rows[-1]) + " |", flush=True)
    print(f"\n{sum(row[-1] == 'yes' for row in rows)} of {len(rows)} restored; scan {args.scan:g} s")


if __name__ == "__main__":
    main()
