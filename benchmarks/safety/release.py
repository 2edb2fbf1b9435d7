"""How a loop is released at every end of every operation, judged at the registers of a device of another maker.

The device is a program of its own that shares no code with ours. `--peer` names a PLC: a command that takes `--tcp`,
`--control`, `--plant`, `--scan`, `--noise`, `--auto`, `--own-pid` and `--sp`, and answers `get` on its control port by
one JSON line. `--board` names one that takes `--protocol tclab` and `--link`; the bench reaches it through `socat`.
The end comes in the middle of the operation: in the relay, in the verification, between a write of gains and its
answer, or in the relay at the first operating point of a schedule. A full or a read-only disk is an ext4 of its own
(Linux, root).

    python benchmarks/safety/release.py --peer PLC.py [--board BOARD.py] [--jobs 4] [--scan 0.05] [--keep FILE]
        [--operation NAME ...] [--case NAME ...]
    python benchmarks/safety/release.py --tables FILE

    output    of the device at the end
    mode      of the device at the end
    away      largest distance of the PV from where it was found after the end came, beyond the largest before it, PV
    after     s from the end until output and mode are as they were found; `-` when that was not seen
    gains     `old`, `new`, or `torn`: neither all old nor all new
    sp        set point of the device at the end
    said      what the command, the service or the next start told in its end
    true      whether that agrees with the device: the loop restored or not, and the numbers of the gains
    restored  yes, or NO: output, mode, set point or gains are not as found or as asked for, or what was said is false

With `--keep`, rows are added to a file of JSON lines; `--tables` prints the tables of such a file.
"""

import argparse
import concurrent.futures
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import httpx

from benchmarks.safety._release_devices import OLD_GAINS, REST, SET_POINT, Board, Plc
from benchmarks.safety.bad_disk import Disk

PATIENCE_S = 60.0
BUSY_S = 300.0
"""Longest wait for what a busy machine computes before an end may come, or after it, s."""
NEAR = 0.25
"""Largest difference of the output from the found one that counts as restored in manual, output units."""
NOISE = 0.25
"""Distance of the PV that its noise of 0.05 explains, PV units."""
SHORT = 60
"""Most characters of what was said in a table."""
LOOK_S = 0.5
"""Time between two requests to the service, s."""
DISK_BYTES = 96 * 2**20
"""The service starts nothing where less than 64 MiB are left."""
CONFIGURATION = """
[service]
data_directory = "{disk}/data"

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
GAINS = """set_point = {{table = "holding", address = 1, type = "int16", scale = 0.1}}
kp = {{table = "holding", address = 10, type = "float32"}}
ti = {{table = "holding", address = 12, type = "float32"}}
td = {{table = "holding", address = 14, type = "float32"}}

[loops.TIC-101.gains]
form = "ideal"
scan_s = 0.05
"""
"""What is added to the configuration for operations that write gains or set points."""
SERIAL = """
[service]
data_directory = "{disk}/data"

[loops.TIC-101]
driver = "serial"
sample_time_s = 0.05
limits = {{ output = [0.0, 100.0], pv = [-100.0, 300.0] }}
relay = {{ amplitude = 10.0, quiet_s = 1.0, min_periods = {periods}, check = false }}

[loops.TIC-101.device]
protocol = "tclab"
serial_port = "{port}"
"""
NEW_GAINS = "0.4,4,0"
POINTS = [84.0, 80.0]
"""Set points of the schedule; the end comes at the first, which is not the one found."""
UNKNOWN = ("unknown", "not back", "could not")


def children(number):
    """Return a process's children and theirs."""
    lists = Path(f"/proc/{number}/task").glob("*/children")
    direct = [int(word) for one in lists for word in one.read_text().split()]
    return [*direct, *(deeper for one in direct for deeper in children(one))]


def loop_process(number, port):
    """Return the process that drives the loop: the child that has the device open."""
    return next(one for one in children(number) if has_open(one, port))


