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
from autotuner.core.diagnosis.extended.effect import Place
from autotuner.core.diagnosis.extended.extended_model import closest_first, fit
from autotuner.core.diagnosis.extended.intervals import shares_beside
from autotuner.core.diagnosis.search.acceptance import is_near_later
from autotuner.core.diagnosis.search.judge import NOTHING_LEFT, VISIBLE, noise_of
from autotuner.core.diagnosis.search.search import (
    AS_NEAR,
    FINE_STEPS,
    QUICK_STEPS,
    best_on_both_parts,
    refined,
    within,
)
from autotuner.core.model.structures import FOPDT, SECOND_ORDER, THIRD_ORDER

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from autotuner.core.diagnosis.extended.effect import Effect
    from autotuner.core.diagnosis.extended.extended_model import Extended, Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext
    from autotuner.core.diagnosis.extended.intervals import Neighbours
    from autotuner.core.model.arrays import FloatArray

ONE_MORE = {FOPDT: SECOND_ORDER, SECOND_ORDER: THIRD_ORDER}
WINDOW = 2.0 * math.log(20.0)
"""How much higher the criterion of a form may be that is as plain: odds of 20 (Madigan and Raftery)."""
ALIKE_MISFIT = 1.04
"""Ratio of the errors on the part not fitted under which two forms predict it about as well."""
FOLLOWED = 5
"""Closest effects whose other starts are tried."""
SHARES = (0.05, 0.2)
"""Initial guesses of the further lag, relative to the longest number of the process."""


@lru_cache(maxsize=4)
def neighbours(context: FitContext, chosen: Fitted, pool: tuple[Fitted, ...] = ()) -> Neighbours:
    """Return the explanation and all others that count, each with its weight; `pool` has other forms. Cached.

    All are as fitted to the fitted and the selection part together.
    """
    final = to_both_parts(context, chosen)
    if chosen.rms > VISIBLE * noise_of(context, chosen):
        return ((1.0, final),)
    lag = one_lag_more(context, chosen)
    others = (in_another_form(context, chosen, effect) for effect in chosen.problem.effects)
    pool = (*pool, *(other for other in others if other is not None and is_physical(other)))
    near = [*_alike(context, chosen, pool), *([] if lag is None else [lag]), *_with_next_terms(context, chosen)]
    found = [to_both_parts(context, f) for f in near]
    samples = final.residual.size / context.colour(final)
    gains = {f: samples * math.log(final.misfit / f.misfit) - 2.0 * (f.size - final.size) for f in found}
    kept = {f: gain for f, gain in gains.items() if gain > (0.0 if f.size > final.size else -WINDOW)}
    best = max(kept.values(), default=0.0)
    weights = {f: math.exp((gain - max(best, 0.0)) / 2.0) for f, gain in {final: 0.0, **kept}.items()}
    return tuple((weight / sum(weights.values()), f) for f, weight in weights.items())


def _alike(context: FitContext, chosen: Fitted, pool: tuple[Fitted, ...]) -> list[Fitted]:
    """Return the other forms of a pool, one of each, that predict the part not fitted about as well."""
    problem, known = chosen.problem, {tuple(e.key for e in chosen.problem.effects)}
    most = ALIKE_MISFIT * math.hypot(context.held_out_error(chosen), context.dataset.floor)
    found, split = [], _is_split(chosen)
    for other in closest_first(c for c in pool if c.problem.dataset is problem.dataset and c.problem.fixed is None):
        form = tuple(e.key for e in other.problem.effects)
        if form in known or len(form) != len(problem.effects) or _is_split(other) != split:
            continue
        known.add(form)
        found += [_as_plain(chosen, other)] if context.held_out_error(other) < most else []
    return found


def _as_plain(chosen: Fitted, other: Fitted) -> Fitted:
    """Return another form with one lag where the chosen one needs no second: both are then as rich."""
    problem = other.problem
    if chosen.problem.structure is not FOPDT or problem.structure is not SECOND_ORDER:
        return other
    single = fit(replace(problem, structure=FOPDT), np.delete(other.theta, 1), FINE_STEPS)
    return single if is_physical(single) else other


def _is_split(candidate: Fitted) -> bool:
    """Return whether the gain of the process is but a part of the whole one."""
    return bool(shares_beside(candidate.sizes()))


