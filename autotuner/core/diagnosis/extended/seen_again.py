"""A model whose single events are those that more samples show: jumps between two samples, updates of an actuator.

What begins and ends in a part of the record says nothing of another one. There, such events are found again beside the
process as it is.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.effect import Seen

if TYPE_CHECKING:
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import IntArray


def with_own_events(fitted: Fitted, dataset: Dataset, until: int) -> Fitted:
    """Return a model with the events of samples until then, if those before say nothing of them; as it is otherwise."""
    own = any(effect.unseen_after and effect.seen_again is not None for effect in fitted.problem.effects)
    return as_seen_again(fitted, dataset, until) if own else fitted


@lru_cache(maxsize=32)
def as_seen_again(fitted: Fitted, dataset: Dataset, until: int) -> Fitted:
    """Return a model with each effect that no fit can move as more samples show it, where they do. Cached.

    Parameters
    ----------
    fitted : Fitted
        The model.
    dataset : Dataset
        The record, in the units and about the values of the model's own.
    until : int
        How many of its samples are seen.
    """
    if all(effect.seen_again is None for effect in fitted.problem.effects):
        return fitted
    fitted, rows = fitted.on(dataset), np.flatnonzero(~dataset.spikes[:until])
    problem = fitted.problem
    effects, parts = [], [fitted.theta[: len(problem.structure.shape) + 1]]
    for k, (effect, p) in enumerate(zip(problem.effects, problem.split(fitted.theta)[2], strict=True)):
        again = None if effect.seen_again is None else effect.seen_again(left_to(fitted, k, rows))
        effects.append(effect if again is None else again)
        parts.append(np.array(p if again is None else again.starts[0]))
    return replace(fitted, problem=replace(problem, effects=tuple(effects)), theta=np.concatenate(parts))


def left_to(fitted: Fitted, k: int | None, rows: IntArray) -> Seen:
    """Return samples, and what a model leaves of them to its k-th effect; None for one that it does not have yet."""
    problem, at = fitted.problem, fitted.problem.structure.gains
    first = at + sum(fitted.counts[:k])
    own = np.s_[first : first + (0 if k is None else fitted.counts[k])]
    view = problem.view(fitted.theta, np.arange(rows[-1] + 1))
    columns = problem.columns_of(view, fitted.theta)[0][rows]
    left = problem.dataset.data.pv[rows] - np.delete(columns, own, axis=1) @ np.delete(fitted.linear, own)
    others = [effect for j, effect in enumerate(problem.effects) if j != k]
    return Seen(view, rows, left, float(fitted.linear[0]), all(effect.only_adds for effect in others))