def has_open(number, port):
    """Return whether a process has a TCP connection, or the terminal `port`, open."""
    held = set()
    for link in Path(f"/proc/{number}/fd").iterdir():
        with contextlib.suppress(OSError):
            held.add(str(link.readlink()))
    table = [line.split() for line in Path(f"/proc/{number}/net/tcp").read_text().splitlines()[1:]]
    far = f"{port:04X}" if isinstance(port, int) else None
    return any(f"socket:[{row[9]}]" in held and row[2].endswith(f":{far}") for row in table) or (
        far is None and str(port.resolve()) in held
    )


@dataclass
class Run:
    """An operation under way, and its device."""

    device: Plc | Board
    folder: Path
    disk: Disk | None
    config: Path
    command: subprocess.Popen | None = None
    url: str = ""
    link: str = ""
    found: tuple = ()
    told: dict = field(default_factory=dict)
    notes: list = field(default_factory=list)
    looked_s: float = 0.0
    verifies: bool = False

    def spawn(self, *words):
        """Start a command of ours; what it prints goes into files, which no stopped reader can block."""
        with (self.folder / "out").open("w") as out, (self.folder / "err").open("w") as err:
            return subprocess.Popen(  # noqa: S603 - ourselves
                [sys.executable, "-m", "autotuner.cli", *words, "--config", str(self.config), "--json"],
                stdout=out,
                stderr=err,
                start_new_session=True,
                env={**os.environ, "XDG_STATE_HOME": str(self.config.parent / "disk" / "state")},
            )

    def serve(self):
        """Start the service."""
        self.command = self.spawn("serve", "--port", "0")
        until(lambda: (self.folder / "out").read_text().endswith("}\n") or self.command.poll() is not None)
        self.url = json.loads((self.folder / "out").read_text())["listening"]

    def post(self, path, **body):
        """Ask the service for something."""
        answer = httpx.post(f"{self.url}/v1/{path}", json=body, timeout=PATIENCE_S)
        if answer.is_success:
            self.link = self.url + answer.headers["Location"]
        else:
            self.notes.append(answer.json()["detail"])
        return answer

    def look(self):
        """Take note of what the service tells of the operation."""
        with contextlib.suppress(httpx.HTTPError, ValueError):
            self.told = httpx.get(self.link, timeout=2.0).json()

    @property
    def over(self):
        """Return whether the operation has ended."""
        if self.command.poll() is not None or (self.url and not self.link):
            return True
        if self.link and time.monotonic() > self.looked_s + LOOK_S:
            self.look()
            self.looked_s = time.monotonic()
        verdict, step = self.told.get("verdict") or {}, self.told.get("verification") or {}
        if self.verifies and verdict.get("outcome") == "done":
            return step.get("state") == "ended"
        return bool(self.link) and self.told.get("state") == "ended"

    @property
    def suspended(self):
        """Return whether the command has suspended itself."""
        return Path(f"/proc/{self.command.pid}/stat").read_text().rpartition(")")[2].split()[0] == "T"

    def send(self, number, *names):
        """Send signals to a process."""
        for name in names:
            with contextlib.suppress(ProcessLookupError):
                os.kill(number, getattr(signal, name))

    @property
    def driver(self):
        """The process that drives the loop."""
        return loop_process(self.command.pid, self.device.port)

    def kill_all(self):
        for number in [self.command.pid, *children(self.command.pid)]:
            self.send(number, "SIGKILL")
        self.command.wait()

    def again(self, wait_s=60.0):
        """Start the service, which restores what was left; return what it tells of the loop."""
        log = self.folder / "again"
        words = [sys.executable, "-m", "autotuner.cli", "serve", "--json", "--port", "0", "--config", str(self.config)]
        environment = {**os.environ, "XDG_STATE_HOME": str(self.folder / "disk" / "state")}
        with (
            log.open("w") as out,
            subprocess.Popen(words, stdout=out, stderr=out, env=environment) as service,  # noqa: S603 - ourselves
        ):
            until(lambda: said_of_loop(log.read_text()) or service.poll() is not None, wait_s)
            time.sleep(2.0)
            service.terminate()
        self.notes.append(said_of_loop(log.read_text()) or log.read_text()[-300:])


