"""Updates and steps of an actuator on the record of a loop, fitted together with the process.

A command that moves at every sample is late by half of the update period on average, and the process alone has that in
its dead time: the search for updates begins with that much less. Neither a phase nor a step has a slope, so that others
around are tried beside the process as it then is, ever nearer. (Starts: `position_in_loop`.)
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effects.actuator.levels import origin_of
from autotuner.core.diagnosis.effects.actuator.position_in_loop import step_grids_in_loop, update_grids_in_loop
from autotuner.core.diagnosis.effects.actuator.textbook_forms import quantisation, updated_every
from autotuner.core.diagnosis.extended.base import is_physical
from autotuner.core.diagnosis.extended.extended_model import closest_first
from autotuner.core.diagnosis.extended.fitting import ENOUGH_FOR_RANKS, fit
from autotuner.core.diagnosis.search.search import COARSE_STEPS, QUICK_STEPS, SAME, form_of, refined, within

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
AGAIN = 3
"""How often updates, or steps, are searched for again from the process that the ones before leave."""
STEPS = (np.linspace(-0.006, 0.006, 61), np.linspace(-0.003, 0.003, 61), np.linspace(-0.0006, 0.0006, 31))
"""Tried around a step, in it: far from where they count from, a small error of the step is a large one of its level."""


def with_positions(context: FitContext, base: Base, effects: Sequence[Effect]) -> list[Fitted]:
    """Return the process with updates at even times and with steps; none where no controller moves the output.

    Steps are looked for beside a straight drift, too: with it and without them, the process is far off.

    Returns
    -------
    list of Fitted
        Fitted on all samples.
    """
    if not context.dataset.in_loop:
        return []
    origins = list({id(o): o for o in (base.best, *base.origins[:1])}.values())
    found = []
    for beside, around, of in (
        (_with_updates, _times_around, origins),
        (_with_steps, _steps_around, origins),
        (_with_steps, _steps_around, _with_drift(context, origins, effects)),
    ):
        nearest = closest_first(c for o in within(context.dataset.budget, of) for c in beside(context, o))
        nearest = closest_first([*nearest, *_from_their_process(context, nearest, beside)])
        found += [_in_detail(c, around) for c in nearest[:FOLLOWED] if c.rms < NEARER * base.best.rms]
    return [c for c in (refined(context, f) for f in found) if is_physical(c)]


def _with_drift(context: FitContext, origins: Sequence[Fitted], effects: Sequence[Effect]) -> list[Fitted]:
    """Return the processes beside a straight drift where that is closer."""
    drift = form_of(effects, "drift")
    if drift is None:
        return []
    beside = [fit(replace(o.problem, effects=(drift,), rows=context.coarse), o.theta, COARSE_STEPS) for o in origins]
    return [found for o, found in zip(origins, beside, strict=True) if SAME * found.rms < o.rms]


def _from_their_process(
    context: FitContext, nearest: Sequence[Fitted], beside: Callable[[FitContext, Fitted], list[Fitted]]
) -> list[Fitted]:
    """Return what is found again from the process beside the nearest: the one alone may be far from it."""
    found: list[Fitted] = []
    for _ in range(AGAIN):
        if not nearest or context.dataset.budget.spent:
            break
        *others, last = nearest[0].problem.effects
        left = nearest[0].theta[: -len(last.searched)]
        again = closest_first(beside(context, fit(replace(nearest[0].problem, effects=tuple(others)), left, 0)))
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


def _with_steps(context: FitContext, origin: Fitted) -> list[Fitted]:
    found = []
    for form, grids in step_grids_in_loop(origin).items():
        effect = quantisation(context.dataset, form, grids)
        problem = replace(origin.problem, effects=(*origin.problem.effects, effect), rows=context.coarse)
        thetas = [np.array([*origin.theta, *grid]) for grid in grids]
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
