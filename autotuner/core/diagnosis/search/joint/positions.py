"""Updates, stages and steps of an actuator on the record of a loop, fitted together with the process.

A command that moves at every sample is late by half of the update period on average, and the process alone has that in
its dead time: the search for updates begins with that much less. Neither a phase nor a step has a slope, so that others
around are tried beside the process as it then is, ever nearer. (Starts: `position_in_loop`.)

Stages come first, because their search needs no process that is near: a wrong process makes several of one, so that at
first many are merged. Equal steps are then looked for beside the process that the stages leave.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effects.actuator.levels import origin_of
from autotuner.core.diagnosis.effects.actuator.position_in_loop import (
    equal_steps,
    stages_in_loop,
    update_grids_in_loop,
)
from autotuner.core.diagnosis.effects.actuator.stages import unequal_stages
from autotuner.core.diagnosis.effects.actuator.textbook_forms import quantisation, updated_every
from autotuner.core.diagnosis.extended.base import is_physical
from autotuner.core.diagnosis.extended.extended_model import closest_first
from autotuner.core.diagnosis.extended.fitting import ENOUGH_FOR_RANKS, fit
from autotuner.core.diagnosis.search.judge import is_near_noise, is_visible
from autotuner.core.diagnosis.search.search import (
    COARSE_STEPS,
    QUICK_STEPS,
    SAME,
    alone_beside,
    form_of,
    refined,
    with_second_lag,
    within,
)
from autotuner.core.model.structures import FOPDT, SECOND_ORDER

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from autotuner.core.diagnosis.extended.base import Base
    from autotuner.core.diagnosis.extended.effect import Effect
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext
    from autotuner.core.model.arrays import FloatArray

FOLLOWED, NEARER = 3, 0.9
"""Updates, and steps, that are followed on more samples, and error over that of the process alone up to which."""
TIMES = (
    tuple(product((-1.0, -0.4, 0.0, 0.4, 1.0), (-0.15, -0.05, 0.0, 0.05, 0.15))),
    tuple(product((-0.5, -0.25, 0.0, 0.25, 0.5), (-0.08, -0.03, 0.0, 0.03, 0.08))),
    tuple(product((-0.2, -0.1, 0.0, 0.1, 0.2), (-0.02, 0.0, 0.02))),
)
"""Tried around a period, in those by which its phase turns a quarter over half of the record, and around a phase, in
periods; ever nearer."""
ROUNDS = ((1.6, 0.0), (1.3, 0.0), (1.15, 0.0), (1.05, 0.0), (1.0, 0.1), (1.0, 0.1))
"""From one process to the next, the error over that of all stages up to which neighbouring ones are merged, and the
distance of two thresholds, in the largest one, below which they are one: the process is near the right one by then."""
FIRST = 0.7
"""Error of the first stages over that of the process alone from which there are none."""
AGAIN = 3
"""How often updates are searched for again from the process that the ones before leave."""
STEPS = tuple(most * np.linspace(-1.0, 1.0, 61) for most in (0.006, 0.0006, 0.00006))
"""Tried around a step, in it: far from where they count from, a small error of the step is a large one of its level."""


def with_positions(context: FitContext, base: Base, effects: Sequence[Effect]) -> list[Fitted]:
    """Return the process with updates at even times, with stages and with steps; none where no controller moves.

    Stages and steps are looked for beside a straight drift, too: with it and without them, the process is far off.

    Returns
    -------
    list of Fitted
        Fitted on all samples.
    """
    if not context.dataset.in_loop:
        return []
    origins = list({id(o): o for o in (base.best, *base.origins)}.values())
    found = _with_even_updates(context, origins[:2])
    for drifts in (False, True):
        if not any(is_near_noise(context, c) for c in found):
            processes = _with_drift(context, origins[:2], effects) if drifts else origins
            found += _with_stages_or_steps(context, processes)
    nearer = (c for c in found if c.rms < NEARER * base.best.rms)
    return [c for c in (refined(context, f) for f in nearer) if is_physical(c)]


def _with_even_updates(context: FitContext, origins: Sequence[Fitted]) -> list[Fitted]:
    nearest = closest_first(c for o in within(context.dataset.budget, origins) for c in _with_updates(context, o))
    nearest = closest_first([*nearest, *_from_their_process(context, nearest)])
    return [_in_detail(c, _times_around) for c in nearest[:FOLLOWED]]


def _with_stages_or_steps(context: FitContext, origins: Sequence[Fitted]) -> list[Fitted]:
    """Return the best stages, or equal steps in their place, which have fewer numbers; nothing without any stages."""
    staged = [c for o in within(context.dataset.budget, origins) for c in _with_stages(context, o)]
    if not staged:
        return []
    nearest = context.best(staged)
    if is_visible(context, nearest):
        return [nearest]
    stepped = [_in_detail(c, _steps_around) for c in closest_first(_with_steps(context, nearest))[:FOLLOWED]]
    return [context.best([nearest, *stepped])]


def _with_stages(context: FitContext, origin: Fitted) -> list[Fitted]:
    """Return the best of a process with stages, each found from the process beside those before; empty without any."""
    found: list[Fitted] = []
    process, known = origin, np.zeros(0)
    for looseness, nearest in ROUNDS:
        stages = stages_in_loop(process, known, looseness, nearest)
        if stages is None:
            break
        known = stages[0]
        problem = replace(process.problem, effects=(*origin.problem.effects, unequal_stages(context.dataset, *stages)))
        candidate = fit(replace(problem, rows=context.coarse), np.concatenate((process.theta, known)), COARSE_STEPS)
        found.append(with_two_lags(candidate))
        if found[0].rms > FIRST * origin.rms:
            return []
        process = alone_beside(context, found[-1], *origin.problem.effects)
    return [context.best(found)] if found else []


def with_two_lags(candidate: Fitted) -> Fitted:
    """Return a candidate with a second lag where that is closer."""
    if candidate.problem.structure is not FOPDT:
        return candidate
    pair = fit(replace(candidate.problem, structure=SECOND_ORDER), with_second_lag(candidate.theta), COARSE_STEPS)
    return pair if SAME * pair.rms < candidate.rms else candidate


def _with_drift(context: FitContext, origins: Sequence[Fitted], effects: Sequence[Effect]) -> list[Fitted]:
    """Return the processes beside a straight drift where that is closer."""
    drift = form_of(effects, "drift")
    if drift is None:
        return []
    beside = [fit(replace(o.problem, effects=(drift,), rows=context.coarse), o.theta, COARSE_STEPS) for o in origins]
    return [found for o, found in zip(origins, beside, strict=True) if SAME * found.rms < o.rms]


def _from_their_process(context: FitContext, nearest: Sequence[Fitted]) -> list[Fitted]:
    """Return updates that are found again from the process beside the nearest: the one alone may be far from it."""
    found: list[Fitted] = []
    for _ in range(AGAIN):
        if not nearest or context.dataset.budget.spent:
            break
        again = closest_first(_with_updates(context, alone_beside(context, nearest[0])))
        if not again or SAME * again[0].rms >= nearest[0].rms:
            break
        nearest, found = again, [*found, *again]
    return found


def _with_updates(context: FitContext, origin: Fitted) -> list[Fitted]:
    grids = update_grids_in_loop(origin)
    problem = replace(origin.problem, effects=(updated_every(context.dataset, grids),), rows=context.coarse)
    at = len(problem.structure.shape)
    thetas = []
    for period_s, phase in grids:
        theta = np.array([*origin.theta, math.log(period_s), phase])
        theta[at] = max(theta[at] - period_s / 2.0 / problem.unit_s, 0.0)
        thetas.append(theta)
    return [fit(problem, theta, QUICK_STEPS, ENOUGH_FOR_RANKS) for theta in thetas]


def _with_steps(context: FitContext, staged: Fitted) -> list[Fitted]:
    """Return equal steps whose thresholds are about those of stages, in their place."""
    *others, stages = staged.problem.effects
    process = staged.theta[: -len(stages.searched)]
    found = []
    for form, grids in equal_steps(context.dataset, staged.theta[process.size :]).items():
        problem = replace(staged.problem, effects=(*others, quantisation(context.dataset, form, grids)))
        thetas = [np.array([*process, *grid]) for grid in grids]
        found += [fit(problem, theta, QUICK_STEPS, ENOUGH_FOR_RANKS) for theta in thetas]
    return found


def _in_detail(candidate: Fitted, around: Callable[[Fitted, int], list[FloatArray]]) -> Fitted:
    """Return a candidate with the best of the numbers around its own, the process as it was, then all fitted."""
    for nearer in range(len(TIMES)):
        best = closest_first(fit(candidate.problem, theta, 0) for theta in around(candidate, nearer))[0]
        candidate = closest_first([candidate, fit(best.problem, best.theta, COARSE_STEPS)])[0]
    return candidate


def _times_around(candidate: Fitted, nearer: int) -> list[FloatArray]:
    """Return other periods and phases, the updates in the middle of the fitted part that many periods later."""
    *process, log_period, phase = candidate.theta.tolist()
    updates = round(candidate.problem.dataset.fitted_until_s / 2.0 / math.exp(log_period))
    thetas = []
    for turn, by in TIMES[nearer]:
        longer = 1.0 + turn / (4.0 * max(updates, 1))
        thetas.append([*process, log_period + math.log(longer), (updates + phase) / longer - updates + by])
    return [np.array(theta) for theta in thetas]


def _steps_around(candidate: Fitted, nearer: int) -> list[FloatArray]:
    """Return other steps that count from the same level."""
    *process, step, origin = candidate.theta.tolist()
    dataset = candidate.problem.dataset
    zero = 0.0 if origin == 0.0 else -dataset.output0 / dataset.swing
    tried = step * (1.0 + STEPS[nearer])
    return [np.array([*process, s, o]) for s, o in zip(tried, origin_of(tried, zero), strict=True)]