def said_of_loop(log):
    """Return what a log says of how something of the loop ended."""
    parts = [line.partition("program was killed during ")[2] for line in log.splitlines() if "TIC-101" in line]
    return "; ".join(dict.fromkeys(part for part in parts if part))


def apply_slowly(run):
    run.device.hold_up()
    run.command = run.spawn("apply", "TIC-101", "--gains", NEW_GAINS)


def roll_back_slowly(run):
    run.spawn("apply", "TIC-101", "--gains", NEW_GAINS).communicate(timeout=PATIENCE_S)
    run.found = run.device.state()[2]
    run.device.hold_up()
    run.command = run.spawn("rollback", "TIC-101")


def in_relay(run):
    return any(not auto and abs(output - REST) > 6.0 for _, _, output, auto, _ in run.device.seen[-5:])


def gains_written(run):
    return run.device.seen[-1][4] != run.found


@dataclass(frozen=True)
class Operation:
    """What an end comes to: how it starts, when the end comes, and whether it is to leave other gains.

    `words` are those of the command; `path` and `body` those of the request by which the service does the same, which
    an abort needs. `into_s` is the time from `begun` to the end; `periods` those of the relay; `omits` the ends that
    make no sense.
    """

    words: tuple = ()
    start: Callable | None = None
    path: str = ""
    body: dict = field(default_factory=dict)
    begun: Callable = in_relay
    into_s: float = 4.0
    periods: int = 11
    auto: bool = True
    device: type = Plc
    configuration: str = CONFIGURATION + GAINS
    omits: tuple = ()


TUNE = Operation(("tune", "TIC-101"), path="loops/TIC-101/tunings", configuration=CONFIGURATION)
VERIFY = Operation(
    ("tune", "TIC-101", "--verify", "--structure", "fopdt"),
    path="loops/TIC-101/tunings",
    body={"verify": True, "apply": True, "structure": "fopdt"},
    begun=gains_written,
    into_s=2.0,
    periods=3,
)
WRITING = Operation(begun=gains_written, into_s=0.0, periods=3, omits=("abort",))
OPERATIONS = {
    "tune": TUNE,
    "tune, manual": replace(TUNE, auto=False),
    "tune, serial": replace(TUNE, auto=False, device=Board, configuration=SERIAL, omits=("PLC reboots, 5 s",)),
    "verify": VERIFY,
    "apply": replace(WRITING, start=apply_slowly),
    "rollback": replace(WRITING, start=roll_back_slowly),
    "schedule": Operation(
        path="loops/TIC-101/schedules",
        body={"set_points": POINTS, "structure": "fopdt", "check": False},
        periods=3,
        omits=("Ctrl-Z",),
    ),
}


def pause(seconds):
    time.sleep(seconds)


def stopped(number, run, seconds):
    run.send(number, "SIGSTOP")
    time.sleep(seconds)
    run.send(number, "SIGCONT")


def signals(*names):
    """Return an end by signals to the command, 0.3 s apart."""

    def end(run):
        for name in names:
            run.send(run.command.pid, name)
            time.sleep(0.3)

    return end


def suspend(run):
    for number in [run.command.pid, *children(run.command.pid)]:
        run.send(number, "SIGTSTP")


@dataclass(frozen=True)
class End:
    """An end: what comes, and when: `before` the operation, at its first disturbance (`after`), or `during` it."""

    comes: Callable
    when: str = "during"
    needs_disk: bool = False


def crash(harm):
    """Return a harm to the disk after which all is killed, and started again with the disk as it is."""
    return lambda run: (harm(run), pause(2.0), run.kill_all(), run.again())


def full(run):
    run.disk.fill()


def read_only(run):
    run.disk.refuse()


