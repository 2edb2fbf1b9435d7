"""The service killed with -9 at random moments of a verification, and started again: gains, set point, mode, output.

A simulated PLC with a controller of its own, the service and the judge that looks at the PLC are separate programs, on
the wall clock. Each round tunes the loop, has its gains written and verified, kills the service at a random moment
after the first gain has been written, looks at the PLC, starts the service again, and looks at the PLC once nothing of
it is interrupted any more. The PLC stands in manual in one half of the rounds, in auto in the other. Every other time
all processes of the service are killed with it, as with a container: then nobody is left to give anything back.

    who         `service`: only that; `all`: its workers and the loop process too
    at          seconds from the first new gain in the PLC to the kill
    stood       what differed right after the kill from what had been found: g gains, s set point, m mode, o output
    alone       the same a while later, before anybody starts anything
    back        the same after the next start; gains that were verified are to stay, and count as back
    took        seconds from the start of the service until nothing was interrupted any more
    code        verdict of the verification after the next start; `ended` when it was over before the kill

    python benchmarks/safety/verification_kills.py [--rounds 20] [--seed 1] [--within 14] [--keep FILE]
    python benchmarks/safety/verification_kills.py --rounds 0 --keep FILE

The output counts as back in manual only: in auto the PLC's own controller moves it. With `--keep`, rounds are added to
a file of JSON lines, and the last table tells of all of the file.
"""

import argparse
import contextlib
import json
import os
import random
import signal
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import httpx
from pyModbusTCP.client import ModbusClient

from autotuner.control.records.journal import Journal
from benchmarks.safety.kills import LOOP, PATIENCE_S, REST, TOLERANCE, serve, spawn, until

ALONE_S = 2.0
"""Time for which nobody starts anything after a kill, s."""
GAINS = ["0.3", "2", "0"]
CONFIGURATION = """
[service]
port = 0
data_directory = "{folder}/data"

[loops.TIC-101]
driver = "modbus"
sample_time_s = 0.05
limits = {{ output = [0.0, 100.0], pv = [-100.0, 300.0] }}
relay = {{ amplitude = 10.0, quiet_s = 1.0, min_periods = 3, accuracy = 0.05, check = false }}
safety = {{ max_lateness_s = 30.0, pv_timeout_s = 30.0 }}
gains = {{ form = "ideal", derivative_filter = 8.0, scan_s = 0.05 }}

[loops.TIC-101.device]
host = "127.0.0.1"
port = {port}
timeout_s = 5.0

[loops.TIC-101.device.registers]
pv = {{ table = "input", address = 0, type = "int16", scale = 0.1 }}
output = {{ table = "holding", address = 0, type = "int16", scale = 0.1 }}
set_point = {{ table = "holding", address = 1, type = "int16", scale = 0.1 }}
auto = {{ table = "coil", address = 0 }}
kp = {{ table = "holding", address = 10, type = "float32" }}
ti = {{ table = "holding", address = 12, type = "float32" }}
td = {{ table = "holding", address = 14, type = "float32" }}
"""


@dataclass
class Round:
    """What one kill did; `stood`, `alone` and `back` are letters of what differed."""

    auto: bool
    everything: bool
    at_s: float
    stood: str
    alone: str
    back: str
    took_s: float
    code: str


@dataclass(frozen=True)
class Stand:
    """How the PLC stands, by its registers."""

    gains: tuple[int, ...]
    set_point: float
    auto: bool
    output: float

    def differs(self, found):
        """Return a letter for each part that is not as it was found."""
        parts = {
            "g": self.gains != found.gains,
            "s": self.set_point != found.set_point,
            "m": self.auto != found.auto,
            "o": not found.auto and abs(self.output - found.output) > TOLERANCE,
        }
        return "".join(letter for letter, differs in parts.items() if differs)


class Plc:
    """The simulated PLC in a process of its own, and an independent client that looks at it."""

    def __init__(self, stack, *, auto):
        words = ["--plant", "K=2", "T=1", "D=0.2", "--output0", str(REST), "--gains", *GAINS]
        self.process = spawn(stack, "plc", "--port", "0", *words, *(["--auto"] if auto else []))
        self.port = json.loads(self.process.stdout.readline())["port"]
        self._client = ModbusClient(host="127.0.0.1", port=self.port, auto_open=True, timeout=5.0)
        stack.callback(self._client.close)

    @property
    def stand(self):
        holding, coils = until(lambda: self._client.read_holding_registers(0, 16)), self._client.read_coils(0, 1)
        return Stand(tuple(holding[10:16]), holding[1] / 10.0, bool(coils[0]), holding[0] / 10.0)


def children_of(process):
    """Return the processes that a process has started."""
    lists = Path(f"/proc/{process.pid}/task").glob("*/children")
    return [int(number) for one in lists for number in one.read_text().split()]


