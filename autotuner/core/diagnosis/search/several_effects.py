"""Explanations by several effects: each is searched again beside the others, and tried in its other forms.

Where a search begins decides which effect it finds first, and beside which of them it finds the second one.
"""

from __future__ import annotations

from itertools import permutations
from typing import TYPE_CHECKING

from autotuner.core.diagnosis.extended.base import is_physical
from autotuner.core.diagnosis.extended.extended_model import closest_first
from autotuner.core.diagnosis.search.acceptance import is_noise
from autotuner.core.diagnosis.search.judge import is_beside_free_load, is_near_noise
from autotuner.core.diagnosis.search.search import (
    AS_NEAR,
    alone_beside,
    at_the_input,
    best_on_both_parts,
    disturbances_of,
    extend,
    first_of_each,
    has_several,
    in_each_form,
    within,
    without,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.extended.effect import Effect
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext

EXCHANGED = 3
"""Pairs whose effects are searched again, each beside the other, and tried in other forms."""
WITHOUT = 3
"""Explanations beside a disturbance that are tried without it."""


def with_exchanged_effects(context: FitContext, found: Sequence[Fitted], effects: Sequence[Effect]) -> list[Fitted]:
    """Return pairs with either effect of the closest ones searched again, from the process that the two leave.

    A free load beside the right effect follows the other one, and shows the process; a first effect that was accepted
    alone may stand in for another, which is found beside the second only. A measured disturbance is known, and stays.
    """
    pairs = [at_the_input(context, c) for c in _to_improve(context, found)[:EXCHANGED]]
    kept = [
        (c, e)
        for c in pairs
        for e in c.problem.effects
        if e.reads_as is None and not any(other.measured for other in c.problem.effects if other is not e)
    ]
    return extend(context, [alone_beside(context, c, e) for c, e in kept], effects) if kept else []


def with_exchanged_forms(context: FitContext, found: Sequence[Fitted], effects: Sequence[Effect]) -> list[Fitted]:
    """Return the closest pairs with either effect in the other forms of its name.

    A form whose size is far from each start looks no better than none beside another effect, and is passed over. A
    measured disturbance is known, and stays.
    """
    pairs = [c for c in _to_improve(context, found) if not is_beside_free_load(c)][:EXCHANGED]
    exchanges = [
        (alone_beside(context, c, kept), forms)
        for c in pairs
        for kept, exchanged in permutations(c.problem.effects)
        if not exchanged.measured
        and (forms := [e for e in effects if e.name == exchanged.name and e.form != exchanged.form])
    ]
    return [c for beside, forms in exchanges for c in in_each_form(context, beside, forms)]


def _to_improve(context: FitContext, found: Sequence[Fitted]) -> list[Fitted]:
    """Return the pairs of a record that is no experiment, the closest first; none where something leaves only noise."""
    if context.dataset.tuned or any(is_noise(context, c) for c in found):
        return []
    return [c for c in distinct(found) if len(c.names) == 2]


def with_each_searched_again(
    context: FitContext, chosen: Fitted, effects: Sequence[Effect]
) -> tuple[Fitted, list[Fitted]]:
    """Return several effects, each the best one beside the others, and all that was tried.

    Where a search begins decides which of several effects it finds beside another one. Where they leave more than
    noise, they were exchanged before: then, only others at the same place are tried.
    """
    tried: list[Fitted] = []
    if not has_several(context, chosen):
        return chosen, tried
    is_left = not is_near_noise(context, chosen)
    for effect in chosen.problem.effects:
        kept = [e for e in chosen.problem.effects if e is not effect]
        others = [e for e in effects if e.name not in chosen.names and (not is_left or e.place is effect.place)]
        if effect.reads_as is None and others and not context.dataset.budget.spent:
            tried += extend(context, [alone_beside(context, chosen, *kept)], others)
    near = [c for c in tried if context.criterion(c, 1.0) < context.criterion(chosen, 1.0)]
    return best_on_both_parts(context, [chosen, *near])[0], tried


def without_disturbance(context: FitContext, best: Fitted, chosen: Fitted, pool: Sequence[Fitted]) -> list[Fitted]:
    """Return other explanations without their disturbance, where the chosen one is the best one without its own.

    Beside a disturbance they were found, and alone they were not searched for: the chosen one may be one of several.
    """
    gone = [e for e in best.problem.effects if e.name not in chosen.names]
    if len(gone) != 1 or not disturbances_of(gone) or len(best.names) != len(chosen.names) + 1 or not chosen.names:
        return []
    beside = [
        c for c in distinct(closest_first(pool)) if len(c.names) == len(best.names) and c.rms < AS_NEAR * best.rms
    ]
    others = [(c, e) for c in beside for e in disturbances_of(c.problem.effects)]
    others = [(c, e) for c, e in others if {*c.names} - {e.name} != {*chosen.names}][:WITHOUT]
    left = [without(context, c, e) for c, e in within(context.dataset.budget, others)]
    return [c for c in left if is_physical(c)]


def distinct(found: Sequence[Fitted]) -> list[Fitted]:
    """Return the best of each set of names."""
    return first_of_each(found, lambda candidate: tuple(sorted(candidate.names)))