CASES = {
    "done": End(lambda _run: None),
    "abort": End(lambda run: httpx.post(f"{run.link}/abort", timeout=10.0)),
    "Ctrl-C": End(signals("SIGINT")),
    "Ctrl-C twice": End(signals("SIGINT", "SIGINT")),
    "Ctrl-Z": End(suspend),
    "SIGTERM": End(signals("SIGTERM")),
    "SIGHUP": End(signals("SIGHUP")),
    "kill -9 front": End(signals("SIGKILL")),
    "kill -9 loop process": End(lambda run: run.send(run.driver, "SIGKILL")),
    "kill -9 of all, next start": End(lambda run: (run.kill_all(), run.again())),
    "SIGSTOP front 3 s": End(lambda run: stopped(run.command.pid, run, 3.0)),
    "SIGSTOP front 30 s": End(lambda run: stopped(run.command.pid, run, 30.0)),
    "SIGSTOP loop process 3 s": End(lambda run: stopped(run.driver, run, 3.0)),
    "SIGSTOP loop process 30 s": End(lambda run: stopped(run.driver, run, 30.0)),
    "link cut 10 s": End(lambda run: run.device.cut(10)),
    "PLC silent 10 s": End(lambda run: run.device.silence(10)),
    "PLC reboots, 5 s": End(lambda run: run.device.reboot(5)),
    "PLC killed, back after 5 s": End(lambda run: run.device.die(5.0)),
    "disk full before": End(full, "before", needs_disk=True),
    "disk full right after": End(full, "after", needs_disk=True),
    "disk full during": End(full, needs_disk=True),
    "disk full, kill -9 of all, next start": End(crash(full), needs_disk=True),
    "disk read-only before": End(read_only, "before", needs_disk=True),
    "disk read-only right after": End(read_only, "after", needs_disk=True),
    "disk read-only during": End(read_only, needs_disk=True),
    "disk read-only, kill -9 of all, next start": End(crash(read_only), needs_disk=True),
}


@dataclass(frozen=True)
class Row:
    """A row of the table; see the top of this file."""

    operation: str
    end: str
    output: str = ""
    mode: str = ""
    away: str = ""
    after: str = ""
    gains: str = ""
    sp: str = ""
    said: str = ""
    true: str = ""
    restored: str = "not under way"


def conduct(args, operation, name):
    """Return the row of one case, and what is worth reading where it is not well."""
    what, end = OPERATIONS[operation], CASES[name]
    with tempfile.TemporaryDirectory() as where, contextlib.ExitStack() as stack:
        folder = Path(where)
        (folder / "disk").mkdir()
        disk = Disk(stack, folder / "disk", DISK_BYTES) if end.needs_disk else None
        peer = args.peer if what.device is Plc else args.board
        device = what.device(peer, folder, args.scan, what.auto)
        stack.callback(device.close)
        run = Run(device, folder, disk, folder / "loops.toml", verifies=what is VERIFY)
        periods = 3 if name == "done" else what.periods
        run.config.write_text(what.configuration.format(disk=folder / "disk", port=device.port, periods=periods))
        device.settle()
        run.found = device.seen[-1][4]
        recent = device.seen[-5:]
        rest = sum(seen[1] for seen in recent) / len(recent)
        try:
            return brought_to(run, what, end, (operation, name), rest)
        finally:
            finish(run)


def brought_to(run, what, end, names, rest):
    """Bring an operation to an end; return its row and what is worth reading."""
    device = run.device
    if end.when == "before":
        if what.path and not what.words:
            run.serve()
        end.comes(run)
    came_s, before = time.monotonic(), 0.0
    begin(run, what, served=names[1] == "abort")
    if end.when != "before":
        until(lambda: what.begun(run) or run.over, BUSY_S)
        began = what.begun(run)
        time.sleep(what.into_s if end.when == "during" else 0.0)
        if run.over or not began:
            return Row(*names), notes_of(run)
        came_s, before = time.monotonic(), max(abs(seen[1] - rest) for seen in device.seen)
        end.comes(run)
    asleep = "Ctrl-Z" in names

    def well():
        return (run.suspended if asleep else run.over) and restored(device.seen[-1], what.auto)

    until(well, BUSY_S if run.command.poll() is None else PATIENCE_S)
    time.sleep(2.0)
    silent = (run.command.poll() == -signal.SIGKILL and not run.notes) or "unknown" in statement(run)[0]
    run.send(run.command.pid, "SIGCONT")
    if run.link:
        run.look()
    finish(run)
    if silent:
        run.again()
    return judged(run, what, names, (came_s, before, rest))


