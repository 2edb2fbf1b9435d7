"""Two loops that disturb each other, tuned from their records, against rules of the literature.

    OMP_NUM_THREADS=1 python benchmarks/accuracy/tuning/interaction.py [--seeds 3] [--first 100]

Pairs: the two heaters of `autotuner_sim.coupled`, and the distillation column of Wood and Berry (Chem. Eng. Sci. 28,
1973; minutes as seconds). Each loop is tuned by the product's experiment while the other one is in manual and its PV is
recorded; `analyse_pair` gives gains for each loop alone, detuned, and with a decoupler. The rules get the true
processes, each loop by itself, and are detuned until Ms and Mt are at most 1.6 with both loops closed.

Judged on the simulator: integrated error of both PVs, each over its loop's static gain, after a unit load step at the
first process and, in another run, at the second one; the sum over that of the detuned gains. `Ms` is the larger one of
the two loops with both closed, on the true processes. Noise is 0.5 % of the motion.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from autotuner.application.analysis.pair_analysis import PairAnalysis, analyse_pair
from autotuner.core.design import DesignSpec, PidGains, apply_rule
from autotuner.core.design.interaction import Pair, Remedy, detuned, interaction
from autotuner.core.design.simulation.pid import PidSettings, started, step
from autotuner.core.experiment.experiment import Experiment
from autotuner.core.experiment.phases import Phase
from autotuner.core.experiment.settings import ExperimentSettings, Limits
from autotuner.core.model.process import Fopdt, ProcessModel, SopdtOverdamped
from autotuner.core.recording import Recording, Sample
from autotuner.errors import InputError
from autotuner_sim import Fopdt as SimFopdt
from autotuner_sim import LoadStep, Noise, SteppedPlant
from autotuner_sim import SopdtOverdamped as SimSopdt
from autotuner_sim.coupled import BOARD, TWO_HEATERS, coupled_plants

LIMIT = 1.6
RULES = ("simc_pi", "simc_pid", "amigo_pi", "amigo_pid", "ziegler_nichols_pid")
OUTPUT0 = (40.0, 40.0)


@dataclass(frozen=True)
class Case:
    name: str
    own: tuple[SimFopdt, SimFopdt]
    cross: tuple[SimSopdt, SimSopdt]
    dt: float
    duration_s: float


CASES = (
    Case("two heaters", TWO_HEATERS, BOARD, 2.0, 1500.0),
    Case(
        "Wood and Berry",
        (SimFopdt(12.8, 16.7, 1.0), SimFopdt(-19.4, 14.4, 3.0)),
        (SimSopdt(-18.9, 21.0, 0.0, 3.0), SimSopdt(6.6, 10.9, 0.0, 7.0)),
        0.25,
        300.0,
    ),
)


def record(case: Case, which: int, seed: int) -> Recording:
    """Return the record of a loop's test, with the PV of the other loop."""
    sigmas = [0.005 * 10.0 * abs(own.K) for own in case.own]
    noises = [[Noise(sigma, seed=2 * seed + k)] for k, sigma in enumerate(sigmas)]
    plants = coupled_plants(case.own, case.cross, output0=OUTPUT0, sensors=(noises[0], noises[1]))
    mine, other = plants[which], plants[1 - which]
    limits = Limits(output=(0.0, 100.0))
    settings = ExperimentSettings(case.dt, limits, direct=case.own[which].K > 0.0)
    experiment, output = Experiment(settings, OUTPUT0[which]), OUTPUT0[which]
    samples, others = [], []
    for k in range(100_000):
        for plant in plants:
            plant.advance(k * case.dt)
        pv = mine.measure()
        command = experiment.step(Sample(k * case.dt, pv, output))
        if command.phase is Phase.RESTORE:
            break
        mine.output = output = command.output
        samples.append(Sample(k * case.dt, pv, output))
        others.append(other.measure())
    if experiment.verdict is not None:
        raise InputError(experiment.verdict.message, field="experiment", remedy=experiment.verdict.remedy)
    return replace(Recording.from_samples(samples), extra={"other": np.array(others)})


