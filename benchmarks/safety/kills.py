"""The service killed with -9 at random moments of a tuning, and started again: outputs, database, lost samples.

A simulated PLC, the service and the judge that looks at the PLC are separate programs, on the wall clock. Each round
starts a tuning, kills the service at a random moment of it, looks into the database, starts the service again, and
looks at the PLC and at what the service tells of the tuning.

    at          seconds from the start of the tuning to the kill, and the phase then
    stood       the output of the PLC right after the kill, before = 40
    alone       seconds from the kill until output and mode are as they were found, before anybody starts anything:
                the process that drives the loop does that; `-` where the service is started again at once
    back        the output and the mode after the next start: `yes` when both are as they were found
    whole       what SQLite's own check says of the database right after the kill
    lost        seconds of samples that the events had told and the database did not have right after the kill
    after       the same after the next start, which adds what the journal has
    code        verdict of the tuning after the next start; `ended` when it was over before the kill

    python benchmarks/safety/kills.py [--rounds 40] [--seed 1] [--within 18] [--keep FILE]
    python benchmarks/safety/kills.py --rounds 0 --keep FILE

The last table has one row for each phase. With `--keep`, rounds are added to a file of JSON lines, and that table tells
of all of the file: many kills may be done in several runs.
"""

import argparse
import contextlib
import json
import random
import signal
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import httpx
from pyModbusTCP.client import ModbusClient

REST = 40.0
LOOP = "TIC-101"
PATIENCE_S = 120.0
TOLERANCE = 0.06
"""Of the output: the PLC counts in tenths."""
CONFIGURATION = """
[service]
port = 0
data_directory = "{folder}/data"

[loops.TIC-101]
driver = "modbus"
sample_time_s = 0.05
limits = {{ output = [0.0, 100.0], pv = [-100.0, 300.0] }}
relay = {{ amplitude = 10.0, quiet_s = 1.0 }}
safety = {{ max_lateness_s = 30.0, pv_timeout_s = 30.0 }}

[loops.TIC-101.device]
host = "127.0.0.1"
port = {port}
timeout_s = 5.0

[loops.TIC-101.device.registers]
pv = {{ table = "input", address = 0, type = "int16", scale = 0.1 }}
output = {{ table = "holding", address = 0, type = "int16", scale = 0.1 }}
auto = {{ table = "coil", address = 0 }}
"""


@dataclass
class Round:
    """What one kill did."""

    at_s: float
    phase: str
    stood: float
    back: bool
    whole: str
    lost_s: float
    after_s: float
    code: str
    alone_s: float | None = None


class Published(threading.Thread):
    """Listens to the events of a tuning until the connection breaks."""

    def __init__(self, url, tuning_id):
        super().__init__(daemon=True)
        self.url = f"{url}/v1/tunings/{tuning_id}/events"
        self.sample_s = 0.0
        self.phase = "arm"
        self.ended = False
        self.start()

    def run(self):
        with contextlib.suppress(httpx.HTTPError), httpx.stream("GET", self.url, timeout=PATIENCE_S) as stream:
            for line in stream.iter_lines():
                if line.startswith("data:"):
                    self.take(json.loads(line[5:]))

    def take(self, event):
        if event["type"] == "sample":
            self.sample_s = event["t"]
        elif event["type"] == "phase":
            self.phase = event["phase"]
        self.ended = self.ended or event["type"] == "ended"


class Plc:
    """The simulated PLC in a process of its own, and an independent client that looks at it."""

    def __init__(self, stack):
        words = ["--plant", "K=2", "T=1", "D=0.2", "--output0", str(REST), "--auto", "--gains", "0", "0", "0"]
        self.process = spawn(stack, "plc", "--port", "0", *words)
        self.port = json.loads(self.process.stdout.readline())["port"]
        self._client = ModbusClient(host="127.0.0.1", port=self.port, auto_open=True, timeout=5.0)
        stack.callback(self._client.close)

    @property
    def output(self):
        return until(lambda: self._client.read_holding_registers(0, 1))[0] / 10.0

    @property
    def as_found(self):
        coils = until(lambda: self._client.read_coils(0, 1))
        return abs(self.output - REST) < TOLERANCE and bool(coils[0])