def begin(run, what, *, served):
    """Start an operation: by its command, or by the service."""
    if what.start is not None:
        what.start(run)
    elif what.words and not served:
        run.command = run.spawn(*what.words)
    else:
        if not run.url:
            run.serve()
        run.post(what.path, **what.body)


def finish(run):
    """End what is left of a command."""
    if run.command is None or run.command.poll() is not None:
        return
    everyone = [run.command.pid, *children(run.command.pid)]
    for number in everyone:
        run.send(number, "SIGCONT")
    with contextlib.suppress(subprocess.TimeoutExpired):
        run.command.wait(10.0 if not run.url else 0.1)
    run.command.terminate()
    with contextlib.suppress(subprocess.TimeoutExpired):
        run.command.wait(15.0)
    for number in everyone:
        run.send(number, "SIGKILL")
    run.command.wait()


def notes_of(run):
    """Return what is worth reading of a case that did not go well."""
    files = [run.folder / name for name in ("out", "err", "again")]
    return "\n".join([*run.notes, *(file.read_text()[-1500:] for file in files if file.exists())])


def answer_of(run):
    """Return the JSON object that a command has printed, or what the service told."""
    if run.told or run.url:
        return run.told
    with contextlib.suppress(ValueError):
        return json.loads((run.folder / "out").read_text())
    return {}


def statement(run):
    """Return in short what was said, whether the loop was said to be restored, and the gains that were named."""
    answer, error = answer_of(run), (run.folder / "err").read_text().strip()
    if run.notes:
        text = run.notes[-1]
        gains = OLD_GAINS if "old gains are restored" in text else None
        return text, not any(word in text for word in UNKNOWN), gains
    if answer.get("verdict"):
        verdict = answer["verdict"]["code"]
        if check := (answer.get("verification") or {}).get("verdict"):
            verdict += f", {check['code']}"
        loop = answer.get("restored", "unknown" not in verdict)
        applied = answer.get("applied")
        gains = run.found if not applied else tuple(applied["now"]["values"].values())
        return verdict, loop is not False, gains
    if "now" in answer:
        return "done", True, tuple(answer["now"]["values"].values())
    lines = error.splitlines()
    text = ([line.partition(" INFO ")[2] for line in lines if run.url and "TIC-101" in line] or lines or [""])[-1]
    gains = OLD_GAINS if "old gains are restored" in text else None if "and stay" in text else run.found
    return text.removeprefix("autotuner: "), not any(word in text for word in UNKNOWN), gains


def judged(run, what, names, at):
    """Return the row of a case, and what is worth reading of it."""
    (came_s, before, rest), device = at, run.device
    output, mode, gains, point = device.state()
    after = [seen for seen in device.seen if seen[0] > came_s]
    away = max([0.0, *(abs(seen[1] - rest) - before for seen in after)])
    lost = [seen[0] for seen in after if not restored(seen, what.auto)]
    is_back = restored((0.0, 0.0, output, mode), what.auto) and abs(point - SET_POINT) < NEAR
    kept = "old" if gains == run.found else "torn" if any(map(same, gains[:2], run.found[:2])) else "new"
    said, claims_back, claimed = statement(run)
    true = bool(said) and claims_back == is_back and (claimed is None or all(map(same, gains, claimed)))
    good = is_back and kept != "torn" and true
    after_s = f"{lost[-1] - came_s if lost else 0.0:.1f}" if is_back else "-"
    held = (f"{output:.1f}", "auto" if mode else "manual", f"{away:.2f}", after_s, kept, f"{point:.1f}")
    return Row(*names, *held, said, yes(true), yes(good)), "" if good else notes_of(run)


