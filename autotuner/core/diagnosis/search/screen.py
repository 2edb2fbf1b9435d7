"""A cheap score for every start of every effect: the residual when the process may move along its tangent.

For an effect that only adds columns, the tangent of the process is the same for all its starts and is computed once:

    left = |r|^2 - |P c'r|^2,   r = (I - Q Q') pv,   Q an orthonormal basis of columns and tangent

An effect that changes the input or the response moves the tangent too. Its starts are compared with that of the base,
and the best of them evaluated again with their own. Each start is also compared beside the answer of the base, so that
the change may have any strength: far from its size, an effect is worse than none.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.extended_model import Extended, linearised, without_rounding
from autotuner.core.estimation.linear_least_squares import residual_after, solve_linear

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.extended.effect import Effect, View
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext
    from autotuner.core.model.arrays import FloatArray

KEPT, LOOKED_AT_AGAIN = 2, 3
"""Starts of an effect from which a few steps are taken, and from which those are picked by their own tangent."""


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """An effect added to a base, and where its search begins.

    Two scores: as it is, and beside the answer of the base, by which the effect has any strength.
    """

    effect: Effect
    problem: Extended
    theta: FloatArray
    score: float
    at_any_strength: float


@dataclass(frozen=True, slots=True, eq=False)
class Tangent:
    """A base with all directions in which it may move.

    Attributes
    ----------
    base : Fitted
        The base.
    basis : array of float, shape (N, Q)
        Orthonormal basis of its columns and slopes on the screening samples.
    left : array of float, shape (N,)
        What they leave of the PV.
    slopes : array of float, shape (N, P)
        The slopes alone.
    background : array of float, shape (N, B)
        What the PV does besides.
    answers : array of float, shape (N, G)
        Its answer to the output. A mix of it and the answer of a changed process is a change of another strength.
    """

    base: Fitted
    basis: FloatArray
    left: FloatArray
    slopes: FloatArray
    background: FloatArray
    answers: FloatArray


def tangent_of(context: FitContext, base: Fitted) -> Tangent:
    """Return a base with its tangent."""
    problem = replace(base.problem, rows=context.screen)
    columns, slopes = problem.tangent(base.theta)
    pv = context.dataset.data.pv[context.screen]
    basis, _ = solve_linear(np.hstack((columns, slopes)), pv)
    background = columns[:, problem.structure.gains + sum(base.counts) :]
    return Tangent(base, basis, pv - basis @ (basis.T @ pv), slopes, background, columns[:, : problem.structure.gains])


def screened(context: FitContext, tangents: Sequence[Tangent], effect: Effect) -> tuple[list[Start], Start | None]:
    """Return the best starts of an effect over all bases, the best first, and the best one at any strength."""
    starts = [start for tangent in tangents for start in _scored(context, tangent, effect)]
    ranked = without_rounding(starts, lambda s: s.score)
    if effect.only_adds or not ranked:
        return ranked[:KEPT], None
    again = [replace(s, score=linearised(s.problem, s.theta)) for s in ranked[:LOOKED_AT_AGAIN]]
    return without_rounding(again, lambda s: s.score)[:KEPT], without_rounding(starts, lambda s: s.at_any_strength)[0]


def _scored(context: FitContext, tangent: Tangent, effect: Effect) -> list[Start]:
    base = tangent.base
    if not fits_beside(effect, base.problem.effects):
        return []
    problem = replace(base.problem.with_effect(effect), rows=context.screen)
    score = _scores_of_columns if effect.only_adds else _scores_of_change
    return [
        Start(effect, problem, theta, *score(context, tangent, effect, problem, theta, values))
        for values in effect.starts
        for theta in [theta_with(base, problem, effect, values)]
    ]


def _scores_of_change(
    context: FitContext,
    tangent: Tangent,
    _effect: Effect,
    problem: Extended,
    theta: FloatArray,
    _values: Sequence[float],
) -> tuple[float, float]:
    columns, _ = problem.columns_of(problem.view(theta, context.screen), theta, tangent.background)
    pv = context.dataset.data.pv[context.screen]
    beside = np.hstack((columns, tangent.slopes))
    left = [residual_after(c, pv) for c in (beside, np.hstack((beside, tangent.answers)))]
    as_it_is, at_any_strength = (float(r @ r) / r.size for r in left)
    return as_it_is, at_any_strength


def _scores_of_columns(
    context: FitContext, tangent: Tangent, effect: Effect, problem: Extended, theta: FloatArray, values: Sequence[float]
) -> tuple[float, float]:
    assert effect.columns is not None  # noqa: S101 - what changes neither position nor response adds columns
    view: View = problem.view(theta, context.screen)
    added = effect.columns(view, values)
    if not len(added):
        return np.inf, np.inf
    columns = np.column_stack(list(added))
    columns = columns - tangent.basis @ (tangent.basis.T @ columns)
    left = residual_after(columns, tangent.left)
    score = float(left @ left) / left.size
    return score, score  # their sizes are linear


def fits_beside(effect: Effect, others: Sequence[Effect]) -> bool:
    """Return whether an effect can be added to others."""
    same = any(other.name == effect.name or (effect.group and other.group == effect.group) for other in others)
    two_responses = effect.response is not None and any(other.response is not None for other in others)
    return not same and not two_responses


def theta_with(base: Fitted, problem: Extended, effect: Effect, start: Sequence[float]) -> FloatArray:
    """Return the base's `theta` with the start of one effect at its place among the others."""
    size = len(problem.structure.shape) + 1
    _, _, values = base.problem.split(base.theta)
    known = {e.key: v for e, v in zip(base.problem.effects, values, strict=True)}
    parts = [list(start) if e is effect else known[e.key] for e in problem.effects]
    return np.concatenate([base.theta[:size], *(np.array(p, dtype=np.float64) for p in parts)])
