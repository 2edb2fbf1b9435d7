"""How well the parameters are known: covariance, standard errors, 95 % intervals, and what cannot be separated.

    C = s^2 (J' J)^-1,   s^2 = |e|^2/(N - p)        in (log shape, dead time, gains, background)

then carried over to the model's parameters by their slopes. `J` holds the slopes of the simulated PV with ALL of them,
so that what is unknown about offset and initial state is in the errors. (Seber and Wild, Nonlinear Regression, 2003,
ch. 5.) A positive parameter p with relative error r has the interval `p e^{-q r} .. p e^{q r}`, `q` Student's 97.5 %
quantile: it never reaches zero, and for small r it is the usual one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import t as student

from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.core.arrays import FloatArray
    from autotuner.core.identification.search import Solution
    from autotuner.core.process import ProcessModel

STEP = 1e-6
"""Relative step of the slopes of the model's parameters."""


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """Errors of a model's parameters.

    Attributes
    ----------
    covariance : array of float, shape (P, P)
        In the order of ``model.parameters()``.
    standard_error : dict of str to float
        Its square roots, in the units of the parameters.
    interval95 : dict of str to (float, float)
        95 % intervals.
    """

    covariance: FloatArray
    standard_error: dict[str, float]
    interval95: dict[str, tuple[float, float]]


def covariance_of_fit(solution: Solution, inflation: float = 1.0) -> FloatArray:
    """Return the covariance of `theta`, then the linear parameters that were solved for.

    Parameters
    ----------
    solution : Solution
        Where the search ended.
    inflation : float
        Factor on the variance: how many correlated residuals are worth one independent one.
    """
    J = full_jacobian(solution)
    return scaled_inverse(J) * (solution.misfit / _freedom(solution) * inflation)


def full_jacobian(solution: Solution) -> FloatArray:
    """Return the weighted slopes of the simulated PV with `theta` and with the linear parameters solved for."""
    problem, theta = solution.problem, solution.theta
    known = 0 if problem.known_gain is None else 1
    columns = problem.layout(theta).columns[:, known:] * problem.data.weight[:, None]
    return np.hstack((problem.sensitivities(theta), columns))


def uncertainty(solution: Solution, model: ProcessModel, inflation: float = 1.0) -> Uncertainty:
    """Return the errors of the parameters of a solution's model; `inflation` as above."""
    problem, theta = solution.problem, solution.theta
    known = 0 if problem.known_gain is None else 1
    gains = problem.linear(theta)[known : problem.structure.gains]
    slopes = _slopes(solution, np.concatenate((theta, gains)), model)
    kept = theta.size + gains.size
    covariance = slopes @ covariance_of_fit(solution, inflation)[:kept, :kept] @ slopes.T
    errors = np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist()
    quantile = float(student.ppf(0.975, _freedom(solution)))
    values = model.parameters()
    return Uncertainty(
        covariance,
        dict(zip(values, errors, strict=True)),
        {
            name: interval(name, value, error, quantile)
            for (name, value), error in zip(values.items(), errors, strict=True)
        },
    )


def _freedom(solution: Solution) -> int:
    problem = solution.problem
    fitted = solution.theta.size + problem.linear(solution.theta).size - (problem.known_gain is not None)
    return max(int(np.count_nonzero(problem.data.weight)) - int(fitted), 1)


def interval(name: str, value: float, error: float, quantile: float) -> tuple[float, float]:
    """Return the 95 % interval of one parameter; a dead time may be zero, everything else keeps its sign."""
    if name == "D" or value == 0.0:
        return max(value - quantile * error, 0.0), value + quantile * error
    factor = math.exp(min(quantile * error / abs(value), 700.0))
    low, high = sorted((value / factor, value * factor))
    return low, high


def scaled_inverse(J: FloatArray) -> FloatArray:
    """Return `(J' J)^-1`, scaled column by column; what the data say nothing about gets a huge variance."""
    size = np.sqrt(np.einsum("ij,ij->j", J, J))
    size[size == 0.0] = 1e-300
    _, s, vt = np.linalg.svd(J / size, full_matrices=False)
    s = np.maximum(s, 1e-14)
    scaled = vt.T / s / size[:, None]
    result: FloatArray = scaled @ scaled.T
    return result


def _slopes(solution: Solution, x: FloatArray, model: ProcessModel) -> FloatArray:
    """Return the slopes of the model's parameters with `theta` and the free gains."""
    model_at = model_maker(solution)
    base = np.array(list(model.parameters().values()))
    slopes = np.zeros((base.size, x.size))
    for k in range(x.size):
        for step in (STEP, -STEP):
            shifted = x.copy()
            shifted[k] += step * max(abs(x[k]), STEP)
            other = model_at(shifted)
            if other is not None and other.structure == model.structure:
                slopes[:, k] = (np.array(list(other.parameters().values())) - base) / (shifted[k] - x[k])
                break
    return slopes


def model_maker(solution: Solution) -> Callable[[FloatArray], ProcessModel | None]:
    """Return a function from `theta` and the free gains to a model, or None where there is none."""
    problem = solution.problem
    known = [] if problem.known_gain is None else [problem.known_gain]

    def model_at(x: FloatArray) -> ProcessModel | None:
        shape, delay = problem.split(x[: solution.theta.size])
        try:
            return problem.structure.model(shape, [*known, *x[solution.theta.size :].tolist()], delay)
        except InputError:
            return None

    return model_at
