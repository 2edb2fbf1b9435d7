"""Gains of whole tunings in circumstances of a plant floor: refused, silently wrong, and warnings on good results.

    OMP_NUM_THREADS=1 python benchmarks/accuracy/tuning/circumstances.py [--draws 4] [--seed 0] [--only NAME ...]
                                                              [--failures] [--record FILE]

Each draw is a process (lags with dead time, D/T 0.05 to 10; integrating; inverse response), a time scale, a gain, noise
of 0.3 to 3 % of the oscillation, and one circumstance. The product tunes it with default settings (`virtual_loop`).
Gains are judged on the true loop, with half a sample for the hold of the controller: bad where Ms exceeds 2 or the loop
is unstable, silently wrong where no warning was given. After a refusal its advice is followed once (`ADVICE`) on the
same process, for which time has gone on, and the gains of the second tuning are judged alike. The last line tells how
far a tuning moved the PV. Seeds below 100 were developed on.
`--record` appends each draw to a file of JSON lines, from which a later call takes what was drawn before.
"""

from __future__ import annotations

import argparse
import json
import math
import time
import warnings
import zlib
from collections import Counter
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.accuracy.cases.virtual_loop import Process, Surroundings, tuned
from benchmarks.baselines.amigo_batch import Process as LinearProcess
from benchmarks.baselines.amigo_batch import lag, ultimate
from benchmarks.baselines.loop_judge import sensitivities

if TYPE_CHECKING:
    from collections.abc import Callable

AMPLITUDE = 10.0
"""Relay amplitude of the default settings, output units."""
WRONG_MS = 2.0


@dataclass(frozen=True)
class Draw:
    """What a circumstance is sized by: PV amplitude `A` and period `P` of the oscillation, sample time, generator."""

    A: float
    P: float
    dt: float
    rng: np.random.Generator

    def sign(self) -> float:
        return float(self.rng.choice([-1.0, 1.0]))


def drift(around: Surroundings, d: Draw) -> None:
    slope = d.sign() * d.rng.uniform(0.02, 0.3) * d.A / d.P
    around.offset = lambda t: slope * t


def load_drift(around: Surroundings, d: Draw) -> None:
    slope = d.sign() * d.rng.uniform(0.02, 0.2) * AMPLITUDE / (10.0 * d.P)
    around.load = lambda t: slope * t


def load_step(around: Surroundings, d: Draw) -> None:
    size, at = d.sign() * d.rng.uniform(0.1, 0.5) * AMPLITUDE, d.rng.uniform(0.0, 12.0) * d.P
    around.load = lambda t: size if t >= at else 0.0


def coloured(around: Surroundings, d: Draw) -> None:
    sigma, memory = d.rng.uniform(0.01, 0.05) * d.A, d.rng.uniform(0.01, 0.1) * d.P
    a, last = math.exp(-d.dt / memory), [0.0]

    def noise() -> float:
        last[0] = a * last[0] + math.sqrt(1.0 - a * a) * float(d.rng.standard_normal())
        return sigma * last[0]

    around.noise = noise


def coarse_pv(around: Surroundings, d: Draw) -> None:
    step = d.A * d.rng.uniform(0.05, 0.4)
    around.sensor = lambda y: step * round(y / step)


def coarse_actuator(around: Surroundings, _d: Draw) -> None:
    around.actuator = lambda u: float(round(u))


def near_limit(around: Surroundings, d: Draw) -> None:
    around.output0 = float(d.rng.choice([0.0, 1.0, 3.0, 97.0, 100.0]))


def on_change(around: Surroundings, d: Draw) -> None:
    band, last = d.A * d.rng.uniform(0.02, 0.15), [math.inf]

    def sensor(y: float) -> float:
        if abs(y - last[0]) > band:
            last[0] = y
        return last[0]

    around.sensor = sensor


def take_over(around: Surroundings, d: Draw) -> None:
    """The output that the device held before was another one than it reported: the PV leaves its rest at the start."""
    size = d.sign() * d.rng.uniform(0.03, 0.3) * AMPLITUDE
    around.load = lambda _t: size


def unsettled(around: Surroundings, d: Draw) -> None:
    size, decay = d.sign() * d.rng.uniform(0.1, 1.0) * d.A, d.rng.uniform(0.3, 3.0) * d.P
    around.offset = lambda t: size * math.exp(-t / decay)


def beside_a_controller(around: Surroundings, d: Draw) -> None:
    """A PI controller goes on beside the relay, with gains such as an engineer finds in a loop that is in use."""
    Ku = 4.0 / math.pi * AMPLITUDE / d.A
    gains = {"Kp": Ku * d.rng.uniform(0.1, 0.25), "Ti": d.P * d.rng.uniform(1.0, 3.0)}
    around.relay = {"online": gains}


