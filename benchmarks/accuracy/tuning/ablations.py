"""Where a learned answer helps a tuning: each use with it and without it, and what it costs.

    OMP_NUM_THREADS=1 python -m benchmarks.accuracy.tuning.ablations [starts] [early] [classifier] [--plants N]
                                                                     [--seed 1]

starts      running least squares after each of the half periods 2 to 6 of a relay from rest: from a scan of shapes and
            dead times, and from the learned correction's model. The reference starts from the true process. A fit is
            missed where the reference explains the PV, and the fit does not, needs a second lag that the reference does
            not, or leaves more than 0.5 % above its residual
early       gains after two and after three half periods: from the describing function alone (rule of Tyreus and Luyben
            on the ultimate point; SIMC on its first-order model), from the learned correction (the product's early
            gains, and SIMC without their caution), from running least squares, and SIMC on the true process. The static
            gain is the asymmetry's, or that of running least squares one half period earlier, for both. Judged by
            `loop_judge` on the true process with half a sample for the hold: integrated error after a load step over
            that of the best PID controller with Ms and Mt at most 1.4, and Ms
classifier  a network on the shape of the wave that tells at most two lags, equal lags and third order apart, trained
            here on records with seeds of their own, as a filter of the structures that `identify` fits: equal lags, or
            third order, are left out where it takes them for unlikely. The oracle is a filter that knows the truth

Without a name all are run. Plants are drawn evenly over the thesis's ranges (`learned.plant_of`), off the grid that it
trained on; those of three and more lags by `higher_order.drawn`. `autotuner_sim` moves them, 100 samples a period, with
white noise. Neither these plants nor these seeds were trained on. Times are processor times of one core.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
import warnings
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import numpy as np
from sklearn.neural_network import MLPClassifier
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from autotuner.application.analysis.early_gains import RULES, with_gains
from autotuner.core.design.gains import PidGains
from autotuner.core.design.rules.tuning_rules import apply_rule
from autotuner.core.design.rules.ultimate import UltimatePoint
from autotuner.core.estimation.least_squares import fit
from autotuner.core.estimation.simulation import misfit, simulate_fit
from autotuner.core.identification import identify, measure_limit_cycle, running_learned, running_model
from autotuner.core.identification.learned.correction import LearnedModels, shape_features
from autotuner.core.identification.limit_cycle.from_cycle import by_describing_function, static_gain
from autotuner.core.identification.limit_cycle.relay_harmonics import wave_of
from autotuner.core.model.process import model_from_dict
from autotuner.core.model.structures import N_LAGS, THIRD_ORDER, searched
from autotuner.core.signals.limit_cycle import driving_fundamental, relay_switches, replayed, without_chatter
from autotuner.errors import InputError
from autotuner_models.learned.artefacts import SHIPPED, load
from benchmarks.accuracy.estimates.higher_order import KINDS as HIGHER_KINDS
from benchmarks.accuracy.estimates.higher_order import drawn, recorded
from benchmarks.accuracy.estimates.learned import plant_of, record
from benchmarks.accuracy.tuning.gains import best_error
from benchmarks.baselines.amigo_batch import Process, lag, ultimate
from benchmarks.baselines.loop_judge import iae, sensitivities

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.core.identification import RunningModel
    from autotuner.core.model.structures import Structure
    from autotuner.core.recording import Recording

STRUCTURES = ("fopdt", "sopdt_overdamped", "sopdt_underdamped", "integrating")
DECIBELS = (40.0, 20.0)
HALF_PERIODS = (2, 3, 4, 5, 6)
SAME = 1.005
"""Residual over that of the reference up to which a fit ended in the same minimum."""
EARLY = (2, 3)
UNSAFE_MS = 2.0
FUNCTION, CORRECTED = "describing function, SIMC", "learned, SIMC"
TRAINED_ON, LAYERS, PER_KIND = 7_000_003, (64, 64), 150
"""Seed of the classifier's records, its layers, and how many records it has of each kind of process."""
FAMILIES: dict[str, tuple[Structure, ...]] = {"n_lags": N_LAGS, "third_order": (THIRD_ORDER,)}
"""What the classifier may leave out, by the beginning of a kind's name."""
ALL: frozenset[str] = frozenset()
SELECTION = "autotuner.core.identification.selection"
LOW_KINDS = ("fopdt", "sopdt_overdamped", "sopdt_underdamped")
SHORT_DEAD_TIMES = 0.02, 0.5
"""Dead time over the sum of lags, as `higher_order.drawn` has it."""
THRESHOLDS = (0.3, 0.03)
"""Probabilities of a family below which it is not fitted."""


