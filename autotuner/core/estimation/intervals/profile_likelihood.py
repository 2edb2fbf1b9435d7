"""Profile likelihood: 95 % intervals where the sum of squares is not a paraboloid.

    r(p)^2 = (S(p) - S) / (s^2 c),   S(p) = least sum of squares with the parameter held at p

`S` the minimum, `s^2` the noise, `c` the inflation by correlated residuals. The interval of p is where `r <= q`, `q`
Student's quantile; for a paraboloid that is the interval of the covariance, at whose ends `r = q`. So `r` is first
bounded there, everything else moved along by the covariance, which costs one evaluation an end. Only where it is
far from `q` is the parameter held, the rest fitted again, and the end searched for by secants: `r` is nearly straight
in the logarithm of a positive parameter and in a dead time. (Bates and Watts, Nonlinear Regression Analysis, 1988, ch.
6; Venzon and Moolgavkar, Appl. Statist. 37, 1988.)

A dead time, `T`, `n` and `m = n (m/n)` are linear in `theta`, so that holding one leaves a subspace to search; a static
gain is held by solving for the other linear parameters only. Two real lags have the intervals of `near_double`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy

from autotuner.core.model.arrays import SMALLEST_DIVISOR

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.estimation.optimiser import Solution
    from autotuner.core.estimation.variable_projection import Projection
    from autotuner.core.model.arrays import FloatArray

ROUND = 1.2
"""Factor between `r` and `q` from which the paraboloid is rejected."""
CLOSE = 0.02
"""Relative distance of `r` from `q` at which an end is found."""
SECANTS, STEPS = 8, 12
FURTHEST = math.log(1e3)
"""Distance from the estimate, as a logarithm, at which an interval that is open on a side ends."""
FARTHER = 3.0
"""Largest growth of the distance from one secant to the next."""
SURE = 0.02
"""Relative half width under which every sum of squares is a paraboloid, and arithmetic would be all that is seen."""
IN_SHAPE = {"T": (1.0,), "n": (1.0, 0.0), "m": (1.0, 1.0)}
"""Logarithms of parameters as sums of the logarithms of the shape."""


@dataclass(frozen=True, slots=True, eq=False)
class Valley:
    """The sum of squares about a fit, along one parameter.

    Attributes
    ----------
    problem : Projection
        What was fitted.
    bottom : array of float
        `theta` of the fit.
    least : float
        The sum of squares there.
    variance : float
        Of an independent residual: `s^2 c`.
    row : array of float, or None
        The coordinate is `row @ theta`: a logarithm, or a dead time in units; None for the logarithm of the gain.
    along : array of float
        How `theta` moves with the coordinate, by the covariance.
    """

    problem: Projection
    bottom: FloatArray
    least: float
    variance: float
    row: FloatArray | None
    along: FloatArray

    def bound(self, distance: float) -> float:
        """Return `r` at a distance from the estimate without fitting the rest again: no less than it is."""
        problem = self._held(distance)
        with np.errstate(all="ignore"):
            residual = problem.residual(self.bottom + self.along * distance)
        return self._root(float(residual @ residual))

    def refitted(self, distance: float, theta: FloatArray) -> tuple[float, FloatArray]:
        """Return `r` at a distance, and `theta` there, which the search begins from a `theta` near it."""
        problem = self._held(distance)
        free = np.eye(theta.size) if self.row is None else scipy.linalg.null_space(self.row[None, :])

        def left(x: FloatArray) -> FloatArray:
            return problem.residual(theta + free @ x)

        def slope(x: FloatArray) -> FloatArray:
            result: FloatArray = problem.jacobian(theta + free @ x) @ free
            return result

        with np.errstate(all="ignore"):
            begin = left(np.zeros(free.shape[1]))
            if not free.shape[1] or not np.all(np.isfinite(begin)):
                return self._root(float(begin @ begin)), theta
            found = scipy.optimize.least_squares(
                left, np.zeros(free.shape[1]), slope, method="lm", max_nfev=STEPS, ftol=1e-6, xtol=1e-6
            )
        return self._root(2.0 * float(found.cost)), theta + free @ found.x

    def end(self, first: float, quantile: float, furthest: float) -> float:
        """Return how far the interval reaches to the side of `first`; `furthest` where that side is open."""
        distance, theta, side = abs(first), self.bottom + self.along * first, math.copysign(1.0, first)
        for _ in range(SECANTS):
            distance = min(distance, furthest)
            r, theta = self.refitted(side * distance, theta)
            if abs(r / quantile - 1.0) < CLOSE:
                break
            if r < quantile and distance >= furthest:
                break
            previous, distance = distance, distance * min(max(quantile / max(r, 1e-9), 1.0 / FARTHER), FARTHER)
            theta = theta + self.along * side * (min(distance, furthest) - previous)
        return min(distance, furthest)

    def _held(self, distance: float) -> Projection:
        if self.row is not None:
            return self.problem
        gain = float(self.problem.linear(self.bottom)[0])
        return replace(self.problem, known_gain=gain * math.exp(distance), _theta=None)

    def _root(self, squares: float) -> float:
        return math.sqrt(max(squares - self.least, 0.0) / self.variance) if math.isfinite(squares) else math.inf


def profiles(
    solution: Solution,
    values: Mapping[str, float],
    quadratic: Mapping[str, tuple[float, float]],
    covariance: FloatArray,
    scale: tuple[float, float],
) -> dict[str, tuple[float, float]]:
    """Return the intervals of the parameters for which the quadratic one lies.

    Parameters
    ----------
    solution : Solution
        The fit.
    values, quadratic : mapping of str
        The model's parameters, and the intervals of their covariance.
    covariance : array of float
        Of `theta`, then of the linear parameters solved for.
    scale : (float, float)
        Variance of an independent residual, PV squared, and Student's quantile.
    """
    found = {}
    for name, value in values.items():
        low, high = quadratic[name]
        if name == "D" and value == 0.0 and solution.problem.fixed_delay_s is not None:
            found[name] = (0.0, _past_zero(solution, scale))
            continue
        if high - low < 2.0 * SURE * max(abs(value), solution.problem.delay_unit_s if name == "D" else 0.0):
            continue
        valley = valley_of(solution, name, covariance, scale[0])
        if valley is not None and (interval := profiled(valley, name, value, (low, high), scale[1])) != (low, high):
            found[name] = interval
    return found


def valley_of(solution: Solution, name: str, covariance: FloatArray, variance: float) -> Valley | None:
    """Return the valley along a parameter, or None for one that was not searched for or that is not straight here.

    Parameters
    ----------
    solution : Solution
        The fit.
    name : str
        The model's parameter.
    covariance : array of float
        Of `theta`, then of the linear parameters solved for.
    variance : float
        Of an independent residual.
    """
    problem, theta = solution.problem, solution.theta
    size = len(problem.structure.shape)
    row = None
    if name == "K":
        if problem.known_gain is not None:
            return None
        gain = float(problem.linear(theta)[0])
        along = covariance[: theta.size, theta.size] * gain / covariance[theta.size, theta.size]
    else:
        row = np.zeros(theta.size)
        if name == "D" and problem.fixed_delay_s is None:
            row[size] = problem.delay_unit_s
        elif name in IN_SHAPE and len(IN_SHAPE[name]) == size:
            row[:size] = IN_SHAPE[name]
        else:
            return None
        spread = covariance[: theta.size, : theta.size] @ row
        along = spread / float(row @ spread)
    return Valley(problem, theta, solution.misfit, variance, row, along)


def _past_zero(solution: Solution, scale: tuple[float, float]) -> float:
    """Return the upper end of the interval of a dead time that the search left at zero, s."""
    problem = replace(solution.problem, fixed_delay_s=None, _theta=None)
    size, unit = len(problem.structure.shape), problem.delay_unit_s
    row = np.zeros(solution.theta.size + 1)
    row[size] = unit
    bottom = np.insert(solution.theta, size, 0.0)
    valley = Valley(problem, bottom, solution.misfit, scale[0], row, row / unit**2)
    return valley.end(problem.data.interval_s, scale[1], problem.data.span_s)


def profiled(
    valley: Valley, name: str, value: float, quadratic: tuple[float, float], quantile: float
) -> tuple[float, float]:
    """Return the 95 % interval of a parameter: the quadratic one, or where that lies the profile's.

    Parameters
    ----------
    valley : Valley
        The sum of squares along it.
    name : str
        The parameter.
    value : float
        Its estimate.
    quadratic : (float, float)
        The interval of the covariance.
    quantile : float
        Student's.
    """
    down, up = _distances(name, value, quadratic)
    # A dead time whose interval includes zero has no lower end to compare.
    ends = [up] if name == "D" and quadratic[0] == 0.0 else [down, up]
    if all(1.0 / ROUND < valley.bound(d) / quantile < ROUND for d in ends):
        return quadratic
    if name == "D":
        low = value - valley.end(down, quantile, value) if value > 0.0 else 0.0
        return max(low, 0.0), value + valley.end(up, quantile, valley.problem.data.span_s)
    factors = [math.exp(sign * valley.end(d, quantile, FURTHEST)) for sign, d in ((-1.0, down), (1.0, up))]
    low, high = sorted(value * factor for factor in factors)
    return low, high


def _distances(name: str, value: float, quadratic: tuple[float, float]) -> tuple[float, float]:
    """Return how far below and above the estimate the quadratic interval ends: in a logarithm, a dead time in s."""
    if name == "D":
        return quadratic[0] - value, quadratic[1] - value
    # An end of the other sign is further away than any factor.
    shares = (max(bound / value, SMALLEST_DIVISOR) for bound in quadratic)
    down, up = sorted(max(-FURTHEST, min(FURTHEST, math.log(share))) for share in shares)
    return down, up