def one_round(stack, plc, config, service, at_s, *, everything):
    """Kill a service at a moment of a verification; return what came of it, and the next service with its address."""
    process, url = service
    found, journal = plc.stand, Journal(config.parent / "data")
    asked = {"verify": True, "structure": "fopdt"}
    started = httpx.post(f"{url}/v1/loops/{LOOP}/tunings", json=asked, timeout=PATIENCE_S)
    started.raise_for_status()
    tuning = started.json()["links"]["self"]
    until(lambda: plc.stand.gains != found.gains)
    time.sleep(at_s)
    for number in [process.pid, *(children_of(process) if everything else [])]:
        os.kill(number, signal.SIGKILL)
    process.wait()
    stood, ended = plc.stand.differs(found), not journal.interrupted()
    time.sleep(ALONE_S)
    alone, started_s = plc.stand.differs(found), time.monotonic()
    process, url = serve(stack, config)
    until(lambda: not journal.interrupted())
    took_s = time.monotonic() - started_s
    told = httpx.get(f"{url}{tuning}", timeout=PATIENCE_S).json()["verification"]
    verdict = told and told["verdict"]
    code = "ended" if ended else verdict["code"] if verdict else "none"
    stays = "g" if ended or code == "verified" else ""
    back = plc.stand.differs(found).replace(stays, "") if stays else plc.stand.differs(found)
    return Round(found.auto, everything, at_s, stood, alone, back, took_s, code), (process, url)


def killed(count, draw, within_s, *, auto):
    """Kill and start so many times, the PLC in one mode; return the rounds."""
    rounds = []
    for number in range(count):
        with contextlib.ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            plc = Plc(stack, auto=auto)
            config = folder / "loops.toml"
            config.write_text(CONFIGURATION.format(folder=folder, port=plc.port))
            at_s, started = draw.uniform(0.0, within_s), serve(stack, config)
            row, (service, _) = one_round(stack, plc, config, started, at_s, everything=number % 2 == 1)
            service.send_signal(signal.SIGTERM)
            service.wait(PATIENCE_S)
        rounds.append(row)
        print(line(row), flush=True)
    return rounds


def line(row):
    differed = " ".join(f"{part or '-':<5}" for part in (row.stood, row.alone, row.back))
    who = "all" if row.everything else "service"
    return f"{'auto' if row.auto else 'manual':<7} {who:<8} {row.at_s:6.2f} {differed} {row.took_s:6.2f}  {row.code}"


HEADS = (
    "found in; killed",
    "kills",
    "after it was over",
    "gains, set point, mode, output away",
    "so left, and back 2 s later",
    "back after the next start",
    "after, median and most, s",
)


def summary(rounds):
    """Yield a table in Markdown: a row for each mode and what was killed, and one for all."""
    yield f"| {' | '.join(HEADS)} |"
    yield "|---" * len(HEADS) + "|"
    for auto in (False, True):
        for everything in (False, True):
            chosen = [row for row in rounds if row.auto is auto and row.everything is everything]
            if chosen:
                yield row_of(f"{'auto' if auto else 'manual'}; {'all' if everything else 'the service'}", chosen)
    yield row_of("all", rounds)


def row_of(name, rounds):
    away = ", ".join(str(sum(letter in row.stood for row in rounds)) for letter in "gsmo")
    left = [row for row in rounds if row.stood and row.code not in {"ended", "verified"}]
    alone, ended = sum(not row.alone for row in left), sum(row.code == "ended" for row in rounds)
    took = sorted(row.took_s for row in rounds)
    back = sum(not row.back for row in rounds)
    times = f"{took[len(took) // 2]:.1f}, {took[-1]:.1f}"
    return f"| {name} | {len(rounds)} | {ended} | {away} | {len(left)}, {alone} | {back} | {times} |"


def kept(file, rounds):
    """Add rounds to a file of JSON lines, and return all that it holds."""
    if file is None:
        return rounds
    with file.open("a", encoding="utf-8") as lines:
        lines.writelines(json.dumps(asdict(row)) + "\n" for row in rounds)
    return [Round(**json.loads(text)) for text in file.read_text(encoding="utf-8").splitlines()]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--within", type=float, default=14.0, help="latest moment of a kill, s from the first gain")
    parser.add_argument("--keep", type=Path, help="add the rounds to this file, and tell of all that it holds")
    args = parser.parse_args()
    draw = random.Random(args.seed)  # noqa: S311 - moments, not secrets
    half = args.rounds // 2
    new = killed(args.rounds - half, draw, args.within, auto=False) + killed(half, draw, args.within, auto=True)
    rounds = kept(args.keep, new)
    print("\n".join([*map(line, rounds), *summary(rounds)]))
    return 1 if any(row.back for row in rounds) else 0


if __name__ == "__main__":
    sys.exit(main())
