"""Searches with a process of their own, because the process alone lies far from the one beside an effect.

A right half-plane zero, or a further lag, delays a response. The process alone absorbs the delay as dead time, and from
there no descent direction exists: with all of the delay in the dead time, a small zero changes nothing. The search
therefore starts with a part of the dead time too. The opposite holds for a dead time that varies: the process alone may
come closest without any, and from there a variation of it changes nothing, so that the search starts with more.

A large wave, a switched output, a limited rate and a limit of the actuator in a loop keep the process alone anywhere.
These are searched beside processes all over what a record can show; a limit also beside a disturbance.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effects.actuator.saturation import soft_limits
from autotuner.core.diagnosis.effects.actuator.static_curve import static_curves
from autotuner.core.diagnosis.effects.waves import share_of_wave, spectral_lines
from autotuner.core.diagnosis.extended.base import is_physical
from autotuner.core.diagnosis.extended.extended_model import closest_first
from autotuner.core.diagnosis.extended.fitting import ENOUGH_FOR_RANKS, fit
from autotuner.core.diagnosis.search.screen import fits_beside, theta_with
from autotuner.core.diagnosis.search.search import (
    COARSE_STEPS,
    alone_beside,
    disturbances_of,
    extend,
    first_of_each,
    form_of,
    free_load_of,
    refined,
    within,
)
from autotuner.core.model.structures import SECOND_ORDER

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.extended.base import Base
    from autotuner.core.diagnosis.extended.effect import Effect
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext
    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

KEPT = (0.7, 0.3)
"""Shares of the dead time to begin with."""
ADDED = (0.3, 0.7)
"""Dead times to begin with where the process alone has none, in hundredths of the record (`Extended.unit_s`)."""
STRONGEST, WAVE = 2, 0.2
"""Waves of the PV that are looked at, and the least share of its variance about a straight line to be searched for."""
PERIODIC = "periodic_disturbance"
LAGS, DELAYS = (0.003, 0.01, 0.03, 0.1), (0.1, 0.5, 2.0)
"""Lags to begin with beside a wave, in records, and dead times, in hundredths of one."""
QUICK_LAG = 0.1
"""The quicker lag to begin with beside a wave, in slower ones."""
FOLLOWED = 8
"""Starts beside pairs of lags from which a fit begins."""
CURVE = "curve"
"""Group of the effects that give each level of the output a position."""
NEAR, CLOSER = 1.3, 0.97
"""Misfit of a start over that of the pair of lags alone up to which it is followed; and where a start far from the
right size does nothing to the output, so that it is as near as the pair."""
RATE_LIMIT = "rate_limit"
SHORTEST = 0.5
"""Dead time, in samples, below which a variation of it moves nothing that a sample shows."""


def with_less_dead_time(context: FitContext, origins: Sequence[Fitted], effects: Sequence[Effect]) -> list[Fitted]:
    """Return the first pair of lags with each effect that makes an answer late, fitted on all samples, where closer."""
    pair = free_pair(origins)
    if pair is None:
        return []
    late = [e for e in effects if e.makes_late and fits_beside(e, pair.problem.effects)]
    found = [_from_less(context, pair, effect) for effect in within(context.dataset.budget, late)]
    return [f for f in found if is_physical(f) and f.rms < pair.rms]


def with_process_beside_wave(context: FitContext, base: Base, effects: Sequence[Effect]) -> list[Fitted]:
    """Return a wave with a pair of lags that is searched for beside it, fitted on all samples, where closer.

    Alone, the process rings in place of a large wave, or waits for half of its period, and does not come back from it.
    A wave that begins within the record is searched in the same way.
    """
    wave, late = form_of(effects, PERIODIC), form_of(effects, PERIODIC, "begins")
    pair = free_pair(base.origins)
    dataset = context.dataset
    if wave is None or late is None or pair is None or dataset.tuned or pair.problem.effects:
        return []
    lines = _large_waves(dataset)
    problem = replace(pair.problem.with_effect(wave), rows=context.coarse)
    found = [
        fit(problem, np.append(shape, math.log(line)), COARSE_STEPS, ENOUGH_FOR_RANKS)
        for line, shape in within(dataset.budget, product(lines, _shapes(dataset)))
    ]
    moments = sorted({at for _, at in late.starts})
    late = replace(late, starts=[(math.log(line), at) for line in lines for at in moments])
    begun = _beside_each(context, pair, [late], _shapes(dataset))
    return [*closest(context, found, pair), *closest(context, begun, pair)]


def with_slow_output(context: FitContext, base: Base, effects: Sequence[Effect]) -> list[Fitted]:
    """Return a limited rate with a pair of lags that is searched for beside it.

    The process alone lies far from the process behind an actuator that hardly arrives.
    """
    pair, rates = free_pair(base.origins), [e for e in effects if e.name == RATE_LIMIT]
    if pair is None:
        return []
    return closest(context, _beside_each(context, pair, rates, shapes_with(base), most=CLOSER), pair)


def shapes_with(base: Base) -> list[FloatArray]:
    """Return pairs of lags all over what a record can show, and those that are origins of the search."""
    origins = [o for o in base.origins if o.problem.structure is SECOND_ORDER]
    return [*_shapes(base.best.problem.dataset), *(o.theta[:3] for o in origins)]


def with_curve_in_loop(context: FitContext, base: Base, effects: Sequence[Effect]) -> list[Fitted]:
    """Return each curve of an actuator in a loop, from the process that is found beside one of them.

    A controller moves on where its actuator has ended: the process alone has to answer to that, and lies far away.
    """
    pair = free_pair(base.origins)
    if context.dataset.controller is None or pair is None or pair.problem.effects:
        return []
    curves = [*(e for e in effects if e.group == CURVE), *soft_limits(context.dataset)]
    found = _beside_each(
        context, pair, [*curves, *static_curves(context.dataset)], [*_shapes(context.dataset), pair.theta]
    )
    origins = [alone_beside(context, c) for c in closest_first(found) if c.rms < pair.rms and is_physical(c)][:1]
    return extend(context, origins, curves) if origins else []


def with_curve_beside_a_load(context: FitContext, base: Base, effects: Sequence[Effect]) -> list[Fitted]:
    """Return each curve of an actuator with a disturbance: neither is visible without the other.

    A large wave of the PV is one. In a loop, the curve is found beside a load of free shape, which a disturbance then
    takes the place of.
    """
    pair, curves = free_pair(base.origins), [e for e in effects if e.group == CURVE]
    free, wave = free_load_of(effects), form_of(effects, PERIODIC)
    if context.dataset.tuned or pair is None or pair.problem.effects or not curves:
        return []
    found = []
    if wave is not None:
        lines = within(context.dataset.budget, _waves_that_disturb(context.dataset))
        beside = [c for f in lines for c in _curves_beside(context, pair, curves, wave, [math.log(f)])]
        found += [refined(context, c) for c in closest_first(beside)[:1]]
    if free is not None and context.dataset.controller is not None:
        alone = [alone_beside(context, c, *c.problem.effects[:1]) for c in _curves_beside(context, pair, curves, free)]
        found += extend(context, alone, disturbances_of(effects)) if alone else []
    return [c for c in found if is_physical(c)]


def _curves_beside(
    context: FitContext, pair: Fitted, curves: Sequence[Effect], load: Effect, numbers: Sequence[float] = ()
) -> list[Fitted]:
    """Return the closest of each curve of an actuator beside a load with its numbers, where it is closer than that."""
    problem = replace(pair.problem.with_effect(load), rows=context.coarse)
    beside = fit(problem, np.append(pair.theta, numbers), COARSE_STEPS)
    tried = _beside_each(context, beside, curves, [*_shapes(context.dataset), pair.theta], numbers)
    closer = (c for c in closest_first(tried) if c.rms < beside.rms and is_physical(c))
    return first_of_each(closer, lambda c: c.problem.effects[0].key)


def _waves_that_disturb(dataset: Dataset) -> Sequence[float]:
    """Return the large waves of the PV but for those that the output brings: in a loop, it answers to any."""
    lines, output = _large_waves(dataset), dataset.data.held.at(dataset.data.t)
    return lines if dataset.in_loop else [f for f in lines if share_of_wave(dataset, output, f) < WAVE]


@lru_cache(maxsize=8)
def _large_waves(dataset: Dataset) -> tuple[float, ...]:
    """Return the lines of the PV that have a large share of its variance, in periods per record."""
    pv = dataset.data.pv
    return tuple(f for f in spectral_lines(dataset, pv)[:STRONGEST] if share_of_wave(dataset, pv, f) > WAVE)


def _beside_each(
    context: FitContext,
    pair: Fitted,
    effects: Sequence[Effect],
    shapes: Sequence[FloatArray],
    numbers: Sequence[float] = (),
    most: float = NEAR,
) -> list[Fitted]:
    """Return the closest starts of effects beside pairs of lags, fitted on few samples.

    `numbers` are those of an effect that the pair has, which comes after them in the row from output to PV; `most` is
    the misfit of a start over that of the pair up to which it is followed.
    """
    return [
        fit(replace(c.problem, rows=context.coarse), c.theta, COARSE_STEPS, ENOUGH_FOR_RANKS)
        for c in starts_beside(context, pair, effects, shapes, numbers)[:FOLLOWED]
        if c.rms < most * pair.rms
    ]


def starts_beside(
    context: FitContext,
    pair: Fitted,
    effects: Sequence[Effect],
    shapes: Sequence[FloatArray],
    numbers: Sequence[float] = (),
) -> list[Fitted]:
    """Return every start of effects beside every pair of lags on few samples, the closest first."""
    return closest_first(
        fit(replace(pair.problem.with_effect(e), rows=context.screen), np.concatenate((shape, start, numbers)), 0)
        for e, shape in within(context.dataset.budget, product(effects, shapes))
        for start in e.starts
    )


def _shapes(dataset: Dataset) -> list[FloatArray]:
    """Return pairs of lags with a dead time, as `theta` has them, that lie all over what a record can show."""
    span = dataset.span_s
    return [
        np.array([math.log(lag * span), math.log(QUICK_LAG * lag * span), delay])
        for lag, delay in product(LAGS, DELAYS)
    ]


def closest(context: FitContext, found: Sequence[Fitted], pair: Fitted) -> list[Fitted]:
    """Return the closest of these fitted on all samples, where it is closer than the pair of lags alone."""
    best = [refined(context, c) for c in closest_first(found)[:1]]
    return [c for c in best if is_physical(c) and c.rms < pair.rms]


def free_pair(origins: Sequence[Fitted]) -> Fitted | None:
    """Return the first pair of lags whose values are not held."""
    return next((o for o in origins if o.problem.structure is SECOND_ORDER and o.problem.fixed is None), None)


def with_varying_dead_time(context: FitContext, base: Base, effects: Sequence[Effect]) -> list[Fitted]:
    """Return each process without dead time with each effect that varies one, fitted on all samples."""
    origins = [o for o in base.origins if o.problem.fixed is None and _has_no_delay(o)]
    varying = [e for e in effects if e.transport is not None]
    if not origins or not varying:
        return []
    return extend(context, [_with_dead_time(context, o, added) for o in origins for added in ADDED], varying)


def _has_no_delay(candidate: Fitted) -> bool:
    _, delay_s, _ = candidate.problem.split(candidate.theta)
    return delay_s < SHORTEST * candidate.problem.dataset.data.interval_s


def _with_dead_time(context: FitContext, origin: Fitted, added: float) -> Fitted:
    theta = origin.theta.copy()
    theta[len(origin.problem.structure.shape)] = added
    return fit(replace(origin.problem, rows=context.coarse), theta, 0)


def _from_less(context: FitContext, pair: Fitted, effect: Effect) -> Fitted:
    problem = replace(pair.problem.with_effect(effect), rows=context.coarse)
    at = len(problem.structure.shape)
    fits = []
    for start, share in product(effect.starts, KEPT):
        theta = theta_with(pair, problem, effect, start)
        theta[at] *= share
        fits.append(fit(problem, theta, COARSE_STEPS, ENOUGH_FOR_RANKS))
    return refined(context, closest_first(fits)[0])
