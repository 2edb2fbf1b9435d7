"""The search for what a model lacks.

    1 base      every structure alone, the best by the criterion
    2 screen    every start of every effect by its linearised score; the best few are fitted on thinned samples
    3 fit       the best candidates on all fitted samples, jointly with the process
    4 beam      the same again with the best few as the base, for a second and a third effect; an effect that is no
                longer needed leaves

    criterion   n ln(S/N + floor^2) + p ln n + price,   n = N / inflation of the best residual

(Schwarz 1978, with as many independent samples as the colour of what remains leaves.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended import Extended, Fitted, fit, linearised
from autotuner.core.identification.candidate import MANY_STRUCTURES
from autotuner.core.identification.data import ANY_GAIN
from autotuner.core.identification.starts import scan
from autotuner.core.identification.structures import FOPDT, INTEGRATING, PURE_INTEGRATOR, SECOND_ORDER, UNSTABLE
from autotuner.core.signals.noise import inflation
from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.arrays import FloatArray, IntArray
    from autotuner.core.diagnosis.case import Case
    from autotuner.core.diagnosis.effect import Effect
    from autotuner.core.identification.structures import Structure

SCREEN_SAMPLES = 250
COARSE_SAMPLES = 450
MOST_SAMPLES = 2500
STARTS_KEPT = 2
"""Starts of an effect from which a few steps are taken."""
QUICK_STEPS, COARSE_STEPS, FINE_STEPS = 5, 15, 30
FITTED_COARSELY, FITTED_FULLY = 10, 6
"""Candidates fitted on more, and on all samples."""
BETTER, FAR = 0.87, 0.5
"""Misfit over that of the pair of lags under which a process that integrates, or one that runs away, is tried too."""
BEAM = 3
"""Explanations that are carried on to a further effect."""


@dataclass(frozen=True, slots=True, eq=False)
class Bench:
    """What candidates are compared on: the case and its samples, thinned three ways."""

    case: Case
    screen: IntArray
    coarse: IntArray
    fine: IntArray
    held_out: IntArray

    def criterion(self, candidate: Fitted, inflated: float) -> float:
        """Return the information criterion of a candidate, with the colour of the best residual."""
        return criterion(candidate, inflated, self.case.floor)

    def held_out_residual(self, candidate: Fitted) -> FloatArray:
        """Return measured minus simulated on the part that was not fitted, PV."""
        residual: FloatArray = self.case.data.pv[self.held_out] - candidate.simulated(self.held_out)
        return residual


def bench_of(case: Case) -> Bench:
    """Return a case with its samples thinned."""
    rows = np.flatnonzero(case.fitted)
    return Bench(
        case,
        thinned(rows, SCREEN_SAMPLES),
        thinned(rows, COARSE_SAMPLES),
        thinned(rows, MOST_SAMPLES),
        thinned(np.flatnonzero(case.held_out), MOST_SAMPLES),
    )


def thinned(rows: IntArray, most: int) -> IntArray:
    """Return `most` of the rows at most, evenly."""
    if rows.size <= most:
        return rows
    picked: IntArray = rows[np.unique(np.linspace(0, rows.size - 1, most).astype(int))]
    return picked


def criterion(candidate: Fitted, inflated: float, floor: float) -> float:
    """Return `n ln(S/N + floor^2) + p ln n + price`."""
    independent = max(candidate.residual.size / inflated, 4.0)
    return (
        independent * math.log(candidate.mean_square + floor**2)
        + candidate.size * (math.log(independent) + MANY_STRUCTURES / 2.0)
        + 2.0 * candidate.price
    )


def colour(candidate: Fitted, floor: float) -> float:
    """Return how many samples of what a candidate leaves are worth one."""
    return 1.0 if candidate.rms <= floor else inflation(candidate.residual)


def base_fit(bench: Bench, structures: Sequence[Structure], background: tuple[str, ...]) -> list[Fitted]:
    """Return each structure alone, fitted on all samples, the best first."""
    found = []
    for structure in structures:
        problem = Extended(bench.case, structure, (), bench.coarse, background)
        starts = [
            np.array([*np.log(s.shape), s.delay_s / problem.unit_s])
            for s in scan(_fitted_data(bench), structure, ("offset",), ANY_GAIN)[:3]
        ]
        coarse = min((fit(problem, start, COARSE_STEPS) for start in starts), key=lambda c: c.mean_square)
        fine = fit(replace(problem, rows=bench.fine), coarse.theta, FINE_STEPS)
        if is_physical(fine):
            found.append(fine)
    inflated = min((colour(c, bench.case.floor) for c in found), default=1.0)
    return sorted(found, key=lambda c: bench.criterion(c, inflated))


def _fitted_data(bench: Bench):  # type: ignore[no-untyped-def]
    case = bench.case
    rows = bench.coarse
    return replace(case.data, t=case.data.t[rows], pv=case.data.pv[rows], weight=np.ones(rows.size))


def is_physical(candidate: Fitted) -> bool:
    """Return whether it is a process model at all."""
    try:
        candidate.process()
    except (InputError, ValueError, OverflowError):
        return False
    return math.isfinite(candidate.mean_square)


def families(bases: Sequence[Fitted]) -> list[Fitted]:
    """Return the structures worth extending: the free pair of lags, and one that does not settle if it fits better."""
    pair = next((b for b in bases if b.problem.structure is SECOND_ORDER), None)
    others = [b for b in bases if b.problem.structure not in {FOPDT, SECOND_ORDER}]
    if pair is None:
        return list(bases[:1])
    better = [
        b
        for b in others
        if b.rms < BETTER * pair.rms and (b.problem.structure is not UNSTABLE or b.rms < FAR * pair.rms)
    ]
    return [pair, *better[:1]]


def extend(bench: Bench, bases: Sequence[Fitted], effects: Sequence[Effect]) -> list[Fitted]:
    """Return the bases with one effect more, the most promising fitted on all samples, the best first."""
    tried = [
        (base, effect, starts)
        for base in bases
        for effect in effects
        if _fits_beside(effect, base.problem.effects) and (starts := _screened(bench, base, effect))
    ]
    quick = [(_quick(bench, base, effect, starts), base, effect) for base, effect, starts in tried]
    promising = sorted(((c, b, e) for c, b, e in quick if c is not None), key=lambda row: row[0].mean_square)
    coarse = [
        fit(replace(c.problem, rows=bench.coarse), c.theta, COARSE_STEPS) for c, _, _ in promising[:FITTED_COARSELY]
    ]
    coarse = sorted((c for c in coarse if is_physical(c)), key=lambda c: c.mean_square)
    fine = [refined(bench, c) for c in coarse[:FITTED_FULLY]]
    return sorted((c for c in fine if is_physical(c)), key=lambda c: c.mean_square)


def _screened(bench: Bench, base: Fitted, effect: Effect) -> list[FloatArray]:
    """Return the starts of an effect with the best linearised scores."""
    problem = _problem(bench, base, effect)
    starts = [_theta(base, problem, effect, start) for start in effect.starts]
    if len(starts) > STARTS_KEPT:
        scores = [linearised(problem, theta) for theta in starts]
        starts = [starts[k] for k in np.argsort(scores)[:STARTS_KEPT]]
    return starts


def _problem(bench: Bench, base: Fitted, effect: Effect) -> Extended:
    effects = tuple(sorted((*base.problem.effects, effect), key=lambda e: e.order))
    return replace(base.problem, effects=effects, rows=bench.screen)


def _quick(bench: Bench, base: Fitted, effect: Effect, starts: Sequence[FloatArray]) -> Fitted | None:
    """Return the best of a few steps from each start; None when the effect does nothing here."""
    problem = _problem(bench, base, effect)
    fits = [fit(problem, theta, QUICK_STEPS) for theta in starts]
    best = min(fits, key=lambda f: f.mean_square)
    row = [e is effect for e in problem.effects].index(True)
    idle = effect.position is None and effect.response is None and best.counts[row] == 0
    return None if idle else best


def _fits_beside(effect: Effect, others: Sequence[Effect]) -> bool:
    clash = any(o.key == effect.key or (o.name == effect.name and not o.name.startswith("load")) for o in others)
    two_responses = effect.response is not None and any(o.response is not None for o in others)
    return not clash and not two_responses


def _theta(base: Fitted, problem: Extended, effect: Effect, start: Sequence[float]) -> FloatArray:
    """Return the base's `theta` with the start of one effect at its place among the others."""
    size = len(problem.structure.shape) + 1
    _, _, values = base.problem.split(base.theta)
    known = {e.key: v for e, v in zip(base.problem.effects, values, strict=True)}
    parts = [known.get(e.key, list(start)) if e is not effect else list(start) for e in problem.effects]
    return np.concatenate([base.theta[:size], *(np.array(p, dtype=np.float64) for p in parts)])


def refined(bench: Bench, candidate: Fitted) -> Fitted:
    """Return a candidate fitted on all samples."""
    return fit(replace(candidate.problem, rows=bench.fine), candidate.theta, FINE_STEPS)


def without(bench: Bench, candidate: Fitted, dropped: Effect) -> Fitted:
    """Return a candidate refitted without one of its effects."""
    left = tuple(e for e in candidate.problem.effects if e is not dropped)
    size = len(candidate.problem.structure.shape) + 1
    _, _, values = candidate.problem.split(candidate.theta)
    parts = [np.array(v) for e, v in zip(candidate.problem.effects, values, strict=True) if e is not dropped]
    theta = np.concatenate([candidate.theta[:size], *parts])
    return fit(replace(candidate.problem, effects=left, rows=bench.fine), theta, FINE_STEPS)


STRUCTURES: tuple[Structure, ...] = (FOPDT, SECOND_ORDER, PURE_INTEGRATOR, INTEGRATING, UNSTABLE)
