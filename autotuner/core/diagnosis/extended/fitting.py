"""The fit of an extended model, by separable least squares.

    minimise over theta   |P(theta) pv|^2,   P = I - Q Q',   Q R = columns(theta)
    d/dtheta             -P (d columns/dtheta) c                              (Kaufman's form, BIT 15, 1975)

The search is Levenberg-Marquardt within bounds: a step is clipped, and only one that lowers the misfit is taken.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.extended_model import Fitted
from autotuner.core.estimation.linear_least_squares import solve_linear
from autotuner.core.model.arrays import SMALLEST_DIVISOR

if TYPE_CHECKING:
    from autotuner.core.diagnosis.extended.effect import Searched
    from autotuner.core.diagnosis.extended.extended_model import Extended
    from autotuner.core.model.arrays import FloatArray

DAMPING_START, DAMPING_UP, DAMPING_DOWN = 1e-3, 10.0, 0.2
ENOUGH, ENOUGH_FOR_RANKS = 1e-6, 1e-4
"""Relative fall of the misfit at which the search ends; and where it is only compared with others."""
MOST_TRIES = 6
"""Halvings of a step that increases the misfit before the search ends: 1/64 of a step is negligible."""


class Point:
    """The problem at one `theta`: residual, and slopes on demand."""

    def __init__(self, problem: Extended, theta: FloatArray) -> None:
        self.problem, self.theta = problem, theta
        self.view = problem.view(theta, problem.computed)
        self.simulated, self.counts = problem.columns_of(self.view, theta)
        self.columns = problem.whitened(self.simulated)
        target = problem.target
        self.q, self.linear = solve_linear(self.columns, target)
        self.residual = target - self.q @ (self.q.T @ target)
        self.misfit = float(self.residual @ self.residual)
        if not math.isfinite(self.misfit):
            self.misfit = math.inf
        self._moved: dict[int, FloatArray] = {}

    def slopes(self, count: int | None = None) -> FloatArray:
        """Return the slope of the simulated PV with each searched number (or the first few), the linear ones held."""
        simulated = self.simulated @ self.linear
        searched_for = self.problem.searched[:count]
        moved = np.zeros((simulated.size, len(searched_for)))
        known = self._known(moved)
        for k, searched in enumerate(searched_for):
            if k not in known and searched.step != 0.0:
                moved[:, k] = self._slope(k, searched, simulated)
        return self.problem.whitened(moved)

    def _slope(self, k: int, searched: Searched, simulated: FloatArray) -> FloatArray:
        """Return the slope with one number, by a difference; computed once."""
        if k not in self._moved:
            step = searched.step if self.theta[k] + searched.step <= searched.high else -searched.step
            shifted = self.theta.copy()
            shifted[k] += step
            self._moved[k] = (self._columns_at(shifted, k) @ self.linear - simulated) / step
        return self._moved[k]

    def _columns_at(self, theta: FloatArray, k: int) -> FloatArray:
        """Return the columns at a `theta` with another number `k`: only those that may depend on it are new."""
        problem, ahead, column = self.problem, len(self.problem.structure.shape) + 1, self.problem.structure.gains
        background = self.simulated[:, column + sum(self.counts) :] if k >= ahead else None
        for effect, count in zip(problem.effects, self.counts, strict=True):
            first, ahead = ahead, ahead + len(effect.searched)
            if first <= k < ahead and count and effect.columns is not None and effect.only_adds:
                columns = self.simulated.copy()
                columns[:, column : column + count] = np.transpose(
                    effect.columns(self.view, theta[first:ahead].tolist())
                )
                return columns
            column += count
        return problem.columns_of(problem.view(theta, problem.computed), theta, background)[0]

    def _known(self, moved: FloatArray) -> set[int]:
        """Write the slopes that effects know at once; return which they are."""
        problem, at = self.problem, len(self.problem.structure.shape) + 1
        known: set[int] = set()
        _, _, values = problem.split(self.theta)
        for effect, p in zip(problem.effects, values, strict=True):
            ahead = at + len(p)
            if effect.slopes is not None and ahead <= moved.shape[1]:
                moved[:, at:ahead] = float(self.linear[0]) * effect.slopes(self.view, p)
                known |= set(range(at, ahead))
            at = ahead
        return known

    def along_the_tangent(self) -> float:
        """Return the remaining mean square when the process may move along its tangent."""
        if self.problem.fixed is not None:
            return self.misfit / self.residual.size
        J = self.slopes(len(self.problem.structure.shape) + 1)
        J = J - self.q @ (self.q.T @ J)
        q, _ = solve_linear(J, self.residual)
        left = self.residual - q @ (q.T @ self.residual)
        return float(left @ left) / left.size

    def jacobian(self) -> FloatArray:
        """Return the slopes of the residual, the linear numbers solved for."""
        moved = self.slopes()
        result: FloatArray = self.q @ (self.q.T @ moved) - moved
        return result


def tangent(problem: Extended, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the columns at the fitted samples, and the slopes of the simulated PV with all that is searched."""
    point = Point(problem, theta)
    slopes = point.slopes()
    return point.columns, slopes if problem.fixed is None else slopes[:, len(problem.fixed) :]


def fit(
    problem: Extended, start: FloatArray, steps: int = 25, enough: float = ENOUGH, known: Point | None = None
) -> Fitted:
    """Return the minimum next to a start.

    Parameters
    ----------
    problem : Extended
        What is fitted.
    start : array of float
        Value of `theta`.
    steps : int
        Most steps.
    enough : float
        Relative fall of the misfit at which the search ends.
    known : Point, optional
        The problem at the start, where it was computed before.
    """
    low = np.array([s.low for s in problem.searched])
    high = np.array([s.high for s in problem.searched])
    start = np.clip(start, low, high)
    point = known if known is not None and np.array_equal(known.theta, start) else Point(problem, start)
    damping = DAMPING_START
    for _ in range(steps):
        J = point.jacobian()
        better, damping = _step(point, J, damping, low, high)
        if better is None:
            break
        fall = point.misfit - better.misfit
        point = better
        if fall <= enough * point.misfit:
            break
    return Fitted(problem, point.theta, point.linear, point.counts, point.residual)


def _step(point: Point, J: FloatArray, damping: float, low: FloatArray, high: FloatArray) -> tuple[Point | None, float]:
    """Return a better point, None without any, and the damping for the next step."""
    gradient, normal = J.T @ point.residual, J.T @ J
    scale = np.maximum(np.diag(normal), 1e-12 * max(float(np.trace(normal)), SMALLEST_DIVISOR))
    blocked = ((point.theta <= low) & (gradient > 0.0)) | ((point.theta >= high) & (gradient < 0.0))
    free = np.flatnonzero(~blocked)
    if not free.size:
        return None, damping
    for _ in range(MOST_TRIES):
        matrix = normal[np.ix_(free, free)] + damping * np.diag(scale[free])
        move = np.zeros(point.theta.size)
        move[free] = -np.linalg.lstsq(matrix, gradient[free], rcond=None)[0]
        tried = Point(point.problem, np.clip(point.theta + np.clip(move, -3.0, 3.0), low, high))
        if tried.misfit < point.misfit:
            return tried, max(damping * DAMPING_DOWN, 1e-9)
        damping *= DAMPING_UP
    return None, damping


def linearised(problem: Extended, theta: FloatArray) -> float:
    """Return the remaining mean square when the process may move along its tangent: a cheap score of a start."""
    return Point(problem, theta).along_the_tangent()
