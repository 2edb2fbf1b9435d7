"""Variable projection (separable least squares): linear parameters are solved for, shape and dead time are searched.

    minimise over theta   |P(theta) (pv - known)|^2,   P = I - Q Q',   Q R = columns(theta)
    d/dtheta              -P (d columns/dtheta) c                        (Kaufman's form)

`theta` holds the logarithms of the shape and the dead time in units of `delay_unit_s`, then the dead times of measured
disturbances, which go through the process's own lags; `c` gains, offset, initial state, gains of the disturbances.
(Golub and Pereyra, Inverse Problems 19, 2003; Kaufman, BIT 15, 1975.) The slope with the dead time is exact: it
is minus the slope of the response, which comes with it. The slopes with the shape are forward differences.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.estimation.backgrounds import background_columns, disturbance_columns
from autotuner.core.estimation.linear_least_squares import solve_linear

if TYPE_CHECKING:
    from autotuner.core.estimation.backgrounds import Background
    from autotuner.core.estimation.data import Data
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.structures import Structure

UNSEEN = 1e-100
"""Slope, PV, that counts as zero: the tail of a response that ends within a sample. Nothing measured moves as little,
and MINPACK would follow such a slope over any distance, with a covariance that overflows."""
FARTHEST = 100.0
"""Largest logarithm of a shape, of s: a search that runs away stops at 1e43 s, of which seven factors are a number."""
DIFFERENCE = 1e-6
"""Step of the forward differences in the logarithms."""


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """Columns at one `theta`: those solved for first the gains, then the background, then measured disturbances.

    Attributes
    ----------
    columns : array of float, shape (N, L)
        What is multiplied by the linear parameters.
    slopes : array of float, shape (N, L)
        Their slopes with time as far as they move with a dead time, 1/s.
    """

    columns: FloatArray
    slopes: FloatArray


@dataclass(slots=True, eq=False)
class Projection:
    """The problem of one structure on one recording; caches the last `theta` that it was evaluated at.

    Parameters
    ----------
    data : Data
        The samples.
    structure : Structure
        What is fitted.
    background : tuple of str
        Names of its columns.
    delay_unit_s : float
        Unit in which `theta` holds the dead time, s.
    known_gain : float, optional
        The first gain, when known.
    fixed_delay_s : float, optional
        The dead time when it is not searched.
    memory_slopes : array of float, shape (N, p), optional
        Slopes of the residual with the coefficients of its noise, where these are unsure too; without, they are given.
    """

    data: Data
    structure: Structure
    background: Background
    delay_unit_s: float
    known_gain: float | None = None
    fixed_delay_s: float | None = None
    memory_slopes: FloatArray | None = None
    _theta: FloatArray | None = None
    _q: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    _residual: FloatArray = field(default_factory=lambda: np.zeros(0))
    _linear: FloatArray = field(default_factory=lambda: np.zeros(0))
    _layout: Layout | None = None

    def split(self, theta: FloatArray) -> tuple[list[float], float]:
        """Return shape and dead time, s."""
        size = len(self.structure.shape)
        shape = [math.exp(min(max(value, -FARTHEST), FARTHEST)) for value in theta[:size].tolist()]
        if self.fixed_delay_s is not None:
            return shape, self.fixed_delay_s
        return shape, float(theta[size]) * self.delay_unit_s

    def other_delays(self, theta: FloatArray) -> FloatArray:
        """Return the dead times of the measured disturbances, s."""
        count = len(self.data.others)
        result: FloatArray = np.abs(theta[theta.size - count :]) * self.delay_unit_s
        return result

    def layout(self, theta: FloatArray) -> Layout:
        """Return the columns."""
        pairs = self._pairs(theta)
        return Layout(np.column_stack([p[0] for p in pairs]), np.column_stack([p[1] for p in pairs]))

    def _pairs(self, theta: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        """Return each column with its slope."""
        shape, D = self.split(theta)
        motion = self.structure.motion(shape, self.data.span_s)
        when = self.data.t - D
        forced = motion.forced(self.data.held, when)
        others = disturbance_columns(self.data, motion, self.other_delays(theta)) if self.data.others else ()
        return [*zip(*forced, strict=True), *background_columns(self.data, motion, self.background, when), *others]

    def residual(self, theta: FloatArray) -> FloatArray:
        """Return the weighted residual after the linear part is solved."""
        self._solve(theta)
        return self._residual

    def left(self, theta: FloatArray) -> FloatArray:
        """Return measured minus simulated PV at every sample, neither weighted nor whitened."""
        simulated: FloatArray = self.layout(theta).columns @ self.linear(theta)
        return self.data.pv - simulated

    def linear(self, theta: FloatArray) -> FloatArray:
        """Return the linear parameters: gains, then background."""
        self._solve(theta)
        return self._linear

    def jacobian(self, theta: FloatArray) -> FloatArray:
        """Return the slope of the residual, Kaufman's form; 0 for one that no PV shows."""
        sensitivities = self.sensitivities(theta)
        result: FloatArray = self._q @ (self._q.T @ sensitivities) - sensitivities
        result[np.abs(result) < UNSEEN] = 0.0
        return result

    def sensitivities(self, theta: FloatArray) -> FloatArray:
        """Return the weighted slope of the simulated PV with each of `theta` at fixed linear parameters."""
        self._solve(theta)
        assert self._layout is not None  # noqa: S101 - solved just before
        simulated = self._layout.columns @ self._linear
        moved = []
        for k in range(len(self.structure.shape)):
            shifted = theta.copy()
            shifted[k] += DIFFERENCE
            columns = np.column_stack([column for column, _ in self._pairs(shifted)])
            moved.append((columns @ self._linear - simulated) / DIFFERENCE)
        late, own = -self.delay_unit_s * self._layout.slopes * self._linear, self._linear.size - len(self.data.others)
        if self.fixed_delay_s is None:
            moved.append(late[:, :own].sum(axis=1))
        moved += list((late[:, own:] * np.where(theta[theta.size - len(self.data.others) :] < 0.0, -1.0, 1.0)).T)
        return self.data.balanced(np.column_stack(moved)) if moved else np.zeros((self.data.t.size, 0))

    def _solve(self, theta: FloatArray) -> None:
        if self._theta is not None and np.array_equal(theta, self._theta):
            return
        self.data.require_time()
        self._theta = theta.copy()
        self._layout = self.layout(theta)
        columns, target = self._layout.columns, self.data.pv
        known = 0 if self.known_gain is None else 1
        if self.known_gain is not None:
            target = target - self.known_gain * columns[:, 0]
        target = self.data.balanced(target)
        balanced = self.data.balanced(columns[:, known:])
        unsure = balanced if self.memory_slopes is None else np.hstack((balanced, self.memory_slopes))
        self._q, solved = solve_linear(unsure, target)
        solved = solved[: balanced.shape[1]]
        self._residual = target - self._q @ (self._q.T @ target)
        self._linear = solved if self.known_gain is None else np.concatenate(([self.known_gain], solved))