CIRCUMSTANCES: dict[str, Callable[[Surroundings, Draw], None]] = {
    "nothing": lambda _around, _d: None,
    "noise-free": lambda around, _d: setattr(around, "noise", lambda: 0.0),
    "drift": drift,
    "load drift": load_drift,
    "load step": load_step,
    "offset at take-over": take_over,
    "not at rest": unsettled,
    "coloured noise": coloured,
    "coarse PV": coarse_pv,
    "PV on change": on_change,
    "1 % actuator steps": coarse_actuator,
    "near a limit": near_limit,
    "slow sampling": lambda _around, _d: None,
    "beside a controller": beside_a_controller,
}


def process_of(rng: np.random.Generator) -> LinearProcess:
    kind = rng.choice(["one lag", "two lags", "three lags", "integrating", "inverse"], p=[0.3, 0.3, 0.15, 0.15, 0.1])
    D = float(10.0 ** rng.uniform(-1.3, 1.0))
    if kind == "one lag":
        return LinearProcess(f"one lag D/T {D:.2g}", "", 1.0, (), (lag(1.0),), D)
    if kind == "two lags":
        second = float(rng.uniform(0.1, 0.9))
        return LinearProcess(f"lags 1, {second:.2f} D {D:.2g}", "", 1.0, (), (lag(1.0), lag(second)), D)
    if kind == "three lags":
        a = float(rng.uniform(0.2, 0.8))
        lags = tuple(lag(a**k) for k in range(3))
        return LinearProcess(f"lags 1, {a:.2f}, {a * a:.2f} D {D / 3:.2g}", "", 1.0, (), lags, D / 3)
    if kind == "integrating":
        T = float(rng.uniform(0.1, 2.0))
        return LinearProcess(f"integrating lag {T:.2f} D {D / 3:.2g}", "", 1.0, (), ((0.0, 1.0), lag(T)), D / 3)
    zero = float(rng.uniform(0.2, 1.2))
    return LinearProcess(f"inverse {zero:.2f} D {D / 5:.2g}", "", 1.0, ((1.0, -zero),), (lag(1.0), lag(0.6)), D / 5)


@dataclass(frozen=True)
class Row:
    """What became of a draw."""

    circumstance: str
    process: str
    code: str
    Ms: float = math.nan
    warnings: tuple[str, ...] = ()
    message: str = ""
    second: Row | None = None
    travel: float = math.nan
    """Largest distance of the PV from its first reading, in amplitudes of the oscillation."""

    @property
    def refused(self) -> bool:
        return math.isnan(self.Ms)

    @property
    def bad(self) -> bool:
        return not self.refused and self.Ms > WRONG_MS

    def line(self) -> str:
        told = "REFUSED" if self.refused else f"Ms {self.Ms:.3f}"
        told += f", travel {self.travel:.1f}"
        line = f"  {self.circumstance}, {self.process}: {told} {self.code} {self.message} {list(self.warnings)}"
        return line if self.second is None else f"{line}\n    its advice followed: {self.second.line().strip()}"


def stronger(around: Surroundings) -> None:
    around.relay = {**around.relay, "amplitude": 2.0 * AMPLITUDE}


def with_drift(around: Surroundings) -> None:
    """Allow a drift that has not ended by waiting: the remedy names both."""
    around.relay = {**around.relay, "drift_compensation": True}


def after_the_load(around: Surroundings) -> None:
    """Repeat the test when the load is quiet: it stays what it is by then."""
    level = around.load(0.0)
    around.load = lambda _t: level


def inside_its_range(around: Surroundings) -> None:
    around.output0 = 40.0


ADVICE: dict[str, Callable[[Surroundings], None]] = {
    "pv_drifts": with_drift,
    "record_unexplained": after_the_load,
    "no_oscillation": inside_its_range,
    "no_answer": stronger,
    "no_response": stronger,
    "oscillation_in_noise": stronger,
    "no_gains": stronger,
    "too_vague": stronger,
}
"""What a user does after a refusal, by its code, beside waiting: what its remedy names first."""
WAITED_PERIODS = 10.0
"""Time between a refused test and the next one, in periods of the oscillation."""


def perform(name: str, seed: int, number: int) -> Row:
    """Return what a tuning of one draw gives."""
    rng = np.random.default_rng([seed, number, zlib.crc32(name.encode())])
    process = process_of(rng)
    Ku, Pu = ultimate(process)
    scale, gain = 10.0 ** rng.uniform(0.3, 2.3) / Pu, 10.0 ** rng.uniform(-0.5, 0.5)
    P = Pu * scale
    dt = P / (rng.uniform(8.0, 15.0) if name == "slow sampling" else rng.uniform(30.0, 100.0))
    A = 4.0 / math.pi * AMPLITUDE * gain / Ku
    sigma = A * 10.0 ** rng.uniform(-2.5, -1.5)
    around = Surroundings(noise=lambda: sigma * float(rng.standard_normal()))
    CIRCUMSTANCES[name](around, Draw(A, P, dt, rng))
    moving, scales = Process(process, scale, gain, dt), (scale, gain, dt)
    row, ended_s = once(name, process, moving, around, scales)
    if not row.refused or row.code not in ADVICE:
        return row
    wait(moving, around, ended_s, WAITED_PERIODS * P)
    ADVICE[row.code](around)
    return replace(row, second=once(name, process, moving, around, scales)[0])


