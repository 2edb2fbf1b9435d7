"""What a longer experiment is worth: whole tunings beside three symmetric relay cycles with rules of the literature.

    OMP_NUM_THREADS=1 python benchmarks/accuracy/tuning/three_cycles.py [--noise none 20] [--seed 0] [--every 8]

Every n-th process of `amigo_batch` is tuned with default settings (`gains.perform`). Beside it an ideal relay of the
same amplitude, with a dead zone of three times the noise, switches symmetrically until three cycles are complete. From
that one record come Ziegler and Nichols's gains (`Ku = 4 h/(pi A)`), and AMIGO's and SIMC's for the product's
first-order fit of it. All gains are judged on the true process with half a sample for the hold of the controller.

Durations count from the first move of the output to its last; (T + D) is the sum of all lags and the dead time. The
load error is over that of the best PID controller with Ms and Mt at most 1.4; "kept" are loops that are stable with Ms
of at most 2, and errors are of these alone. AMIGO's and SIMC's gains exist where the fit does.
"""

from __future__ import annotations

import argparse
import csv
import math
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from autotuner.core.design import UltimatePoint, apply_rule
from autotuner.core.identification import identify
from autotuner.core.recording import Recording
from autotuner.errors import AutotunerError
from benchmarks.accuracy.cases.virtual_loop import PV0, Process
from benchmarks.accuracy.tuning import gains as whole_tunings
from benchmarks.baselines.amigo_batch import batch, ultimate
from benchmarks.baselines.optimum import RESULT

if TYPE_CHECKING:
    from collections.abc import Iterator

    from autotuner.core.design import PidGains

CYCLES, AT_REST = 3, 50
MOST_MS = 2.0
OUTPUT0 = 40.0
CLASSICS = ("Ziegler-Nichols", "AMIGO", "SIMC")
OWN = "the product"


@dataclass(frozen=True)
class Outcome:
    """Gains of one method on one process: load error over the optimum, Ms, duration in periods and in (T + D)."""

    error: float
    Ms: float
    periods: float
    residence_times: float


def symmetric(process: Process, sigma: float, rng: np.random.Generator) -> tuple[Recording, float, float]:
    """Return the record of three cycles, the mean amplitude of the PV over them, and their period, s."""
    rows, switches, high, output = [], list[int](), True, OUTPUT0
    k = 0
    while len(switches) < 2 * CYCLES + 2:
        pv = PV0 + process.pv + sigma * float(rng.standard_normal())
        if k >= AT_REST:
            away, zone = pv - PV0, 3.0 * sigma
            turned = away > zone if high else away < -zone
            if turned:
                high = not high
                switches.append(k)
            output = OUTPUT0 + whole_tunings.AMPLITUDE * (1.0 if high else -1.0)
        rows.append((k * process.dt, output, pv))
        process.advance(output - OUTPUT0)
        k += 1
    t, u, pv = np.array(rows).T
    settled = pv[switches[-1 - 2 * CYCLES + 2] : switches[-1]]
    period = (switches[-1] - switches[-1 - 2 * CYCLES + 2]) / (CYCLES - 1) * process.dt
    return Recording(t, u, pv), float(np.ptp(settled)) / 2.0, period


def classics(record: Recording, amplitude: float, period: float) -> Iterator[tuple[str, PidGains | None]]:
    """Yield the gains of the rules from one record; None where a rule has none."""
    point = UltimatePoint(4.0 * whole_tunings.AMPLITUDE / (math.pi * amplitude), period)
    yield CLASSICS[0], apply_rule("ziegler_nichols_pid", None, point).gains
    model = identify(record, structure="fopdt").model
    for name, rule in zip(CLASSICS[1:], ("amigo_pid", "simc_pid"), strict=True):
        try:
            yield name, None if model is None else apply_rule(rule, model, point).gains
        except AutotunerError:
            yield name, None


def perform(process: Any, decibels: float | None, seed: int, known: list[float]) -> dict[str, Outcome | None]:
    """Return what becomes of one process by every method."""
    one = whole_tunings.perform(process, decibels, seed, known)
    rng = np.random.default_rng([seed, sum(map(ord, process.name))])
    Ku, Pu = ultimate(process)
    scale, gain = 10.0 ** rng.uniform(0.3, 2.3) / Pu, 10.0 ** rng.uniform(-0.5, 0.5)
    dt = Pu * scale / rng.uniform(40.0, 120.0)
    sigma = 0.0
    if decibels is not None:
        sigma = 4.0 / math.pi * whole_tunings.AMPLITUDE * gain / Ku / math.sqrt(2.0) * 10.0 ** (-decibels / 20.0)
    lags = sum(factor[1] for factor in process.denominator if factor[0] != 0.0)
    residence = (lags + process.D) / Pu
    rest = AT_REST * dt / (Pu * scale)
    found: dict[str, Outcome | None] = {OWN: None}
    if not one.refused:
        periods = one.periods - rest
        found[OWN] = Outcome(one.error, one.Ms, periods, periods / residence)
    record, amplitude, period = symmetric(Process(process, scale, gain, dt), sigma, rng)
    periods = record.duration_s / (Pu * scale) - rest
    for name, gains in classics(record, amplitude, period):
        found[name] = None
        if gains is not None:
            error, Ms = whole_tunings.judged(process, scale, gain, dt, gains, known)
            found[name] = Outcome(error, Ms, periods, periods / residence)
    return found


def table(title: str, rows: list[dict[str, Outcome | None]]) -> None:
    """Print a line for each method."""
    print(f"{title}, {len(rows)} processes")
    print(f"{'':18s} {'gains':>5s} {'kept':>5s} {'periods':>14s} {'(T + D)':>14s} {'load error':>18s} {'Ms worst':>9s}")
    for name in (OWN, *CLASSICS):
        found = [outcome for row in rows if (outcome := row[name]) is not None]
        kept = [one for one in found if one.Ms <= MOST_MS]
        if not found:
            continue
        columns = [
            "{:7.1f} {:6.1f}".format(*np.percentile([getattr(one, column) for one in found], (50, 90)))
            for column in ("periods", "residence_times")
        ]
        error = "{:8.2f} {:9.2f}".format(*np.percentile([one.error for one in kept] or [math.nan], (50, 90)))
        worst = max(one.Ms for one in found)
        print(f"{name:18s} {len(found):5d} {len(kept):5d} {columns[0]} {columns[1]} {error} {worst:9.2f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--noise", nargs="*", default=["none", "20"], help="noise under the oscillation, dB")
    parser.add_argument("--seed", type=int, default=0, help="seeds below 100 were developed on")
    parser.add_argument("--every", type=int, default=8, help="take every n-th process")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    with RESULT.open() as file:
        chosen = [row for row in csv.DictReader(file) if row["controller"] == "filtered"]
    optima = {row["process"]: [float(row[name]) for name in ("Kp", "Ti", "Td")] for row in chosen}
    for level in args.noise:
        decibels = None if level == "none" else float(level)
        rows = [perform(one, decibels, args.seed, optima[one.name]) for one in batch()[:: args.every]]
        table("without noise" if decibels is None else f"noise {level} dB", rows)
    print("periods, (T + D) and load error: median and 90th percentile")


if __name__ == "__main__":
    main()
