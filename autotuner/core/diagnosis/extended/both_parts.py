"""What is reported of a model: its numbers as fitted to the fitted and the selection part together.

An explanation is chosen by its error on the selection part, which must not have been fitted until then. Afterwards
that part says as much about the numbers as the fitted one does, and lies closer to what follows.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.base import is_physical
from autotuner.core.diagnosis.extended.fit_context import MOST_SAMPLES, thinned
from autotuner.core.diagnosis.extended.fitting import fit

if TYPE_CHECKING:
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext
    from autotuner.core.model.arrays import IntArray

STEPS = 30
"""Most steps of the optimiser from the numbers of the fitted part, which are near."""


@lru_cache(maxsize=32)
def to_both_parts(context: FitContext, fitted: Fitted) -> Fitted:
    """Return a model fitted to both parts together; itself where that leads elsewhere. Cached.

    A tuning's tail is no experiment: it has few moves, and is not fitted.
    """
    if fitted.problem.dataset is not context.dataset or context.dataset.tuned:
        return fitted
    rows = np.flatnonzero(context.dataset.fitted | context.dataset.held_out)
    seen = _as_seen_again(fitted, rows)
    again = fit(replace(seen.problem, rows=thinned(rows, MOST_SAMPLES)), seen.theta, STEPS)
    return again if is_physical(again) else fitted


def _as_seen_again(fitted: Fitted, rows: IntArray) -> Fitted:
    """Return a model with each effect that no fit can move as more samples show it, where they do."""
    problem, at = fitted.problem, fitted.problem.structure.gains
    if all(effect.seen_again is None for effect in problem.effects):
        return fitted
    size = len(problem.structure.shape) + 1
    columns, pv = problem.columns(fitted.theta, rows)[0], problem.dataset.data.pv[rows]
    effects, parts = [], [fitted.theta[:size]]
    for effect, p, count in zip(problem.effects, problem.split(fitted.theta)[2], fitted.counts, strict=True):
        own = np.s_[at : at + count]
        beside = pv - np.delete(columns, own, axis=1) @ np.delete(fitted.linear, own)
        again = None if effect.seen_again is None else effect.seen_again(rows, beside)
        effects.append(effect if again is None else again)
        parts.append(np.array(p if again is None else again.starts[0]))
        at += count
    return replace(fitted, problem=replace(problem, effects=tuple(effects)), theta=np.concatenate(parts))