def true_pair(case: Case, gains: tuple[PidGains, PidGains]) -> Pair:
    """Return the true processes, with half a sample for the hold of the controller."""
    half_s = case.dt / 2.0
    first, second = (Fopdt(own.K, own.T, own.D + half_s) for own in case.own)
    on_first, on_second = (SopdtOverdamped(g.K, g.T1, g.T2, g.D + half_s) for g in case.cross)
    return Pair(first, second, on_first, on_second, gains)


def error(case: Case, gains: tuple[PidGains, PidGains], decoupler: tuple[float, float] | None) -> float:
    """Return the integrated error of both PVs after a load step at each process."""
    return sum(_after_load(case, gains, decoupler or (0.0, 0.0), at) for at in (0, 1))


def _after_load(case: Case, gains: tuple[PidGains, PidGains], decoupler: tuple[float, float], at: int) -> float:
    load = [LoadStep(0.0, 1.0)]
    plants = coupled_plants(case.own, case.cross, loads=(load, []) if at == 0 else ([], load))
    settings = [PidSettings(one) for one in gains]
    states = [started(one, -case.dt, 0.0, 0.0, 0.0) for one in settings]
    total = 0.0
    for k in range(round(case.duration_s / case.dt)):
        pv = [_pv_at(plant, k * case.dt) for plant in plants]
        total += case.dt * sum(abs(y) / abs(own.K) for y, own in zip(pv, case.own, strict=True))
        states = [step(s, state, k * case.dt, y, 0.0) for s, state, y in zip(settings, states, pv, strict=True)]
        v1, v2 = (state.output for state in states)
        plants[0].output, plants[1].output = v1 + decoupler[0] * v2, v2 + decoupler[1] * v1
    return total if abs(pv[0]) + abs(pv[1]) < abs(case.own[0].K) + abs(case.own[1].K) else math.inf


def _pv_at(plant: SteppedPlant, t: float) -> float:
    plant.advance(t)
    return plant.pv


def by_rule(case: Case, rule: str) -> Remedy | None:
    """Return a rule's gains for the true processes, detuned; None where the rule does not apply."""
    models: list[ProcessModel] = [true_pair(case, (PidGains(1.0), PidGains(1.0))).first]
    models.append(true_pair(case, (PidGains(1.0), PidGains(1.0))).second)
    try:
        first, second = (apply_rule(rule, model).gains for model in models)
        return detuned(true_pair(case, (first, second)), LIMIT)
    except InputError:
        return None


def line(case: Case, name: str, gains: Any, decoupler: tuple[float, float] | None, best: float) -> str:
    pair = true_pair(case, gains)
    try:
        worst = interaction(pair).worst if decoupler is None else math.nan
    except InputError:
        worst = math.inf
    ratio = error(case, gains, decoupler) / best
    return f"  {name:30s} {ratio:8.2f}  {'' if math.isnan(worst) else f'{worst:.2f}'}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=100)
    args = parser.parse_args()
    for case in CASES:
        print(f"{case.name:32s} error     Ms")
        for seed in range(args.first, args.first + args.seeds):
            records = record(case, 0, seed), record(case, 1, seed)
            found: PairAnalysis = analyse_pair(records, spec=DesignSpec(), limit=LIMIT)
            truth = interaction(true_pair(case, found.pair.gains)).relative_gain
            print(f"  seed {seed}: relative gain {found.interaction.relative_gain:.3f}, true {truth:.3f}")
            slowed = found.remedies["detuned"]
            assert isinstance(slowed, Remedy)
            best = error(case, slowed.gains, None)
            print(line(case, "each loop alone", found.pair.gains, None, best))
            print(line(case, f"detuned by {slowed.detuning:.2f}", slowed.gains, None, best))
            other = found.remedies["decoupled"]
            if isinstance(other, Remedy):
                print(line(case, f"decoupled, detuned by {other.detuning:.2f}", other.gains, other.decoupler, best))
        for rule in RULES:
            if (remedy := by_rule(case, rule)) is not None:
                print(line(case, f"{rule}, detuned by {remedy.detuning:.2f}", remedy.gains, None, best))


if __name__ == "__main__":
    main()
