"""Search for friction in the record of a closed loop, together with the process.

A valve that sticks under a controller makes the PV a square wave while the output ramps. No linear process fits
this, so there is no process alone from which a search for friction could start. Instead

    lag, dead time from a grid of sample intervals;   bands from the output's range;   gain, offset by least squares

and the best few are fitted jointly. When a valve slips depends on its bands in jumps, so that no slope leads to the
right ones: all around those that were found are tried, beside the process as it then is, first with one lag and then
with two.

A loop cycles about as far as its valve's band. One that its set point moves far shows a smaller band too: such a band
counts only where it leaves little but noise.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effects.actuator.friction import (
    LARGEST_LEFT,
    SLIPS,
    SMALLEST_IN_LOOP,
    TURNING,
    plain_friction,
)
from autotuner.core.diagnosis.effects.process.friction import process_friction
from autotuner.core.diagnosis.effects.waves import lines_of_all, wave_at_the_input
from autotuner.core.diagnosis.extended.base import is_physical
from autotuner.core.diagnosis.extended.extended_model import (
    Extended,
    Fitted,
    closest_first,
    fit,
    linearised,
    without_rounding,
)
from autotuner.core.diagnosis.record.waiting import waiting_of
from autotuner.core.diagnosis.search.judge import VISIBLE, noise_of
from autotuner.core.diagnosis.search.search import refined, within
from autotuner.core.model.structures import FOPDT, INTEGRATING, SECOND_ORDER

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.extended.base import Base
    from autotuner.core.diagnosis.extended.effect import Effect
    from autotuner.core.diagnosis.extended.fit_context import FitContext

LAGS, DELAYS = (0.6, 2.5, 8.0, 20.0), (0.0, 2.0, 6.0)
"""In sample intervals."""
FOLLOWED, STEPS = 2, 12
NEAR = 1.5
"""Error over that of the best explanation up to which friction is named where the valve is seen to stick."""
AROUND = ((0.15, 15), (0.03, 15), (0.01, 11))
"""How far around a band others are tried, as a share of it on either side, and how many, ever nearer."""
AS_FAR = 3
"""How much farther, as a share of the band, the other number of a form is tried around its own."""
NEARER = 0.9
"""Error over that of the process alone from which bands around are not tried."""
WAVE_STEPS = 5
"""Most steps of the optimiser from each period of a wave."""
SECOND_LAG = 0.3
"""Second lag to start from, over the first."""
AXIS_LAGS, FAR, HALF = (5.0, 30.0), 3.0, 0.6
"""Lags of an axis to start from, in sample intervals; error over noise from which friction on the process is tried;
error after over before, on both parts, under which it is an explanation."""


def with_friction(context: FitContext, base: Base, effects: Sequence[Effect]) -> list[Fitted]:
    """Return processes with each kind of friction, fitted on all samples; none where no valve of a loop may stick.

    Parameters
    ----------
    context : FitContext
        The recording.
    base : Base
        The process alone.
    effects : sequence of Effect
        The catalogue.
    """
    seen = waiting_of(context.dataset)
    if not (context.dataset.in_loop or seen.sticks) or seen.follows or context.dataset.budget.spent:
        return []
    turning = [e for e in effects if e.group == "friction" and e.form == TURNING]
    friction = [*plain_friction(context.dataset), *turning]
    found = [f for effect in within(context.dataset.budget, friction) for f in _beside(context, base, effect)]
    return [f for f in found if is_physical(f) and _is_shown(context, base.best, f)]


def _is_shown(context: FitContext, alone: Fitted, candidate: Fitted) -> bool:
    """Return whether bands are as wide as a loop cycles, or leave little but noise, and half of the rest elsewhere."""
    band = candidate.problem.split(candidate.theta)[2][0][0]
    if candidate.problem.effects[0].form == TURNING or band > SMALLEST_IN_LOOP:
        return True
    close = candidate.rms < VISIBLE * noise_of(context, candidate)
    return close and context.held_out_error(candidate) < HALF * context.held_out_error(alone)


def _beside(context: FitContext, base: Base, effect: Effect) -> list[Fitted]:
    problem = Extended(context.dataset, FOPDT, (effect,), context.screen, base.best.problem.background)
    interval = context.dataset.data.interval_s
    grid = product(effect.starts, LAGS, DELAYS)  # the process last: positions are kept for a while
    thetas = [np.array([math.log(T * interval), D * interval / problem.unit_s, *p]) for p, T, D in grid]
    ranked = closest_first(fit(problem, theta, 0) for theta in thetas)[:FOLLOWED]
    ranked += closest_first(_beside_the_free(context, base.origins[0], effect))[:FOLLOWED]
    coarse = [fit(replace(f.problem, rows=context.coarse), f.theta, STEPS) for f in ranked]
    if effect.form != TURNING:
        coarse = [_in_detail(c) for c in coarse if c.rms < NEARER * base.best.rms]
    return [refined(context, c) for c in closest_first(coarse)[:1]]


def that_stick(context: FitContext, accepted: Sequence[Fitted]) -> list[Fitted]:
    """Return of accepted explanations those with friction that come near the best, where the valve is seen to stick.

    The waiting of the PV is evidence that no misfit contains: a free load follows a slip as closely as friction does.
    """
    if not accepted or not waiting_of(context.dataset).sticks:
        return []
    best = min(context.on_both_parts(c) for c in accepted)
    frictional = [c for c in accepted if SLIPS & set(c.names)]
    return [c for c in frictional if context.on_both_parts(c) < NEAR**2 * best]


def _beside_the_free(context: FitContext, origin: Fitted, effect: Effect) -> list[Fitted]:
    """Return the starts of friction beside a process that was found without: one that its set point moves is near."""
    if origin.problem.structure is not SECOND_ORDER:
        return []
    problem = replace(origin.problem, effects=(effect,), rows=context.screen)
    return [fit(problem, np.array([*origin.theta, *p]), 0) for p in effect.starts]


def _in_detail(candidate: Fitted) -> Fitted:
    """Return friction with the best of the bands around its own, beside a process of one lag or two."""
    for share, count in AROUND:
        candidate = _best_around(candidate, share, count)
        lags = len(candidate.problem.structure.shape)
        pair = candidate.theta if lags > 1 else np.insert(candidate.theta, 1, candidate.theta[0] + math.log(SECOND_LAG))
        candidate = fit(replace(candidate.problem, structure=SECOND_ORDER), pair, STEPS)
    return candidate


def _best_around(candidate: Fitted, share: float, count: int) -> Fitted:
    problem = candidate.problem
    first = len(problem.structure.shape) + 1
    around = np.linspace(-share, share, count)
    band, *left = candidate.theta[first:].tolist()
    others = [np.clip(value + AS_FAR * around[::2], 0.0, LARGEST_LEFT) for value in left]
    tried = [np.array([*candidate.theta[:first], *p]) for p in product(band * (1.0 + around), *others)]
    return closest_first([candidate, *(fit(problem, theta, 0) for theta in tried)])[0]


def with_process_friction(context: FitContext, alone: Fitted) -> list[Fitted]:
    """Return a lag and an integrating process with dry friction where that explains a record far better; else none.

    The process alone is not a start: with friction, a lag is identified as too short.

    Parameters
    ----------
    context : FitContext
        The recording.
    alone : Fitted
        The process alone.
    """
    if (
        context.dataset.tuned
        or context.dataset.budget.spent
        or alone.rms < FAR * math.hypot(context.dataset.noise, context.dataset.floor)
    ):
        return []
    interval, found = context.dataset.data.interval_s, []
    for structure in (FOPDT, INTEGRATING):
        effect = process_friction(context.dataset)
        problem = Extended(context.dataset, structure, (effect,), context.screen)
        starts = [np.array([math.log(lag * interval), 0.0, *s]) for lag in AXIS_LAGS for s in effect.starts]
        ranked = without_rounding(starts, partial(linearised, problem))
        coarse = [fit(replace(problem, rows=context.coarse), theta, STEPS) for theta in ranked[:FOLLOWED]]
        alike = refined(context, closest_first(coarse)[0])
        each = replace(alike.problem, effects=(process_friction(context.dataset, by_direction=True),))
        beyond = len(structure.shape) + 3  # the process, Coulomb friction and constant are before the ratio
        found += [alike, fit(each, np.insert(alike.theta, beyond, 0.0), STEPS)]
    before = context.held_out_error(alone)
    return [
        f for f in found if is_physical(f) and f.rms < HALF * alone.rms and context.held_out_error(f) < HALF * before
    ]


def with_wave(context: FitContext, candidate: Fitted) -> list[Fitted]:
    """Return a process with dry friction with a periodic load beside it, the best one first; none without friction.

    Dry friction answers to the sum of the forces: beside it, a wave on the PV is none at the input. An axis integrates
    it twice, so that its period shows in the slope of the residual only.
    """
    if not any(e.name == "process_friction" for e in candidate.problem.effects) or context.dataset.budget.spent:
        return []
    dataset = context.dataset
    residual = dataset.data.pv - candidate.simulated(np.arange(dataset.data.t.size))
    lines = lines_of_all(dataset, [residual, np.gradient(residual, dataset.data.t)])
    problem = replace(candidate.problem, rows=context.coarse)
    starts = [np.array([*candidate.theta, math.log(line), 0.0, 0.0]) for line in lines]
    sine = replace(problem, effects=(*problem.effects, wave_at_the_input(dataset)))
    quick = closest_first(fit(sine, theta, WAVE_STEPS) for theta in within(dataset.budget, starts))
    if not quick:
        return []
    square = replace(problem, effects=(*problem.effects, wave_at_the_input(dataset, switched=True)))
    return [refined(context, c) for c in (quick[0], fit(square, quick[0].theta, WAVE_STEPS))]
