"""One step of the search: a base extended by one effect more, and an explanation without one of its effects.

screen   every start of every effect by its linearised score (see `screen`)
quick    a few steps from the best starts on few samples
coarse   more steps for the most promising on more samples
fine     the best on all fitted samples, jointly with the process
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import takewhile
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from autotuner.core.diagnosis.effects.disturbance import load_at_the_input
from autotuner.core.diagnosis.extended.base import is_physical
from autotuner.core.diagnosis.extended.extended_model import Fitted, closest_first, plainness, without_rounding
from autotuner.core.diagnosis.extended.fitting import ENOUGH_FOR_RANKS, fit
from autotuner.core.diagnosis.search.judge import OF_TIME, is_beside_free_load
from autotuner.core.diagnosis.search.screen import screened, tangent_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from autotuner.core.diagnosis.extended.effect import Effect
    from autotuner.core.diagnosis.extended.fit_context import FitContext
    from autotuner.core.diagnosis.record.budget import Budget
    from autotuner.core.diagnosis.search.screen import Start
    from autotuner.core.model.arrays import FloatArray, IntArray

QUICK_STEPS, COARSE_STEPS, FINE_STEPS = 5, 15, 30
FIRST, FURTHER = (24, 9, 7), (12, 8, 5)
"""Number of effects that continue to the next stage: for the first one, and for a further one of each explanation."""
OF_ANY_STRENGTH = 3
"""Effects that continue besides, by their scores at any strength."""


Item = TypeVar("Item")
ALWAYS_TRIED = frozenset({"backlash", "stiction", "rate_limit"})
"""Effects that are always carried on: far from its size, one is worse than none, however well it fits in the end."""
AS_NEAR = 1.1
"""Ratio of the misfits up to which an explanation comes as near as another one: noise of 100 samples makes as much."""
SECOND_LAG = 0.3
"""Second lag to start from, over the first."""
SAME = 1.02
"""Ratio of the misfits up to which another way of writing a candidate is the same."""


def extend(context: FitContext, bases: Sequence[Fitted], effects: Sequence[Effect]) -> list[Fitted]:
    """Return the bases with one effect more, the most promising fitted on all samples, the best first."""
    return finished(context, sketched(context, bases, effects))


def sketched(context: FitContext, bases: Sequence[Fitted], effects: Sequence[Effect]) -> list[Fitted]:
    """Return the bases with one effect more after a few steps, each effect once, the best first."""
    budget = context.dataset.budget
    tangents = [tangent_of(context, base) for base in bases]
    scored = [screened(context, tangents, effect) for effect in within(budget, effects)]
    ranked = without_rounding([starts for starts, _ in scored if starts], lambda starts: starts[0].score)
    count = (FURTHER if bases[0].problem.effects else FIRST)[0]
    rows = [*ranked[:count], *(starts for starts in ranked[count:] if starts[0].effect.key in ALWAYS_TRIED)]
    rows += _at_any_strength([start for _, start in scored if start is not None], rows)
    return closest_first(
        _as_the_process_feels_it(context, closest_first(s.fitted(QUICK_STEPS, ENOUGH_FOR_RANKS) for s in of)[0])
        for of in within(budget, rows)
    )


def _at_any_strength(starts: Sequence[Start], known: Sequence[Sequence[Start]]) -> list[list[Start]]:
    """Return the most promising starts of other effects: far from its size, one is worse than none."""
    tried = {of[0].effect.key for of in known}
    ranked = without_rounding([s for s in starts if s.effect.key not in tried], lambda s: s.at_any_strength)
    return [[s] for s in ranked[:OF_ANY_STRENGTH]]


def finished(context: FitContext, quick: Sequence[Fitted]) -> list[Fitted]:
    """Return the most promising of these fitted on all samples, the best first."""
    budget = context.dataset.budget
    first = all(len(c.problem.effects) < 2 for c in quick)
    _, to_coarse, to_fine = FIRST if first else FURTHER
    several = quick if first else _of_many_names(quick)
    chosen = _first_and_alike(several, to_coarse)
    coarse = [_again(context.coarse, c, COARSE_STEPS, ENOUGH_FOR_RANKS) for c in within(budget, chosen)]
    closest = _first_and_alike(_of_many_names(closest_first(coarse)), to_fine)
    fine = [refined(context, c) for c in within(budget, closest)]
    return [c for c in closest_first(fine) if is_physical(c)]


def in_each_form(context: FitContext, base: Fitted, forms: Sequence[Effect]) -> list[Fitted]:
    """Return a base with each form of an effect fitted on all samples, and not only the closest and the plainest."""
    found = [refined(context, c) for c in within(context.dataset.budget, sketched(context, [base], forms))]
    return [c for c in closest_first(found) if is_physical(c)]


def _first_and_alike(ranked: Sequence[Fitted], count: int) -> list[Fitted]:
    """Return the first of a ranking, and the closest of every further name that comes as near as the first one.

    In a short record, several effects explain a few moves equally well: which they are is a part of the answer.
    """
    first, names = list(ranked[:count]), {c.names for c in ranked[:count]}
    for candidate in ranked[count:]:
        if candidate.names not in names and candidate.rms < AS_NEAR * ranked[0].rms:
            first.append(candidate)
            names.add(candidate.names)
    return first


def within(budget: Budget, items: Iterable[Item]) -> Iterator[Item]:
    """Yield items while there is time."""
    return takewhile(lambda _: not budget.spent, items)


def _as_the_process_feels_it(context: FitContext, candidate: Fitted) -> Fitted:
    """Return a candidate with its load step at the input where the process answers to its own PV: a load moves it."""
    answers = any(effect.response is not None for effect in candidate.problem.effects)
    return at_the_input(context, candidate) if answers else candidate


def at_the_input(context: FitContext, candidate: Fitted) -> Fitted:
    """Return a candidate whose load step is at the input of the process, so that further effects respond to it."""
    load = next((e for e in candidate.problem.effects if e.name == "load_step" and e.load is None), None)
    size = next((s["size"] for s in candidate.sizes() if "size" in s and load is not None), None)
    if load is None or size is None or not abs(size) < 3.0 * context.dataset.swing:
        return candidate
    entering = load_at_the_input(context.dataset)
    effects = tuple(entering if e is load else e for e in candidate.problem.effects)
    _, _, values = candidate.problem.split(candidate.theta)
    head = candidate.theta[: len(candidate.problem.structure.shape) + 1]
    parts = [
        [p[0], size / context.dataset.swing] if e is load else p
        for e, p in zip(candidate.problem.effects, values, strict=True)
    ]
    theta = np.concatenate([head, *(np.array(p, dtype=np.float64) for p in parts)])
    moved = fit(replace(candidate.problem, effects=effects), theta, QUICK_STEPS)
    return moved if moved.rms < SAME * candidate.rms else candidate


def _of_many_names(candidates: Sequence[Fitted]) -> list[Fitted]:
    """Return of each set of names the closest form and the simplest, so that no name crowds the others out."""
    forms: dict[tuple[str, ...], list[Fitted]] = {}
    for candidate in candidates:
        forms.setdefault(tuple(sorted(candidate.names)), []).append(candidate)
    kept = [{id(c): c for c in (of[0], min(of, key=plainness))} for of in forms.values()]
    return closest_first([c for of in kept for c in of.values()])


def _again(rows: np.ndarray, candidate: Fitted, steps: int, enough: float) -> Fitted:
    return fit(replace(candidate.problem, rows=rows), candidate.theta, steps, enough)


def better_of(context: FitContext, explanations: list[Fitted]) -> Fitted:
    """Return the best of explanations with as many effects each."""
    if context.dataset.tuned:
        return context.best(explanations)
    return best_on_both_parts(context, explanations)[0]


def best_on_both_parts(context: FitContext, candidates: Iterable[Fitted]) -> list[Fitted]:
    """Return candidates by that, the best first, the plainer one where that is the same.

    Where the best one has a load of free shape beside another effect, its error on the other part is that of the load:
    all such are ranked by the criterion, and come first.
    """
    ranked = without_rounding(candidates, context.on_both_parts, plainness)
    if not ranked or not is_beside_free_load(ranked[0]):
        return ranked
    free = [c for c in ranked if is_beside_free_load(c)]
    others = [c for c in ranked if not is_beside_free_load(c)]
    return [*context.by_criterion(free, min(map(context.colour, free))), *others]


def first_of_each(ranked: Iterable[Fitted], kind: Callable[[Fitted], object]) -> list[Fitted]:
    """Return the first of each kind in a ranking."""
    kept: dict[object, Fitted] = {}
    for candidate in ranked:
        kept.setdefault(kind(candidate), candidate)
    return list(kept.values())


def with_second_lag(theta: FloatArray) -> FloatArray:
    """Return the numbers of a process of one lag, with effects, as a start for one of two."""
    return np.insert(theta, 1, theta[0] + math.log(SECOND_LAG))


def free_load_of(effects: Sequence[Effect]) -> Effect | None:
    """Return the first load of free shape among effects; None without one."""
    return next((e for e in effects if e.reads_as is not None), None)


def form_of(effects: Sequence[Effect], name: str, form: str = "") -> Effect | None:
    """Return the effect of a name in one of its forms, the plain one if none is given; None without it."""
    return next((e for e in effects if e.name == name and e.form == form), None)


def disturbances_of(effects: Sequence[Effect]) -> list[Effect]:
    """Return the effects that are functions of time, but for measured ones."""
    return [e for e in effects if e.place in OF_TIME and not e.measured]


def has_several(context: FitContext, candidate: Fitted) -> bool:
    """Return whether a record that is no experiment has several effects, all of which were searched for."""
    found = candidate.problem.effects
    return not context.dataset.tuned and len(found) > 1 and not any(effect.measured for effect in found)


def refined(context: FitContext, candidate: Fitted) -> Fitted:
    """Return a candidate fitted on all samples."""
    return _again(context.fine, candidate, FINE_STEPS, ENOUGH_FOR_RANKS / 10.0)


def without(context: FitContext, candidate: Fitted, dropped: Effect) -> Fitted:
    """Return a candidate refitted without one of its effects."""
    return _of(candidate, [e for e in candidate.problem.effects if e is not dropped], context.fine, FINE_STEPS)


def alone_beside(context: FitContext, candidate: Fitted, *kept: Effect) -> Fitted:
    """Return the process of a candidate as it is with some of its effects: a start for others beside those."""
    return _of(candidate, kept, context.coarse, 0)


def _of(candidate: Fitted, effects: Sequence[Effect], rows: IntArray, steps: int) -> Fitted:
    """Return a candidate fitted with some of its effects only."""
    size = len(candidate.problem.structure.shape) + 1
    _, _, values = candidate.problem.split(candidate.theta)
    parts = [np.array(v) for e, v in zip(candidate.problem.effects, values, strict=True) if e in effects]
    theta = np.concatenate([candidate.theta[:size], *parts])
    return fit(replace(candidate.problem, effects=tuple(effects), rows=rows), theta, steps)
