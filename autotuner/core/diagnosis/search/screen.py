"""A cheap score for every start of every effect: the residual when the process may move along its tangent.

For an effect that only adds columns, the tangent of the process is the same for all its starts and is computed once:

    left = |r|^2 - |P c'r|^2,   r = (I - Q Q') pv,   Q an orthonormal basis of columns and tangent

An effect that changes the input or the response moves the tangent too. Its starts are compared with that of the base,
and the best of them evaluated again with their own. Each start is also compared beside the answer of the base, so that
the change may have any strength: far from its size, an effect is worse than none.

All starts of an effect on a base are computed at once, orthogonalised twice against what they share (Giraud, Langou and
Rozloznik, Comput. Math. Appl. 50, 2005).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.extended_model import Extended, without_rounding
from autotuner.core.diagnosis.extended.fitting import Point, fit, tangent
from autotuner.core.estimation.linear_least_squares import DEPENDENT, solve_linear

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.extended.effect import Effect
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext
    from autotuner.core.model.arrays import FloatArray

KEPT, LOOKED_AT_AGAIN = 2, 3
"""Starts of an effect from which a few steps are taken, and from which those are picked by their own tangent."""


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """An effect added to a base, and where its search begins.

    Two scores: as it is, and beside the answer of the base, by which the effect has any strength. `point` is the
    problem there, where it was computed for its own tangent.
    """

    effect: Effect
    problem: Extended
    theta: FloatArray
    score: float
    at_any_strength: float
    point: Point | None = None

    def fitted(self, steps: int, enough: float) -> Fitted:
        """Return the minimum next to it (see `fit`)."""
        return fit(self.problem, self.theta, steps, enough, self.point)

    def by_its_own_tangent(self) -> Start:
        """Return the same with the score along its own tangent."""
        point = Point(self.problem, self.theta)
        return replace(self, score=point.along_the_tangent(), point=point)


@dataclass(frozen=True, slots=True, eq=False)
class Span:
    """Columns that are common to all starts, and what they leave of the PV.

    Attributes
    ----------
    basis : array of float, shape (N, Q)
        Orthonormal basis of the columns on the screening samples.
    left : array of float, shape (N,)
        What they leave of the PV.
    """

    basis: FloatArray
    left: FloatArray

    @classmethod
    def of(cls, columns: FloatArray, pv: FloatArray) -> Span:
        """Return the span of some columns, shape (N, L), and what they leave of the PV, shape (N,)."""
        basis, _ = solve_linear(columns, pv)
        return cls(basis, pv - basis @ (basis.T @ pv))

    def mean_squares(self, columns: FloatArray) -> FloatArray:
        """Return what is left beside the further columns of each start, PV squared.

        Parameters
        ----------
        columns : array of float, shape (starts, L, N)
            Columns of each; one that depends on the others does not count.

        Returns
        -------
        array of float, shape (starts,)
        """
        least = DEPENDENT * np.sqrt(np.einsum("kln,kln->kl", columns, columns))
        for _ in range(2):
            columns = columns - (columns @ self.basis) @ self.basis.T
        units: list[FloatArray] = []
        left = np.tile(self.left, (columns.shape[0], 1))
        for column, smallest in zip(columns.swapaxes(0, 1), least.T, strict=True):
            units.append(_unit_across(column, units, smallest))
            left -= np.einsum("kn,kn->k", left, units[-1])[:, None] * units[-1]
        result: FloatArray = np.einsum("kn,kn->k", left, left) / left.shape[1]
        return result


def _unit_across(column: FloatArray, units: Sequence[FloatArray], smallest: FloatArray) -> FloatArray:
    """Return a column of each start across its earlier ones, of unit length; 0 where it depends on them."""
    for _ in range(2):
        for unit in units:
            column = column - np.einsum("kn,kn->k", column, unit)[:, None] * unit
    length = np.sqrt(np.einsum("kn,kn->k", column, column))
    result: FloatArray = column / np.where(length > smallest, length, np.inf)[:, None]
    return result


@dataclass(frozen=True, slots=True, eq=False)
class Tangent:
    """A base with all directions in which it may move.

    Attributes
    ----------
    base : Fitted
        The base.
    as_it_is : Span
        All its columns and slopes: an effect that only adds columns leaves them as they are.
    moving : Span
        Its slopes, and what the PV does besides: of them, an effect that changes the input leaves the latter.
    at_any_strength : Span
        The same and its answer to the output. A mix of it and the answer of a changed process is a change of another
        strength.
    """

    base: Fitted
    as_it_is: Span
    moving: Span
    at_any_strength: Span


def tangent_of(context: FitContext, base: Fitted) -> Tangent:
    """Return a base with its tangent."""
    problem = replace(base.problem, rows=context.screen)
    columns, slopes = tangent(problem, base.theta)
    gains = problem.structure.gains
    beside = np.hstack((columns[:, gains + sum(base.counts) :], slopes))
    pv = context.dataset.data.pv[context.screen]
    spans = (np.hstack((columns, slopes)), beside, np.hstack((beside, columns[:, :gains])))
    return Tangent(base, *(Span.of(span, pv) for span in spans))


def screened(context: FitContext, tangents: Sequence[Tangent], effect: Effect) -> tuple[list[Start], Start | None]:
    """Return the best starts of an effect over all bases, the best first, and the best one at any strength."""
    starts = [start for tangent in tangents for start in _scored(context, tangent, effect)]
    ranked = without_rounding(starts, lambda s: s.score)
    if effect.only_adds or not ranked:
        return ranked[:KEPT], None
    again = [s.by_its_own_tangent() for s in ranked[:LOOKED_AT_AGAIN]]
    return without_rounding(again, lambda s: s.score)[:KEPT], without_rounding(starts, lambda s: s.at_any_strength)[0]


def _scored(context: FitContext, tangent: Tangent, effect: Effect) -> list[Start]:
    base = tangent.base
    if not fits_beside(effect, base.problem.effects) or not effect.starts:
        return []
    problem = replace(base.problem.with_effect(effect), rows=context.screen)
    thetas = [theta_with(base, problem, effect, values) for values in effect.starts]
    if effect.only_adds:
        scores = _scores_of_columns(tangent, effect, problem, thetas[0])
    else:
        scores = _scores_of_change(tangent, problem, thetas)
    return [
        Start(effect, problem, theta, float(as_it_is), float(at_any_strength))
        for theta, as_it_is, at_any_strength in zip(thetas, *scores, strict=True)
    ]


def _scores_of_change(
    tangent: Tangent, problem: Extended, thetas: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    columns = _stacked(problem.columns_at(thetas), problem.rows.size)
    return tangent.moving.mean_squares(columns), tangent.at_any_strength.mean_squares(columns)


def _scores_of_columns(
    tangent: Tangent, effect: Effect, problem: Extended, theta: FloatArray
) -> tuple[FloatArray, FloatArray]:
    assert effect.columns is not None  # noqa: S101 - what changes neither position nor response adds columns
    view = problem.view(theta, problem.rows)  # it does not depend on the numbers of the effect
    added = [list(effect.columns(view, values)) for values in effect.starts]
    left = tangent.as_it_is.mean_squares(_stacked(added, problem.rows.size))
    scores = np.where([len(columns) > 0 for columns in added], left, np.inf)
    return scores, scores  # their sizes are linear


def _stacked(columns: Sequence[Sequence[FloatArray]], samples: int) -> FloatArray:
    """Return the columns of each start in one array, with columns of 0 where there are fewer."""
    stacked = np.zeros((len(columns), max(map(len, columns)), samples))
    for row, of in zip(stacked, columns, strict=True):
        for k, column in enumerate(of):
            row[k] = column
    return stacked


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