def same(one, other):
    return abs(one - other) <= 1e-5 * max(1.0, abs(other))


def yes(holds):
    return "yes" if holds else "NO"


def restored(seen, auto):
    """Return whether output and mode are as they were found."""
    output, mode = seen[2:4]
    return mode if auto else abs(output - REST) < NEAR and not mode


def until(holds, limit_s=PATIENCE_S):
    """Wait until something holds, as long as that is worth it."""
    end_s = time.monotonic() + limit_s
    while time.monotonic() < end_s and not holds():
        time.sleep(0.04)


def tables(rows):
    """Print one row an end with a column an operation, and what the first operation said."""
    operations = [name for name in OPERATIONS if any(row.operation == name for row in rows)]
    known = {(row.operation, row.end): row for row in rows}
    heads = [*operations, f"report of {operations[0]}"]
    print(f"| end | {' | '.join(heads)} |\n{'|---' * (len(heads) + 1)}|")
    for end in CASES:
        cells = [time_and_way(known[name, end]) if (name, end) in known else "" for name in operations]
        said = in_short(known[operations[0], end]) if (operations[0], end) in known else ""
        print(f"| {end} | {' | '.join([*cells, said])} |")


def time_and_way(row):
    """Return when a loop was restored, and how far its PV went."""
    if row.restored != "yes":
        return f"**{row.restored}**"
    return row.after if float(row.away) < NOISE else f"{row.after} ({float(row.away):.1f})"


def in_short(row):
    """Return what was said, without what went before it and without the name of a folder."""
    text = row.said.partition("; ")[2] if row.said.startswith("the ") else row.said
    text = text.partition(": ")[2] if text.startswith(("/", "127.")) else text
    return f"{text[:SHORT]}.." if len(text) > SHORT else text


def guarded(args, operation, name):
    """Return the row of one case; one that fails is a row too."""
    try:
        return conduct(args, operation, name)
    except Exception:  # noqa: BLE001 - the other cases go on
        return Row(operation, name, restored="failed"), traceback.format_exc()


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--peer", help="the PLC: a Python program")
    parser.add_argument("--board", help="the board on a serial line: a Python program")
    parser.add_argument("--scan", type=float, default=0.05, help="scan of the PLC, s")
    parser.add_argument("--jobs", type=int, default=4, help="cases side by side, each with a device of its own")
    parser.add_argument("--operation", action="append", choices=OPERATIONS, help="only this one")
    parser.add_argument("--case", action="append", choices=CASES, help="only this end")
    parser.add_argument("--keep", type=Path, help="add the rows to this file")
    parser.add_argument("--tables", type=Path, help="only print the tables of such a file")
    args = parser.parse_args()
    if args.tables:
        tables([Row(**json.loads(line)) for line in args.tables.read_text().splitlines()])
        return
    peers = {Plc: args.peer, Board: args.board}
    chosen = [name for name in args.operation or OPERATIONS if peers[OPERATIONS[name].device]]
    cases = [(name, end) for name in chosen for end in args.case or CASES if end not in OPERATIONS[name].omits]
    heads = list(asdict(Row("", "")))
    print(f"| {' | '.join(heads)} |\n{'|---' * len(heads)}|", flush=True)
    rows = []
    with concurrent.futures.ThreadPoolExecutor(args.jobs) as pool:
        for future in concurrent.futures.as_completed([pool.submit(guarded, args, *case) for case in cases]):
            row, notes = future.result()
            rows.append(row)
            print("| " + " | ".join(asdict(row).values()) + " |", flush=True)
            if notes:
                sys.stderr.write(f"--- {row.operation}, {row.end}\n{notes}\n")
            if args.keep:
                with args.keep.open("a") as file:
                    file.write(json.dumps(asdict(row)) + "\n")
    print(f"\n{sum(row.restored == 'yes' for row in rows)} of {len(rows)} restored; scan {args.scan:g} s")


if __name__ == "__main__":
    main()