def spawn(stack, *words):
    process = subprocess.Popen(  # noqa: S603 - our own program
        [sys.executable, "-m", "autotuner", *words], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    stack.callback(process.wait)
    stack.callback(process.kill)
    return process


def until(condition):
    """Wait for what another process does."""
    deadline = time.monotonic() + PATIENCE_S
    while not (seen := condition()):
        if time.monotonic() > deadline:
            raise TimeoutError("it did not happen")
        time.sleep(0.01)
    return seen


def serve(stack, config):
    """Start the service; return it with its address."""
    service = spawn(stack, "serve", "--json", "--config", str(config))
    return service, json.loads(service.stdout.readline())["listening"]


def looked_into(file, tuning_id):
    """Return SQLite's word on the database, and the time of the last sample that it holds."""
    with contextlib.closing(sqlite3.connect(file)) as connection:
        (whole,) = connection.execute("PRAGMA integrity_check").fetchone()
        query = "SELECT samples FROM recording_chunks WHERE tuning_id = ? ORDER BY first DESC LIMIT 1"
        row = connection.execute(query, [tuning_id]).fetchone()
    if row is None:
        return whole, 0.0
    return whole, float(memoryview(row[0]).cast("d")[-6])


def one_round(stack, plc, config, service, url, at_s, wait):
    """Kill the service at a moment of a tuning; return what came of it, and the next service with its address."""
    started = httpx.post(f"{url}/v1/loops/{LOOP}/tunings", timeout=PATIENCE_S)
    started.raise_for_status()
    tuning_id = started.json()["id"]
    told = Published(url, tuning_id)
    time.sleep(at_s)
    service.send_signal(signal.SIGKILL)
    killed_s = time.monotonic()
    stood = plc.output
    if wait:
        until(lambda: plc.as_found)
    alone_s = time.monotonic() - killed_s if wait else None
    service.wait()
    told.join(PATIENCE_S)
    last_s = told.sample_s
    whole, kept_s = looked_into(config.parent / "data" / "tunings.sqlite", tuning_id)
    service, url = serve(stack, config)
    after, code = after_the_next_start(url, tuning_id, told)
    row = Round(at_s, told.phase, stood, plc.as_found, whole, last_s - kept_s, last_s - after, code, alone_s)
    return row, service, url


def after_the_next_start(url, tuning_id, told):
    """Return the time of the last sample that the service tells when it has settled the tuning, and its code."""

    def settled():
        answer = httpx.get(f"{url}/v1/tunings/{tuning_id}", timeout=PATIENCE_S)
        return answer.json() if answer.is_success and answer.json()["state"] == "ended" else None

    ended = until(settled)
    until(lambda: httpx.get(f"{url}/v1/loops/{LOOP}", timeout=PATIENCE_S).json()["tuning_id"] is None)
    code = "ended" if told.ended else ended["verdict"]["code"]
    if not ended["samples"]:
        return 0.0, code
    rows = httpx.get(f"{url}/v1/tunings/{tuning_id}/recording", timeout=PATIENCE_S)
    return float(rows.text.split()[-1].split(",")[0]) if rows.is_success else 0.0, code


def table(rounds):
    yield f"{'at':>6} {'phase':<9} {'stood':>6} {'alone':>6} {'back':<5} {'whole':<6} {'lost':>6} {'after':>6}  code"
    for row in rounds:
        back = "yes" if row.back else "NO"
        alone = "-" if row.alone_s is None else f"{row.alone_s:.3f}"
        yield (
            f"{row.at_s:6.2f} {row.phase:<9} {row.stood:6.1f} {alone:>6} {back:<5} {row.whole:<6} "
            f"{max(row.lost_s, 0.0):6.2f} {max(row.after_s, 0.0):6.2f}  {row.code}"
        )


def row_of(name, rounds):
    """Return a row of the table that the documentation shows."""
    lost, after = (
        sorted(max(value, 0.0) for value in values)
        for values in ([row.lost_s for row in rounds], [row.after_s for row in rounds])
    )
    disturbed = sum(abs(row.stood - REST) > TOLERANCE for row in rounds)
    back, whole = sum(row.back for row in rounds), sum(row.whole == "ok" for row in rounds)
    loss = f"{lost[len(lost) // 2]:.2f}, {lost[-1]:.2f} | {after[-1]:.2f}"
    alone = sorted(row.alone_s for row in rounds if row.alone_s is not None)
    waited = f"{len(alone)}: {alone[len(alone) // 2]:.2f}, {alone[-1]:.2f}" if alone else "0"
    return f"| {name} | {len(rounds)} | {disturbed} | {waited} | {back} | {whole} | {loss} |"


def summary(rounds):
    """Yield a table in Markdown: a row for each phase at the kill, and one for all."""
    alone = "waited for before the next start: back after, median and most, s"
    heads = (
        "phase at the kill",
        "kills",
        "output away",
        alone,
        "given back",
        "database whole",
        "lost, median and most, s",
    )
    yield f"| {' | '.join(heads)} | lost after the next start, most, s |"
    yield "|---|---|---|---|---|---|---|---|"
    phases = [*dict.fromkeys(row.phase for row in sorted(rounds, key=lambda row: row.at_s))]
    for phase in phases:
        yield row_of(f"`{phase}`", [row for row in rounds if row.phase == phase])
    yield row_of("all", rounds)


def kept(file, rounds):
    """Add rounds to a file of JSON lines, and return all that it holds."""
    if file is None:
        return rounds
    with file.open("a", encoding="utf-8") as lines:
        lines.writelines(json.dumps(asdict(row)) + "\n" for row in rounds)
    return [Round(**json.loads(line)) for line in file.read_text(encoding="utf-8").splitlines()]


def killed(count, seed, within_s):
    """Kill and start so many times; return the rounds."""
    draw, rounds = random.Random(seed), []  # noqa: S311 - moments, not secrets
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        plc = Plc(stack)
        config = folder / "loops.toml"
        config.write_text(CONFIGURATION.format(folder=folder, port=plc.port))
        service, url = serve(stack, config)
        for number in range(count):
            at_s, wait = draw.uniform(0.0, within_s), number % 2 == 0
            row, service, url = one_round(stack, plc, config, service, url, at_s, wait)
            rounds.append(row)
            print(list(table([row]))[1], flush=True)
        service.send_signal(signal.SIGTERM)
        service.wait(PATIENCE_S)
    return rounds


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--within", type=float, default=18.0, help="latest moment of a kill, s from the start")
    parser.add_argument("--keep", type=Path, help="add the rounds to this file, and tell of all that it holds")
    args = parser.parse_args()
    rounds = kept(args.keep, killed(args.rounds, args.seed, args.within) if args.rounds else [])
    print("\n".join([*table(rounds), *summary(rounds)]))
    bad = [row for row in rounds if not row.back or row.whole != "ok" or row.lost_s > 1.0]
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
