"""Search for dynamics that the process alone replaces by dead time; it starts with less dead time.

A right half-plane zero, or a further lag, delays a response. The process alone absorbs the delay as dead time, and from
there no descent direction exists: with all of the delay in the dead time, a small zero changes nothing. The search
therefore starts with a part of the dead time too.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING

from autotuner.core.diagnosis.extended.base import is_physical
from autotuner.core.diagnosis.extended.extended_model import ENOUGH_FOR_RANKS, closest_first, fit
from autotuner.core.diagnosis.search.screen import fits_beside, theta_with
from autotuner.core.diagnosis.search.search import COARSE_STEPS, refined, within
from autotuner.core.model.structures import SECOND_ORDER

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.extended.base import Base
    from autotuner.core.diagnosis.extended.effect import Effect
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext

KEPT = (0.7, 0.3)
"""Shares of the dead time to begin with."""


def with_less_dead_time(context: FitContext, base: Base, effects: Sequence[Effect]) -> list[Fitted]:
    """Return the process with each effect that makes an answer late, fitted on all samples, where that is closer."""
    pair = next((o for o in base.origins if o.problem.structure is SECOND_ORDER and o.problem.fixed is None), None)
    if pair is None:
        return []
    late = [e for e in effects if e.makes_late and fits_beside(e, pair.problem.effects)]
    found = [_from_less(context, pair, effect) for effect in within(context.dataset.budget, late)]
    return [f for f in found if is_physical(f) and f.rms < pair.rms]


def _from_less(context: FitContext, pair: Fitted, effect: Effect) -> Fitted:
    problem = replace(pair.problem, effects=(*pair.problem.effects, effect), rows=context.coarse)
    at = len(problem.structure.shape)
    fits = []
    for start, share in product(effect.starts, KEPT):
        theta = theta_with(pair, problem, effect, start)
        theta[at] *= share
        fits.append(fit(problem, theta, COARSE_STEPS, ENOUGH_FOR_RANKS))
    return refined(context, closest_first(fits)[0])
