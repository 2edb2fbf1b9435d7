"""Gains of whole tunings on the test batch: error over the optimum, sensitivities, refusals, warnings.

    OMP_NUM_THREADS=1 python benchmarks/accuracy/tuning/gains.py [--noise none 20] [--seed 0] [--every N] [--failures]

Each of the 133 processes of `amigo_batch` is tuned with default settings (`virtual_loop`): experiment, running models,
identification, diagnosis and gains as a user gets them. The seed draws noise, time scale, gain and sample time. Gains
are judged on the true process, with half a sample for the hold of the controller, by `loop_judge`: integrated error
after a load step over that of the best PID controller with Ms and Mt at most 1.4, and Ms. The optimum is that of
`data/optimum.csv`, searched again from there for the process with this half sample.
A tuning also limits how much the PV's noise may move the output (0.5 % of its span, standard deviation). The fair
comparison is with the optimum under the same limit on the true process with the true noise, which `quiet_optimum` finds
with the filter free; it is printed first. "over the unlimited optimum" is the error over the best without this limit,
and "gains without the limit" are those for the same model and its 95 % region alone, over the same.
A result is silently wrong where Ms exceeds 2, or the loop is unstable, and no warning was given.
A tuning takes two to ten seconds of one core, and the optimum under the limit a few more.
"""

from __future__ import annotations

import argparse
import collections
import csv
import itertools
import math
import time
import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from autotuner.application.analysis.procedure import gains_for
from benchmarks.accuracy.cases.virtual_loop import Process, Surroundings, tuned
from benchmarks.baselines.amigo_batch import batch, ultimate
from benchmarks.baselines.loop_judge import iae, sensitivities
from benchmarks.baselines.optimum import FILTERS, RESULT, problem, simplexes
from benchmarks.baselines.quiet_optimum import Gains, output_movement, quiet_optimum

OPTIMA = RESULT
AMPLITUDE = 10.0
"""Relay amplitude of the default settings, output units."""
WRONG_MS = 2.0
MOVEMENT = 0.5
"""Movement of the output that the noise may cause with the default goal, standard deviation, output units."""
GRID = np.geomspace(0.05, 0.6, 6), np.geomspace(0.2, 4.0, 6), np.geomspace(0.02, 0.5, 4)
"""`Kp` over `Ku`, `Ti` and `Td` over `Pu` from which the search for the optimum starts without a PID controller."""
NEAR: tuple[float, ...] = (0.1, 0.03, 0.01)
FAR: tuple[float, ...] = (0.3, *NEAR)
"""Sizes of the simplexes from gains near the optimum, and from the grid; in logarithms."""


@dataclass(frozen=True)
class Result:
    """What became of a tuning; `error` over the optimum, `fair` over that under the same limit; duration in periods."""

    name: str
    code: str
    error: float = math.nan
    Ms: float = math.nan
    periods: float = math.nan
    warnings: tuple[str, ...] = ()
    model: str = ""
    seconds: float = math.nan
    fair: float = math.nan
    movement: float = math.nan
    unlimited: tuple[float, float] = (math.nan, math.nan)

    @property
    def refused(self) -> bool:
        return math.isnan(self.Ms)

    @property
    def wrong(self) -> bool:
        return not self.refused and self.Ms > WRONG_MS

    @property
    def silent(self) -> bool:
        return self.wrong and not self.warnings

    def line(self) -> str:
        errors = f"{self.fair:.3f} ({self.error:.3f}, {self.unlimited[0]:.3f})"
        told = "REFUSED" if self.refused else f"{errors} Ms {self.Ms:.3f} movement {self.movement:.3f}"
        spent = f"{self.periods:.1f} periods, {self.seconds:.1f} s"
        return f"  {self.name:16s} {told}, {spent}, {self.code} {self.model} {list(self.warnings)}"


def best(process: Any, known: list[float]) -> tuple[Gains, float]:
    """Return the optimal controller of a process near one whose optimum has the gains `known`, and its error.

    A PID controller is where the search starts; from a P or PI controller there is no way by logarithms, and it starts
    from the best of a grid.
    """
    Ku, Pu = ultimate(process)
    cost, gains, _ = problem(process, FILTERS["filtered"])
    if known[2] > 0.0 and known[1] < math.inf:
        start, sizes = np.log(np.array(known) / (Ku, Pu, Pu)) - (0.1, 0.0, 0.0), NEAR
    else:
        start, sizes = min((np.log(point) for point in itertools.product(*GRID)), key=cost), FAR
    found = gains(simplexes(cost, start, sizes))
    return found, float(iae(process, found, Pu))


def best_error(process: Any, known: list[float]) -> float:
    """Return the error of the optimal controller of a process near one whose optimum has the gains `known`."""
    return best(process, known)[1]


class Judge:
    """The true process of a tuning, with half a sample for the hold, and the errors that a controller can reach there.

    Times are those of the batch, PV units those of a process of its gain.
    """

    def __init__(self, process: Any, scales: tuple[float, float, float], sigma: float, known: list[float]) -> None:
        self.scale, self.gain, dt = scales
        self.h, self.sigma = dt / self.scale, sigma / self.gain
        self.process, self.Pu = replace(process, D=process.D + self.h / 2.0), ultimate(process)[1]
        optimum, self.least = best(self.process, known)
        self.least_quiet = self.least
        if self.sigma and output_movement(self.process, optimum, self.sigma, self.h) > MOVEMENT:
            quiet = quiet_optimum(self.process, (self.sigma, self.h), MOVEMENT, optimum)
            self.least_quiet = math.inf if quiet is None else quiet[1]

    def own(self, found: Any) -> Gains:
        return found.Kp * self.gain, found.Ti / self.scale, found.Td / self.scale, found.Tf / self.scale

    def judged(self, found: Any) -> tuple[float, float]:
        """Return integrated error and Ms of gains on the true process."""
        own = self.own(found)
        Ms, _, stable = sensitivities(self.process, own, self.Pu)
        return (float(iae(self.process, own, self.Pu)), Ms) if stable else (math.inf, math.inf)

    def movement(self, found: Any) -> float:
        """Return the movement of the output that the noise causes, over its limit."""
        return output_movement(self.process, self.own(found), self.sigma, self.h) / MOVEMENT


