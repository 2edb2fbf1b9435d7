"""What the form of an explanation leaves open: other forms that the record does not rule out.

    process with one lag more;   effect with the next term of its series (`Effect.next_terms`);   other effects
    w_i ~ exp(-AIC_i/2),   AIC_i = n ln S_i + 2 p_i,   n = N / inflation of the residual
    var x = sum_i w_i (var_i x + (x_i - x)^2)                                                   (`intervals`)

A model of too low an order may fit to the noise with a gain that is many of its standard errors off. No residual shows
that, but the next term does. (Buckland, Burnham and Augustin, Biometrics 53, 1997.) A richer form counts only where it
lowers the criterion: otherwise the record speaks for the plainer one, and the rich one would open what is known. One as
plain counts where its odds are 1 to 20 at least, and it predicts the other part as well (Occam's window; Madigan and
Raftery, J. Am. Stat. Assoc. 89, 1994).
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.base import is_physical
from autotuner.core.diagnosis.extended.both_parts import to_both_parts
from autotuner.core.diagnosis.extended.extended_model import closest_first
from autotuner.core.diagnosis.extended.fitting import fit
from autotuner.core.diagnosis.extended.intervals import shares_beside
from autotuner.core.diagnosis.search.exchange import first_number, in_near_forms
from autotuner.core.diagnosis.search.judge import is_visible
from autotuner.core.diagnosis.search.search import FINE_STEPS, QUICK_STEPS, within
from autotuner.core.model.structures import FOPDT, SECOND_ORDER, THIRD_ORDER

if TYPE_CHECKING:
    from collections.abc import Iterator

    from autotuner.core.diagnosis.extended.effect import Effect
    from autotuner.core.diagnosis.extended.extended_model import Extended, Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext
    from autotuner.core.diagnosis.extended.intervals import Neighbours
    from autotuner.core.model.arrays import FloatArray

ONE_MORE = {FOPDT: SECOND_ORDER, SECOND_ORDER: THIRD_ORDER}
WINDOW = 2.0 * math.log(20.0)
"""How much higher the criterion of a form may be that is as plain: odds of 20 (Madigan and Raftery)."""
ALIKE_MISFIT = 1.04
"""Ratio of the errors on a part under which two forms explain it about as well."""
SHARES = (0.05, 0.2)
"""Initial guesses of the further lag, relative to the longest number of the process."""


@lru_cache(maxsize=4)
def neighbours(context: FitContext, chosen: Fitted, pool: tuple[Fitted, ...] = ()) -> Neighbours:
    """Return the explanation and all others that count, each with its weight; `pool` has other forms. Cached.

    All are as fitted to the fitted and the selection part together.
    """
    final = to_both_parts(context, chosen)
    if is_visible(context, chosen):
        return ((1.0, final),)
    lag = one_lag_more(context, chosen)
    others = (other for effect in chosen.problem.effects for other in in_near_forms(context, chosen, effect))
    pool = (*pool, *others)
    near = [*_alike(context, chosen, pool), *([] if lag is None else [lag]), *_with_next_terms(context, chosen)]
    found = [to_both_parts(context, f) for f in near]
    samples = final.residual.size / context.colour(final)
    gains = {f: samples * math.log(final.misfit / f.misfit) - 2.0 * (f.size - final.size) for f in found}
    kept = {f: gain for f, gain in gains.items() if gain > (0.0 if f.size > final.size else -WINDOW)}
    best = max(kept.values(), default=0.0)
    weights = {f: math.exp((gain - max(best, 0.0)) / 2.0) for f, gain in {final: 0.0, **kept}.items()}
    return tuple((weight / sum(weights.values()), f) for f, weight in weights.items())


def _alike(context: FitContext, chosen: Fitted, pool: tuple[Fitted, ...]) -> list[Fitted]:
    """Return the other forms of a pool, one of each, that come as near on either part.

    Numbers that the fitted part leaves open may fail on the other part, until both are fitted together.
    """
    problem, known = chosen.problem, {chosen.keys}
    floor = context.dataset.floor
    most = ALIKE_MISFIT * math.hypot(context.held_out_error(chosen), floor)
    most_fitted = ALIKE_MISFIT * math.hypot(chosen.rms, floor)
    found, split = [], _is_split(chosen)
    for other in closest_first(c for c in pool if c.problem.dataset is problem.dataset and c.problem.fixed is None):
        if other.keys in known or len(other.keys) != len(problem.effects) or _is_split(other) != split:
            continue
        known.add(other.keys)
        near = other.rms < most_fitted or context.held_out_error(other) < most
        found += [_as_plain(chosen, other)] if near else []
    return found


def _as_plain(chosen: Fitted, other: Fitted) -> Fitted:
    """Return another form with one lag where the chosen one needs no second: both are then as rich."""
    problem = other.problem
    if chosen.problem.structure is not FOPDT or problem.structure is not SECOND_ORDER:
        return other
    single = with_one_lag(other)
    return single if is_physical(single) else other


def with_one_lag(explanation: Fitted) -> Fitted:
    """Return an explanation with a pair of lags, fitted with the first one only."""
    problem = replace(explanation.problem, structure=FOPDT)
    return fit(problem, np.delete(explanation.theta, 1), FINE_STEPS)


def _is_split(candidate: Fitted) -> bool:
    """Return whether the gain of the process is but a part of the whole one."""
    return bool(shares_beside(candidate.sizes()))


@lru_cache(maxsize=4)
def one_lag_more(context: FitContext, chosen: Fitted) -> Fitted | None:
    """Return the explanation with a further lag of the process; None where it can have none. Cached."""
    problem = chosen.problem
    other = any((e.response is not None and not e.takes_third) or e.makes_late for e in problem.effects)
    structure = ONE_MORE.get(problem.structure)
    if structure is None or problem.fixed is not None or other or context.dataset.budget.spent:
        return None
    thinned = replace(problem, structure=structure, rows=context.coarse)
    starts = (np.insert(chosen.theta, len(problem.structure.shape), chosen.theta[0] + np.log(s)) for s in SHARES)
    coarse = closest_first(fit(thinned, start, QUICK_STEPS) for start in starts)[0]
    richer = fit(replace(thinned, rows=context.fine), coarse.theta, FINE_STEPS)
    return richer if is_physical(richer) else None


def _with_next_terms(context: FitContext, chosen: Fitted) -> Iterator[Fitted]:
    """Yield the explanation with each next term of its effects."""
    if chosen.problem.fixed is not None:
        return
    for effect in chosen.problem.effects:
        for richer in within(context.dataset.budget, effect.next_terms):
            yield fit(*_with(chosen, effect, richer), FINE_STEPS)


def _with(chosen: Fitted, effect: Effect, richer: Effect) -> tuple[Extended, FloatArray]:
    """Return the problem with an effect that has searched numbers more at its end, and where its search starts."""
    effects = tuple(richer if e is effect else e for e in chosen.problem.effects)
    end = first_number(chosen.problem, effect) + len(effect.searched)
    more = len(richer.searched) - len(effect.searched)
    return replace(chosen.problem, effects=effects), np.insert(chosen.theta, [end] * more, 0.0)
