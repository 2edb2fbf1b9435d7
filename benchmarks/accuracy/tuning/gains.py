"""Gains of whole tunings on the test batch: error over the optimum, sensitivities, refusals, warnings.

    OMP_NUM_THREADS=1 python benchmarks/accuracy/tuning/gains.py [--noise none 20] [--seed 0] [--every N] [--failures]

Each of the 133 processes of `amigo_batch` is tuned with default settings (`virtual_loop`): experiment, running models,
identification, diagnosis and gains as a user gets them. The seed draws noise, time scale, gain and sample time. Gains
are judged on the true process, with half a sample for the hold of the controller, by `loop_judge`: integrated error
after a load step over that of the best PID controller with Ms and Mt at most 1.4, and Ms. The optimum is that of
`data/optimum.csv`, searched again from there for the process with this half sample.
A tuning also limits how much the PV's noise may move the output, which the optimum does not: "without that limit" are
the gains for the same model and its 95 % region alone.
A result is silently wrong where Ms exceeds 2, or the loop is unstable, and no warning was given.
A tuning takes two to ten seconds of one core; `--every 6` takes about two minutes for each level of noise.
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

from autotuner.application.computing.analysis import gains_for
from benchmarks.accuracy.cases.virtual_loop import Process, Surroundings, tuned
from benchmarks.baselines.amigo_batch import batch, ultimate
from benchmarks.baselines.loop_judge import iae, sensitivities
from benchmarks.baselines.optimum import FILTERS, RESULT, problem, simplexes

OPTIMA = RESULT
AMPLITUDE = 10.0
"""Relay amplitude of the default settings, output units."""
WRONG_MS = 2.0
GRID = np.geomspace(0.05, 0.6, 6), np.geomspace(0.2, 4.0, 6), np.geomspace(0.02, 0.5, 4)
"""`Kp` over `Ku`, `Ti` and `Td` over `Pu` from which the search for the optimum starts without a PID controller."""
NEAR: tuple[float, ...] = (0.1, 0.03, 0.01)
FAR: tuple[float, ...] = (0.3, *NEAR)
"""Sizes of the simplexes from gains near the optimum, and from the grid; in logarithms."""


@dataclass(frozen=True)
class Result:
    """What became of a tuning; `error` over the optimum, and duration in ultimate periods."""

    name: str
    code: str
    error: float = math.nan
    Ms: float = math.nan
    periods: float = math.nan
    warnings: tuple[str, ...] = ()
    model: str = ""
    seconds: float = math.nan
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
        told = "REFUSED" if self.refused else f"{self.error:.3f} ({self.unlimited[0]:.3f}) Ms {self.Ms:.3f}"
        spent = f"{self.periods:.1f} periods, {self.seconds:.1f} s"
        return f"  {self.name:16s} {told}, {spent}, {self.code} {self.model} {list(self.warnings)}"


def best_error(process: Any, known: list[float]) -> float:
    """Return the error of the optimal controller of a process near one whose optimum has the gains `known`.

    A PID controller is where the search starts; from a P or PI controller there is no way by logarithms, and it starts
    from the best of a grid.
    """
    Ku, Pu = ultimate(process)
    cost, gains, _ = problem(process, FILTERS["filtered"])
    if known[2] > 0.0 and known[1] < math.inf:
        start, sizes = np.log(np.array(known) / (Ku, Pu, Pu)) - (0.1, 0.0, 0.0), NEAR
    else:
        start, sizes = min((np.log(point) for point in itertools.product(*GRID)), key=cost), FAR
    return float(iae(process, gains(simplexes(cost, start, sizes)), Pu))


def judged(process: Any, scale: float, gain: float, dt: float, found: Any, known: list[float]) -> tuple[float, float]:
    """Return integrated error over the optimum, and Ms, of gains on the true process."""
    Pu = ultimate(process)[1]
    own = (found.Kp * gain, found.Ti / scale, found.Td / scale, found.Tf / scale)
    sampled = replace(process, D=process.D + dt / scale / 2.0)
    Ms, _, stable = sensitivities(sampled, own, Pu)
    return (iae(sampled, own, Pu) / best_error(sampled, known), Ms) if stable else (math.inf, math.inf)


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
    error, Ms = judged(process, scale, gain, dt, analysis.gains.gains, known)
    model = str(analysis.identification.structure)
    unlimited = judged(process, scale, gain, dt, gains_for(analysis.identification, sample_time_s=dt).gains, known)
    return Result(process.name, "done", error, Ms, periods, tuple(tuning.warnings), model, seconds, unlimited)


def table(title: str, results: list[Result]) -> None:
    """Print the figures of a level of noise."""
    done = [r for r in results if not r.refused]
    if not done:
        print(f"{title}: {len(results)} tunings, all refused")
        return
    error, Ms = np.array([r.error for r in done]), np.array([r.Ms for r in done])
    good = [r for r in done if r.Ms <= 1.6]
    shares = [float(np.percentile(error, q)) for q in (50, 90, 100)]
    refused, silent = len(results) - len(done), sum(r.silent for r in done)
    print(f"{title}: {len(results)} tunings, {refused} refused, {silent} silently wrong")
    print(f"  error over the optimum: median {shares[0]:.3f}, p90 {shares[1]:.3f}, worst {shares[2]:.3f}")
    free = np.array([r.unlimited for r in done])
    shares = [float(np.percentile(free[:, 0], q)) for q in (50, 90, 100)]
    print(
        f"  without the limit of the output's movement: median {shares[0]:.3f}, p90 {shares[1]:.3f}, "
        f"worst {shares[2]:.3f}, Ms p97.5 {np.percentile(free[:, 1], 97.5):.3f}"
    )
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