def clocked(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """Return an answer and its processor time, ms."""
    began = time.process_time()
    answer = function(*arguments)
    return answer, 1e3 * (time.process_time() - began)


def sigma_of(recording: Recording) -> float:
    """Return the noise that was added to a record."""
    sigma = recording.settings["noise_sigma"]
    assert isinstance(sigma, float)
    return sigma


def model_of(plant: Any) -> Any:
    """Return a simulated plant as a model of the tuner."""
    names = ("K", "m", "n", "T", "T1", "T2", "D")
    return model_from_dict(
        {name: getattr(plant, name) for name in names if hasattr(plant, name)}, plant_structure(plant)
    )


def plant_structure(plant: Any) -> str:
    return {"Fopdt": "fopdt", "Integrating": "integrating"}.get(type(plant).__name__) or (
        "sopdt_underdamped" if hasattr(plant, "m") else "sopdt_overdamped"
    )


# --- 1: initial guesses ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Fit:
    """One running fit: time, and whether it missed what the reference found."""

    ms: float
    missed: bool


def starts(plants: int, seed: int, models: LearnedModels) -> None:
    """Print time and misses of running least squares without and with the learned start."""
    print("| process | dB | fits | learned answers | without: median, p95 | missed | with: median, p95 | missed |")
    print("|---|---|---|---|---|---|---|---|")
    every: list[tuple[Fit, Fit]] = []
    for structure in STRUCTURES:
        for decibels in DECIBELS:
            rng, pairs, answered = np.random.default_rng([seed, STRUCTURES.index(structure)]), [], 0
            for number in range(plants):
                plant = plant_of(structure, rng)
                found, answers = streamed(plant, decibels, [seed, number], models)
                pairs, answered = [*pairs, *found], answered + answers
            every += pairs
            total = plants * len(HALF_PERIODS)
            print(f"| {structure} | {decibels:g} | {total} | {answered / total:.0%} | {told(pairs)} |", flush=True)
    print(f"| together | | | | {told(every)} |")


def told(pairs: list[tuple[Fit, Fit]]) -> str:
    """Return the cells of time and misses, without and with, of the fits that had a learned start."""
    cells = []
    for fits in zip(*pairs, strict=True):
        spent = np.array([fit.ms for fit in fits])
        cells.append(f"{np.median(spent):.1f}, {np.percentile(spent, 95):.0f} ms | {sum(fit.missed for fit in fits)}")
    return " | ".join(cells) or "- | - | - | -"


def streamed(plant: Any, decibels: float, seed: Any, models: LearnedModels) -> tuple[list[tuple[Fit, Fit]], int]:
    """Return the fits of one relay test, half period by half period, and how often the learned correction answered."""
    pairs, gain = [], None
    for half_periods in HALF_PERIODS:
        recording = record(plant, half_periods, decibels, seed)
        sigma = sigma_of(recording)
        learned = running_learned(recording, sigma, models, gain)
        reference = running_model(recording, sigma, model_of(plant))
        begun = None if learned is None else learned.model
        found = [
            judged_fit(recording, sigma, start, reference) for start in ((None,) if begun is None else (None, begun))
        ]
        if begun is not None:
            pairs.append((found[0][0], found[1][0]))
        latest = found[-1][1]
        gain = gain if latest is None else (latest.model.K, latest.standard_error["K"])
    return pairs, len(pairs)


def judged_fit(
    recording: Recording, sigma: float, begun: Any, reference: RunningModel | None
) -> tuple[Fit, RunningModel | None]:
    """Return one fit and what it found."""
    found, ms = clocked(running_model, recording, sigma, begun)
    if reference is None:
        return Fit(ms, missed=False), found
    if found is None:
        return Fit(ms, missed=True), None
    more = len(found.model.parameters()) > len(reference.model.parameters())
    worse = residual(found, recording) > SAME * residual(reference, recording)
    return Fit(ms, missed=more or worse), found


def residual(running: RunningModel, recording: Recording) -> float:
    """Return the root mean square of what a model leaves."""
    return misfit(recording.pv, simulate_fit(running.model, recording))[0]


# --- 2: early gains -------------------------------------------------------------------------------------------------


def early(plants: int, seed: int, models: LearnedModels) -> None:
    """Print the loss of early gains by half periods, noise and source."""
    print("| half periods | dB | source | answered | error over the optimum: median, p90 | Ms: median, p90 | Ms > 2 |")
    print("|---|---|---|---|---|---|---|")
    drawn_plants = []
    for structure in STRUCTURES:
        rng = np.random.default_rng([seed, 50 + STRUCTURES.index(structure)])
        drawn_plants += [plant_of(structure, rng) for _ in range(plants)]
    optima = [Optimum(process_of(plant)) for plant in drawn_plants]
    for half_periods in EARLY:
        for decibels in DECIBELS:
            losses: dict[str, list[tuple[float, float] | None]] = {}
            for number, (plant, optimum) in enumerate(zip(drawn_plants, optima, strict=True)):
                recording, gain = begun_record(plant, half_periods, decibels, [seed, number])
                for source, gains in early_sources(recording, gain, plant, models).items():
                    judged = None if gains is None else optimum.loss(gains, recording.sample_interval_s)
                    losses.setdefault(source, []).append(judged)
            show_losses(f"{half_periods} | {decibels:g}", losses)


def show_losses(case: str, losses: dict[str, list[tuple[float, float] | None]]) -> None:
    """Print a line for each source, and for two of them on the records that both answer."""
    for source, found in losses.items():
        print(f"| {case} | {source} | {loss_cells(found)} |", flush=True)
    both = [pair for pair in zip(losses[FUNCTION], losses[CORRECTED], strict=True) if None not in pair]
    for k, source in enumerate((FUNCTION, CORRECTED)):
        cells = loss_cells([pair[k] for pair in both])
        print(f"| {case} | {source}, of the {len(both)} that both answer | {cells} |", flush=True)


def loss_cells(found: list[tuple[float, float] | None]) -> str:
    """Return the cells of one line; a loop that is not stable has an infinite loss."""
    values = np.array([result for result in found if result is not None]).reshape(-1, 2)
    if not values.size:
        return "0% | | |"
    middle, tail = (np.percentile(values, q, axis=0, method="higher") for q in (50, 90))
    unsafe = int((values[:, 1] > UNSAFE_MS).sum())
    return (
        f"{len(values) / len(found):.0%} | {middle[0]:.2f}, {tail[0]:.2f} | {middle[1]:.2f}, {tail[1]:.2f} | "
        f"{unsafe} of {len(values)}"
    )


@dataclass
class Optimum:
    """The judge of gains for one process; the optimum is searched once for each sample interval."""

    process: Process
    best: dict[float, float] = field(default_factory=dict)

    def loss(self, gains: PidGains, dt: float) -> tuple[float, float]:
        """Return integrated error over the optimum, and Ms; infinite for an unstable loop."""
        sampled, Pu = replace(self.process, D=self.process.D + dt / 2.0), ultimate(self.process)[1]
        if dt not in self.best:
            self.best[dt] = best_error(sampled, [0.0, 0.0, 0.0])
        own = (gains.Kp, gains.Ti, gains.Td, gains.Tf)
        Ms, _, stable = sensitivities(sampled, own, Pu)
        return (iae(sampled, own, Pu) / self.best[dt], Ms) if stable else (math.inf, math.inf)


def begun_record(
    plant: Any, half_periods: int, decibels: float, seed: Any
) -> tuple[Recording, tuple[float, float] | None]:
    """Return a record, and the static gain that running least squares found one half period earlier."""
    earlier = record(plant, half_periods - 1, decibels, seed) if half_periods > EARLY[0] else None
    known = None if earlier is None else running_model(earlier, sigma_of(earlier))
    gain = None if known is None else (known.model.K, known.standard_error["K"])
    return record(plant, half_periods, decibels, seed), gain


def early_sources(
    recording: Recording, gain: tuple[float, float] | None, plant: Any, models: LearnedModels
) -> dict[str, PidGains | None]:
    """Return the gains of each source for a record that has just begun; None where it has none."""
    sigma, dt = sigma_of(recording), recording.sample_interval_s
    running = running_learned(recording, sigma, models, gain)
    learned = with_gains(running, dt)
    fitted = with_gains(running_model(recording, sigma, None if running is None else running.model), dt)
    cycle = measure_limit_cycle(recording)
    df = by_describing_function(
        cycle, static_gain(recording, cycle, None if gain is None else gain[0], None), None, "fopdt"
    ).model
    return {
        "describing function, Tyreus-Luyben": of_ultimate_point(recording),
        FUNCTION: simc(df, dt),
        "learned, as offered": offered(learned),
        CORRECTED: simc(None if running is None else running.model, dt),
        "least squares, as offered": offered(fitted),
        "true process, SIMC": simc(model_of(plant), dt),
    }


def offered(running: RunningModel | None) -> PidGains | None:
    """Return the product's early gains of a running model."""
    if running is None or running.gains is None:
        return None
    Kp, Ti, Td, Tf = (float(str(running.gains[name])) for name in ("Kp", "Ti", "Td", "Tf"))
    return PidGains(Kp, Ti, Td, Tf)


def simc(model: Any, dt: float) -> PidGains | None:
    """Return the gains of the same rule for the model as it is."""
    if model is None:
        return None
    try:
        return apply_rule(RULES[type(model)], model, tau_c_s=max(model.D, dt)).gains
    except InputError:
        return None


def of_ultimate_point(recording: Recording) -> PidGains | None:
    """Return PI gains from the fundamentals of the latest cycle, which need no static gain."""
    switches = without_chatter(recording.t, relay_switches(recording.output))
    if switches.size < 3:
        return None
    latest = replayed(recording.t, recording.pv, recording.output, switches)[-1]
    response = latest.phasor / driving_fundamental(recording, switches[-3:])
    return apply_rule("tyreus_luyben_pi", ultimate=UltimatePoint(1.0 / abs(response), latest.period_s)).gains


def process_of(plant: Any) -> Process:
    """Return a plant as a process of the judge."""
    factors = {
        "fopdt": lambda: (lag(plant.T),),
        "sopdt_overdamped": lambda: (lag(plant.T1), lag(plant.T2)),
        "sopdt_underdamped": lambda: ((1.0, plant.n, plant.m),),
        "integrating": lambda: ((0.0, 1.0), lag(plant.T)),
    }
    structure = plant_structure(plant)
    return Process(structure, structure, plant.K, (), factors[structure](), plant.D)


# --- 3: a classifier as a filter of structures ----------------------------------------------------------------------


def classifier(plants: int, seed: int, _models: LearnedModels) -> None:
    """Print what a filter of structures saves, and what it loses."""
    (network, share), ms = clocked(trained)
    print(f"trained in {ms / 1e3:.0f} s, seed {TRAINED_ON}: right on {share:.0%} of its own records\n")
    print("| process | dB | filter | right structure | right without it only | mean fits | mean time |")
    print("|---|---|---|---|---|---|---|")
    everything: list[Filtered] = []
    for kind in (*LOW_KINDS, *HIGHER_KINDS):
        for decibels in DECIBELS:
            processes = processes_of(kind, plants, seed)
            rows = [row_of(network, kind, one, decibels, (seed, n)) for n, one in enumerate(processes)]
            everything += rows
            show_filters(kind, f"{decibels:g}", rows)
    show_filters("together", "", everything)
    costs = np.median([row.filter_ms for row in everything])
    print(f"\nthe filter itself: {costs:.2f} ms, median")


def show_filters(kind: str, decibels: str, rows: list[Filtered]) -> None:
    """Print a line for each filter: none, the network at each threshold, and the oracle."""
    filters = {"none": [frozenset[str]() for _ in rows]}
    for limit in THRESHOLDS:
        filters[f"network under {limit:g}"] = [
            frozenset(family for family in FAMILIES if row.likely[family] < limit) for row in rows
        ]
    filters["oracle"] = [frozenset(family for family in FAMILIES if family != row.family) for row in rows]
    for name, left_out in filters.items():
        right = sum(row.right[which] for row, which in zip(rows, left_out, strict=True))
        spent = [row.ms[which] for row, which in zip(rows, left_out, strict=True)]
        own = np.mean([row.filter_ms for row in rows]) if name.startswith("network") else 0.0
        lost = sum(row.right[ALL] > row.right[which] for row, which in zip(rows, left_out, strict=True))
        fits = np.mean([row.fits[which] for row, which in zip(rows, left_out, strict=True)])
        told = f"{right} of {len(rows)} | {lost} | {fits:.1f} | {np.mean(spent) + own:.0f} ms"
        print(f"| {kind} | {decibels} | {name} | {told} |", flush=True)


def processes_of(kind: str, count: int, seed: int) -> list[Process]:
    """Return processes whose dead times, over their lags, are the same for all kinds: the order alone differs."""
    if kind in HIGHER_KINDS:
        return drawn(kind, count, seed)
    rng, found = np.random.default_rng([seed, 90 + LOW_KINDS.index(kind)]), []
    for _ in range(count):
        process = process_of(plant_of(kind, rng))
        lags = sum(factor[1] for factor in process.denominator)
        found.append(replace(process, D=lags * rng.uniform(*SHORT_DEAD_TIMES)))
    return found


def shape_of(recording: Recording) -> Any:
    """Return the features of a record's wave, without static gain; None where it holds none."""
    wave = wave_of(recording, sigma_of(recording), 1.0)
    return None if wave is None else shape_features(wave)[0]


def trained() -> tuple[Any, float]:
    """Return a network that tells at most two lags, equal lags and third order apart."""
    rng, rows, marks = np.random.default_rng(TRAINED_ON), [], []
    for kind in (*LOW_KINDS, *HIGHER_KINDS):
        for number, process in enumerate(processes_of(kind, PER_KIND, TRAINED_ON)):
            shape = shape_of(recorded(process, rng.uniform(15.0, 45.0), (TRAINED_ON, number))[0])
            if shape is not None:
                rows.append(shape)
                marks.append(family_of(kind))
    network = make_pipeline(StandardScaler(), MLPClassifier(LAYERS, alpha=1e-2, max_iter=2000, random_state=1))
    network.fit(rows, marks)
    return network, float(network.score(rows, marks))


@dataclass(frozen=True)
class Filtered:
    """How likely each family is to the network, and an identification without some of them: time, fits and answer."""

    family: str
    likely: dict[str, float]
    filter_ms: float
    ms: dict[frozenset[str], float]
    fits: dict[frozenset[str], int]
    right: dict[frozenset[str], bool]


def row_of(network: Any, kind: str, process: Process, decibels: float, seed: Any) -> Filtered:
    """Return what the network says of one record, and what identifications of fewer structures make of it."""
    recording, _, _ = recorded(process, decibels, seed)
    likely, filter_ms = clocked(likelihoods, network, recording)
    ms, fits, right = {}, {}, {}
    for count in range(len(FAMILIES) + 1):
        for which in map(frozenset, itertools.combinations(FAMILIES, count)):
            left_out = {structure for family in which for structure in FAMILIES[family]}
            fewer = tuple(structure for structure in searched("auto") if structure not in left_out)
            with patch(f"{SELECTION}.searched", return_value=fewer), patch(f"{SELECTION}.fit", wraps=fit) as fitted:
                found, ms[which] = clocked(identify, recording)
            fits[which], right[which] = fitted.call_count, is_right(kind, process, found)
    return Filtered(family_of(kind), likely, filter_ms, ms, fits, right)


def likelihoods(network: Any, recording: Recording) -> dict[str, float]:
    """Return how likely each family is; all are where the record holds no wave."""
    shape = shape_of(recording)
    if shape is None:
        return dict.fromkeys(FAMILIES, 1.0)
    shares = dict(zip(network.classes_, network.predict_proba([shape])[0].tolist(), strict=True))
    return {family: shares[family] for family in FAMILIES}


def family_of(kind: str) -> str:
    """Return the family of a kind of process; none of them for at most two lags."""
    return next((family for family in FAMILIES if kind.startswith(family)), "low")


def is_right(kind: str, process: Process, found: Any) -> bool:
    """Return whether the structure is the true one, the number of equal lags included."""
    if kind == "n_lags":
        return str(found.structure) == kind and found.model.n == len(process.denominator)
    return str(found.structure).startswith("third_order" if kind in HIGHER_KINDS else kind)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    sections = {"starts": starts, "early": early, "classifier": classifier}
    parser.add_argument("sections", nargs="*", help=f"of {', '.join(sections)}")
    parser.add_argument("--plants", type=int, default=20, help="of each structure")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    models = load(SHIPPED)
    for name in args.sections or sections:
        print(f"\n{name}, --plants {args.plants} --seed {args.seed}\n")
        sections[name](args.plants, args.seed, models)


if __name__ == "__main__":
    main()