def wait(moving: Process, around: Surroundings, ended_s: float, waited_s: float) -> None:
    """Let a process go on at its resting output, and the time of what comes from outside with it."""
    steps, load, offset = math.ceil(waited_s / moving.dt), around.load, around.offset
    for k in range(steps):
        moving.advance(load(ended_s + k * moving.dt))
    begins_s = ended_s + steps * moving.dt
    around.load, around.offset = (lambda t: load(begins_s + t)), (lambda t: offset(begins_s + t))


def once(
    name: str, process: LinearProcess, moving: Process, around: Surroundings, scales: tuple[float, float, float]
) -> tuple[Row, float]:
    """Return what one tuning gives, and when it ended, s; `scales` are seconds of a unit of time, gain, sample time."""
    (scale, gain, dt), (Ku, Pu) = scales, ultimate(process)
    tuning = tuned(moving, around)
    pvs = np.array([sample.pv for sample in tuning.samples] or [math.nan])
    travel = float(np.abs(pvs - pvs[0]).max()) * Ku / (gain * 4.0 / math.pi * AMPLITUDE)
    ended_s = tuning.samples[-1].t if tuning.samples else 0.0
    analysis, verdict = tuning.analysis, tuning.verdict
    assert verdict is not None
    if not tuning.succeeded or analysis is None or analysis.gains is None:
        return Row(name, process.name, verdict.code, message=verdict.message, travel=travel), ended_s
    found: Any = analysis.gains.gains
    own = (found.Kp * gain, found.Ti / scale, found.Td / scale, found.Tf / scale)
    Ms, _, stable = sensitivities(replace(process, D=process.D + dt / scale / 2.0), own, Pu)
    row = Row(name, process.name, "done", Ms if stable else math.inf, tuple(tuning.warnings), travel=travel)
    return row, ended_s


def recorded(file: Path | None, seed: int) -> dict[tuple[str, int], Row]:
    """Return the draws of a seed that a file holds, by circumstance and number."""
    if file is None or not file.exists():
        return {}
    lines = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    return {(one["row"]["circumstance"], one["number"]): _row(one["row"]) for one in lines if one["seed"] == seed}


def _row(values: dict[str, Any]) -> Row:
    second = values["second"]
    read = {**values, "warnings": tuple(values["warnings"]), "second": None if second is None else _row(second)}
    return Row(**read)


def append(file: Path | None, seed: int, number: int, row: Row) -> None:
    if file is not None:
        with file.open("a", encoding="utf-8") as lines:
            lines.write(json.dumps({"seed": seed, "number": number, "row": asdict(row)}) + "\n")


def report(rows: list[Row]) -> None:
    print(f"{'circumstance':20s} draws refused  then  bad silent  good warned  refusals")
    for name in [*dict.fromkeys(row.circumstance for row in rows), "all"]:
        part = [row for row in rows if name in {row.circumstance, "all"}]
        refused, bad = [row for row in part if row.refused], [row for row in part if row.bad]
        good = [row for row in part if not row.refused and not row.bad]
        then = sum(row.second is not None and not row.second.refused and not row.second.bad for row in refused)
        counts = (len(part), len(refused), then, len(bad), sum(not row.warnings for row in bad), len(good))
        shown = "{:5d} {:7d} {:5d} {:4d} {:6d} {:5d}".format(*counts)
        print(
            f"{name:20s} {shown} {sum(bool(row.warnings) for row in good):6d}  {dict(Counter(r.code for r in refused))}"
        )
    travels = [row.travel for row in rows if math.isfinite(row.travel)]
    median, high, worst = np.percentile(travels, [50, 99, 100]) if travels else [math.nan] * 3
    print(f"largest distance of the PV from rest, amplitudes: median {median:.1f}, p99 {high:.1f}, worst {worst:.1f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=4, help="of each circumstance")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", choices=list(CIRCUMSTANCES))
    parser.add_argument("--failures", action="store_true", help="print every draw")
    parser.add_argument("--record", type=Path, help="file of JSON lines that the draws are appended to")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    names, began = list(args.only or CIRCUMSTANCES), time.process_time()
    rows = recorded(args.record, args.seed)
    for number in range(args.draws):
        for name in names:
            if (name, number) in rows:
                continue
            row = rows[name, number] = perform(name, args.seed, number)
            append(args.record, args.seed, number, row)
            if args.failures:
                print(row.line(), flush=True)
    report([row for name in names for (drawn, _), row in rows.items() if drawn == name])
    print(f"{time.process_time() - began:.0f} s of processor time")


if __name__ == "__main__":
    main()