@lru_cache(maxsize=4)
def one_lag_more(context: FitContext, chosen: Fitted) -> Fitted | None:
    """Return the explanation with a further lag of the process; None where it can have none. Cached."""
    problem = chosen.problem
    other = any(e.response is not None or e.makes_late for e in problem.effects)
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
    at = len(chosen.problem.structure.shape) + 1
    ends = np.cumsum([at, *(len(e.searched) for e in chosen.problem.effects)])
    end = ends[chosen.problem.effects.index(effect) + 1]
    more = len(richer.searched) - len(effect.searched)
    return replace(chosen.problem, effects=effects), np.insert(chosen.theta, [end] * more, 0.0)


def values_of(chosen: Fitted, effect: Effect) -> Sequence[float]:
    """Return the fitted values of one of the effects."""
    _, _, values = chosen.problem.split(chosen.theta)
    return next(p for e, p in zip(chosen.problem.effects, values, strict=True) if e is effect)


def exchanged(
    chosen: Fitted, effect: Effect, other: Effect, values: Sequence[float], steps: int = FINE_STEPS
) -> Fitted:
    """Return the explanation with one effect replaced by another one, fitted from given values."""
    head = chosen.theta[: len(chosen.problem.structure.shape) + 1]
    _, _, known = chosen.problem.split(chosen.theta)
    parts = [list(values) if e is effect else p for e, p in zip(chosen.problem.effects, known, strict=True)]
    problem = replace(chosen.problem, effects=tuple(other if e is effect else e for e in chosen.problem.effects))
    return fit(problem, np.concatenate([head, *(np.array(p, dtype=np.float64) for p in parts)]), steps)


def closest_exchanged(
    context: FitContext,
    chosen: Fitted,
    effect: Effect,
    others: Iterable[tuple[Effect, Sequence[float]]],
    steps: int,
) -> Fitted | None:
    """Return the explanation with the closest of some effects in place of one, by a few samples; then fitted to all."""
    thinned = replace(chosen, problem=replace(chosen.problem, rows=context.coarse))
    tried = [
        exchanged(thinned, effect, other, values, steps) for other, values in within(context.dataset.budget, others)
    ]
    if not tried:
        return None
    closest = closest_first(tried)[0]
    return fit(replace(closest.problem, rows=context.fine), closest.theta, FINE_STEPS)


@lru_cache(maxsize=16)
def in_another_form(context: FitContext, chosen: Fitted, effect: Effect) -> Fitted | None:
    """Return the explanation with one effect in the closest of its other forms; None without any. Cached."""
    starts = ((form, start) for form in effect.other_forms for start in _starts_from(chosen, effect, form))
    return closest_exchanged(context, chosen, effect, starts, QUICK_STEPS)


def _starts_from(chosen: Fitted, effect: Effect, form: Effect) -> list[tuple[float, ...]]:
    """Return the starts of another form, with what was found for numbers of the same name; a choice is left open."""
    known = {s.name: value for s, value in zip(effect.searched, values_of(chosen, effect), strict=True) if s.step}
    starts = (
        tuple(known.get(s.name, value) for s, value in zip(form.searched, start, strict=True)) for start in form.starts
    )
    return list(dict.fromkeys(starts))


def with_other_starts(context: FitContext, found: Sequence[Fitted]) -> list[Fitted]:
    """Return the closest effects of the actuator from those of their starts that predict the other part best.

    A band wider than all moves, or a limit that none reaches, has no slope. The fitted part leaves such numbers open
    where the closest explanation leaves noise there and fails on the other part.
    """
    if not found or context.dataset.tuned or not _fails_later(context, found[0]):
        return []
    alone = [c for c in found if len(c.names) == 1 and c.problem.effects[0].place is Place.ACTUATOR]
    near = {c.problem.effects[0].key: c for c in reversed(alone) if c.rms < AS_NEAR * found[0].rms}
    tried = [_from_each_start(context, c, c.problem.effects[0]) for c in list(near.values())[-FOLLOWED:]]
    return [c for of in tried for c in best_on_both_parts(context, of)[:1]]


def _fails_later(context: FitContext, candidate: Fitted) -> bool:
    return candidate.rms < NOTHING_LEFT * noise_of(context, candidate) and not is_near_later(context, candidate)


def _from_each_start(context: FitContext, chosen: Fitted, effect: Effect) -> list[Fitted]:
    """Return an explanation from each start of its effect, as far as these come as near on the fitted part."""
    thinned = replace(chosen, problem=replace(chosen.problem, rows=context.coarse))
    tried = [
        exchanged(thinned, effect, effect, start, QUICK_STEPS)
        for start in within(context.dataset.budget, effect.starts)
    ]
    again = [refined(context, c) for c in tried if c.rms < AS_NEAR * chosen.rms]
    return [c for c in again if c.rms < AS_NEAR * chosen.rms and is_physical(c)]