def judged(process: Any, scale: float, gain: float, dt: float, found: Any, known: list[float]) -> tuple[float, float]:
    """Return integrated error over the optimum, and Ms, of gains on the true process."""
    judge = Judge(process, (scale, gain, dt), 0.0, known)
    error, Ms = judge.judged(found)
    return error / judge.least, Ms


def perform(process: Any, decibels: float | None, seed: int, known: list[float]) -> Result:
    """Return what a tuning of one process gives."""
    rng = np.random.default_rng([seed, sum(map(ord, process.name))])
    Ku, Pu = ultimate(process)
    scale, gain = 10.0 ** rng.uniform(0.3, 2.3) / Pu, 10.0 ** rng.uniform(-0.5, 0.5)
    dt = Pu * scale / rng.uniform(40.0, 120.0)
    sigma = 0.0
    if decibels is not None:
        sigma = 4.0 / math.pi * AMPLITUDE * gain / Ku / math.sqrt(2.0) * 10.0 ** (-decibels / 20.0)
    around = Surroundings(noise=lambda: sigma * float(rng.standard_normal()) if sigma else 0.0)
    began = time.process_time()
    tuning = tuned(Process(process, scale, gain, dt), around)
    seconds, analysis = time.process_time() - began, tuning.analysis
    periods = len(tuning.samples) * dt / (Pu * scale)
    assert tuning.verdict is not None
    if not tuning.succeeded or analysis is None or analysis.gains is None:
        return Result(process.name, tuning.verdict.code, periods=periods, model=tuning.verdict.message, seconds=seconds)
    judge, found = Judge(process, (scale, gain, dt), sigma, known), analysis.gains.gains
    error, Ms = judge.judged(found)
    free, free_Ms = judge.judged(gains_for(analysis.identification, sample_time_s=dt).gains)
    return Result(
        process.name,
        "done",
        error / judge.least,
        Ms,
        periods,
        tuple(tuning.warnings),
        str(analysis.identification.structure),
        seconds,
        error / judge.least_quiet,
        judge.movement(found),
        (free / judge.least, free_Ms),
    )


def shares(values: Any) -> str:
    """Return median, 90th percentile and the largest of values."""
    return "median {:.3f}, p90 {:.3f}, worst {:.3f}".format(*np.percentile(np.array(values), (50, 90, 100)))


def table(title: str, results: list[Result]) -> None:
    """Print the figures of a level of noise."""
    done = [r for r in results if not r.refused]
    if not done:
        print(f"{title}: {len(results)} tunings, all refused")
        return
    Ms = np.array([r.Ms for r in done])
    good = [r for r in done if r.Ms <= 1.6]
    refused, silent = len(results) - len(done), sum(r.silent for r in done)
    print(f"{title}: {len(results)} tunings, {refused} refused, {silent} silently wrong")
    print(f"  error over the optimum with the same limit of output movement: {shares([r.fair for r in done])}")
    print(f"  movement of the output over its limit: {shares([r.movement for r in done])}")
    print(f"  error over the unlimited optimum: {shares([r.error for r in done])}")
    free = np.array([r.unlimited for r in done])
    print(f"  gains without the limit: {shares(free[:, 0])}, Ms p97.5 {np.percentile(free[:, 1], 97.5):.3f}")
    print(f"  Ms: p97.5 {np.percentile(Ms, 97.5):.3f}, worst {Ms.max():.3f}")
    periods = [r.periods for r in done]
    print(f"  ultimate periods: median {np.median(periods):.1f}, worst {max(periods):.0f}")
    print(f"  good results with a warning: {sum(bool(r.warnings) for r in good)} of {len(good)}")
    print(f"  processor time: median {np.median([r.seconds for r in results]):.1f} s", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--noise", nargs="*", default=["none", "20"], help="noise under the oscillation, dB")
    parser.add_argument("--seed", type=int, default=0, help="seeds below 100 were developed on")
    parser.add_argument("--every", type=int, default=1, help="take every n-th process")
    parser.add_argument("--first", type=int, default=0, help="first process")
    parser.add_argument("--only", help="part of a process name")
    parser.add_argument("--failures", action="store_true", help="print every result")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    with OPTIMA.open() as file:
        rows = [row for row in csv.DictReader(file) if row["controller"] == "filtered"]
    optima = {row["process"]: [float(row[name]) for name in ("Kp", "Ti", "Td")] for row in rows}
    for level in args.noise:
        results = []
        for process in batch()[args.first :: args.every]:
            if args.only and args.only not in process.name:
                continue
            result = perform(process, None if level == "none" else float(level), args.seed, optima[process.name])
            results.append(result)
            if args.failures:
                print(result.line(), flush=True)
        table("without noise" if level == "none" else f"noise {level} dB", results)
        if refused := collections.Counter(r.code for r in results if r.refused):
            print(f"  refused: {dict(refused)}")


if __name__ == "__main__":
    main()
