"""An explanation with one of its effects exchanged: for another one, for another form of it, or from another start."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from itertools import takewhile
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.base import is_physical
from autotuner.core.diagnosis.extended.effect import Place
from autotuner.core.diagnosis.extended.extended_model import closest_first
from autotuner.core.diagnosis.extended.fitting import fit
from autotuner.core.diagnosis.search.acceptance import is_near_later
from autotuner.core.diagnosis.search.judge import is_near_noise
from autotuner.core.diagnosis.search.search import (
    AS_NEAR,
    FINE_STEPS,
    QUICK_STEPS,
    best_on_both_parts,
    first_of_each,
    refined,
    within,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from autotuner.core.diagnosis.extended.effect import Effect
    from autotuner.core.diagnosis.extended.extended_model import Extended, Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext

FOLLOWED = 5
"""Closest effects whose other starts are tried."""


def values_of(chosen: Fitted, effect: Effect) -> Sequence[float]:
    """Return the fitted values of one of the effects."""
    _, _, values = chosen.problem.split(chosen.theta)
    return next(p for e, p in zip(chosen.problem.effects, values, strict=True) if e is effect)


def first_number(problem: Extended, effect: Effect) -> int:
    """Return where the numbers of one of the effects begin in `theta`."""
    before = takewhile(lambda other: other is not effect, problem.effects)
    return len(problem.structure.shape) + 1 + sum(len(other.searched) for other in before)


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
    tried = _by_few_samples(context, chosen, effect, others, steps)
    return _on_all_samples(context, closest_first(tried)[0]) if tried else None


def _by_few_samples(
    context: FitContext,
    chosen: Fitted,
    effect: Effect,
    others: Iterable[tuple[Effect, Sequence[float]]],
    steps: int,
) -> list[Fitted]:
    """Return the explanation with each of some effects in place of one, from given values, by a few samples."""
    thinned = replace(chosen, problem=replace(chosen.problem, rows=context.coarse))
    return [
        exchanged(thinned, effect, other, values, steps) for other, values in within(context.dataset.budget, others)
    ]


@lru_cache(maxsize=64)
def _on_all_samples(context: FitContext, candidate: Fitted) -> Fitted:
    """Return a candidate fitted to all samples, however its fit on a few of them ended. Cached."""
    return fit(replace(candidate.problem, rows=context.fine), candidate.theta, FINE_STEPS)


def in_near_forms(context: FitContext, chosen: Fitted, effect: Effect) -> list[Fitted]:
    """Return the explanation with one effect in each of its other forms that comes about as near as the closest one."""
    coarse = _in_other_forms(context, chosen, effect)
    near = (_on_all_samples(context, c) for c in coarse if c.rms < AS_NEAR * coarse[0].rms)
    return [c for c in near if is_physical(c)]


@lru_cache(maxsize=16)
def _in_other_forms(context: FitContext, chosen: Fitted, effect: Effect) -> tuple[Fitted, ...]:
    """Return the explanation with one effect in each other form, by a few samples, the closest first. Cached."""
    tried = [
        closest_first(_by_few_samples(context, chosen, effect, starts, QUICK_STEPS))
        for form in _others_of(effect)
        if (starts := [(form, start) for start in _starts_from(chosen, effect, form)])
    ]
    return tuple(closest_first(of[0] for of in tried if of))


@lru_cache(maxsize=64)
def _others_of(effect: Effect) -> tuple[Effect, ...]:
    """Return the other forms of an effect, each with the rest of them and the effect itself as its own others. Cached.

    What the closest one leaves open is then seen too.
    """
    family = (effect, *effect.other_forms)
    return tuple(
        form if form.other_forms else replace(form, other_forms=tuple(other for other in family if other is not form))
        for form in effect.other_forms
    )


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
    near = first_of_each((c for c in alone if c.rms < AS_NEAR * found[0].rms), lambda c: c.keys)
    tried = [_from_each_start(context, c, c.problem.effects[0]) for c in near[:FOLLOWED]]
    return [c for of in tried for c in best_on_both_parts(context, of)[:1]]


def _fails_later(context: FitContext, candidate: Fitted) -> bool:
    return is_near_noise(context, candidate) and not is_near_later(context, candidate)


def _from_each_start(context: FitContext, chosen: Fitted, effect: Effect) -> list[Fitted]:
    """Return an explanation from each start of its effect, as far as these come as near on the fitted part."""
    thinned = replace(chosen, problem=replace(chosen.problem, rows=context.coarse))
    tried = [
        exchanged(thinned, effect, effect, start, QUICK_STEPS)
        for start in within(context.dataset.budget, effect.starts)
    ]
    again = [refined(context, c) for c in tried if c.rms < AS_NEAR * chosen.rms]
    return [c for c in again if c.rms < AS_NEAR * chosen.rms and is_physical(c)]
