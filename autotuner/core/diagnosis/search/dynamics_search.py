"""Search for dynamics that the process alone replaces by dead time; it starts with less dead time.

A right half-plane zero, or a further lag, delays a response. The process alone absorbs the delay as dead time, and from
there no descent direction exists: with all of the delay in the dead time, a small zero changes nothing. The search
therefore starts with a part of the dead time too. The opposite holds for a dead time that varies: the process alone may
come closest without any, and from there a variation of it changes nothing, so that the search starts with more.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING

from autotuner.core.diagnosis.extended.base import is_physical
from autotuner.core.diagnosis.extended.extended_model import ENOUGH_FOR_RANKS, closest_first, fit
from autotuner.core.diagnosis.search.screen import fits_beside, theta_with
from autotuner.core.diagnosis.search.search import COARSE_STEPS, extend, refined, within
from autotuner.core.model.structures import SECOND_ORDER

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.extended.base import Base
    from autotuner.core.diagnosis.extended.effect import Effect
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext

KEPT = (0.7, 0.3)
"""Shares of the dead time to begin with."""
ADDED = (0.3, 0.7)
"""Dead times to begin with where the process alone has none, in hundredths of the record (`Extended.unit_s`)."""
SHORTEST = 0.5
"""Dead time, in samples, below which a variation of it moves nothing that a sample shows."""


def with_less_dead_time(context: FitContext, origins: Sequence[Fitted], effects: Sequence[Effect]) -> list[Fitted]:
    """Return the first pair of lags with each effect that makes an answer late, fitted on all samples, where closer."""
    pair = next((o for o in origins if o.problem.structure is SECOND_ORDER and o.problem.fixed is None), None)
    if pair is None:
        return []
    late = [e for e in effects if e.makes_late and fits_beside(e, pair.problem.effects)]
    found = [_from_less(context, pair, effect) for effect in within(context.dataset.budget, late)]
    return [f for f in found if is_physical(f) and f.rms < pair.rms]


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
