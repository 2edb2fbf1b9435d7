"""Uncertainty of the parameters: covariance, standard errors, 95 % intervals, and parameters that are not separable.

    C = s^2 (J' J)^-1,   s^2 = |e|^2/(N - p)        in (log shape, dead time, gains, background)

(no less than the noise with the timing jitter of the output: see `timing_jitter_model`),

then propagated to the model's parameters by their derivatives. `J` has the derivatives of the simulated PV to ALL
parameters, so the errors include those of offset and initial state, and beside autoregressive noise those of its
coefficients: in closed loop, where the output answers to the noise, they are not orthogonal to the process. (Seber and
Wild, Nonlinear Regression, 2003, ch. 5; Ljung, System Identification, 1999, ch. 9.3.) A positive parameter p with
relative error r has the interval `p e^{-q r} .. p e^{q r}`, `q` Student's 97.5 % quantile: it never reaches zero, and
for small r it is the usual one. Where the sum of squares is not a paraboloid within the interval, the profile
likelihood replaces it (`profile_likelihood`).

Two time constants that a recording can hardly distinguish.

    T1, T2 are the roots of  g(T) = T^2 - n T + m,   n = T1 + T2,   m = T1 T2

`n` and `m` are well behaved; their roots are not, where they meet. The 95 % set of a root is all `T` at which
`g(T) = 0` is not refuted (Fieller, J. R. Stat. Soc. B 16, 1954),

    g(T)^2 <= q^2 var g(T),   var g(T) = T^2 var n - 2 T cov(n, m) + var m

two separate intervals for roots well apart, one common interval for roots that cannot be distinguished. `T`, `n` s,
`m` s^2; `q` the quantile of the interval.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.estimation.intervals.profile_likelihood import profiles
from autotuner.core.estimation.optimiser import Solution
from autotuner.core.model.arrays import FloatArray
from autotuner.core.model.process import InverseResponse, SopdtOverdamped, ThirdOrder, ThirdOrderUnderdamped
from autotuner.core.model.structures import EQUAL_LAGS
from autotuner.core.quantiles import student_quantile
from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.process import ProcessModel

SMALLEST = 1e-30
"""Length of a column, as a share of the longest, that counts as zero."""
STEP = 1e-6
"""Relative step of the slopes of the model's parameters."""
FEWEST_FREE = 2.0
"""Degrees of freedom below which the uncertainty of the noise itself is not estimated."""


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """Errors of a model's parameters.

    Attributes
    ----------
    covariance : array of float, shape (P, P), or None
        In the order of ``model.parameters()``; None where the errors are not those of a quadratic.
    standard_error : dict of str to float
        Its square roots, in the units of the parameters.
    interval95 : dict of str to (float, float)
        95 % intervals.
    profiled : tuple of str
        Parameters whose interval is that of the profile likelihood, because the one of the covariance is wrong.
    pair_covariance : array of float, shape (4, 4) or (5, 5), or None
        Where two lags cannot be distinguished: that of `(K, m, n, D)`, product `m` and sum `n` of the lags, or of
        `(K, m, n, Z, D)` with an inverse response; of third order always, that of `(K, a1, a2, a3, D)`.
    """

    covariance: FloatArray | None
    standard_error: dict[str, float]
    interval95: dict[str, tuple[float, float]]
    profiled: tuple[str, ...] = ()
    pair_covariance: FloatArray | None = None


def covariance_of_fit(solution: Solution, inflation: float = 1.0) -> FloatArray:
    """Return the covariance of `theta`, then the linear parameters that were solved for.

    Parameters
    ----------
    solution : Solution
        Where the search ended.
    inflation : float
        Factor on the variance: number of correlated residuals per independent one.
    """
    return scaled_inverse(full_jacobian(solution)) * (_variance(solution) * inflation)


def _variance(solution: Solution) -> float:
    shaken = solution.problem.data.shaken
    return max(solution.misfit / _freedom(solution), 0.0 if shaken is None else shaken.sigma**2)


def full_jacobian(solution: Solution) -> FloatArray:
    """Return the weighted slopes of the simulated PV with `theta` and with the linear parameters solved for."""
    problem, theta = solution.problem, solution.theta
    known = 0 if problem.known_gain is None else 1
    columns = problem.data.balanced(problem.layout(theta).columns[:, known:])
    memory = () if problem.memory_slopes is None else (problem.memory_slopes,)
    return np.hstack((problem.sensitivities(theta), columns, *memory))


def _with_unsure_memory(solution: Solution) -> Solution:
    """Return a solution whose noise's memory is estimated with the rest, as it was."""
    problem, theta = solution.problem, solution.theta
    coloured = problem.data.coloured
    if coloured is None:
        return solution
    past = coloured.past(problem.left(theta) * problem.data.weight) * problem.data.weight[:, None]
    unsure = replace(problem, memory_slopes=past, _theta=None)
    residual = unsure.residual(theta)
    return Solution(unsure, theta, float(residual @ residual))


def uncertainty(
    solution: Solution, model: ProcessModel, inflation: float = 1.0, *, profile: bool = True
) -> Uncertainty:
    """Return the errors of the parameters of a solution's model; `inflation` as above.

    Without `profile` the intervals are those of the covariance throughout, which is quicker.
    """
    if solution.problem.structure in EQUAL_LAGS:
        solution = _as_pair(solution)
    problem, theta = solution.problem, solution.theta
    known = 0 if problem.known_gain is None else 1
    gains = problem.linear(theta)[known : problem.structure.gains]
    solution = _with_unsure_memory(solution)  # after the gains: these are the model's, whose memory was given
    x = np.concatenate((theta, gains))
    base = np.array(list(model.parameters().values()))
    slopes = _slopes(lambda other: _parameters_at(solution, other, model), x, base)
    kept = theta.size + gains.size
    whole = covariance_of_fit(solution, inflation)
    of_fit = whole[:kept, :kept]
    covariance = slopes @ of_fit @ slopes.T
    values = model.parameters()
    errors = dict(zip(values, np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist(), strict=True))
    quantile = student_quantile(_independent_freedom(solution, inflation))
    intervals = {name: interval(name, value, errors[name], quantile) for name, value in values.items()}
    scale = (_variance(solution) * inflation, quantile)
    changed = profiles(solution, values, intervals, whole, scale) if profile else {}
    intervals |= changed
    if isinstance(model, ThirdOrder | ThirdOrderUnderdamped):
        return _of_third_order(solution, model, (x, of_fit, quantile), errors, intervals, tuple(changed))
    if not isinstance(model, SopdtOverdamped | InverseResponse) or model.T2 == 0.0:
        return Uncertainty(covariance, errors, intervals, tuple(changed))
    sum_and_product = np.diag((model.T1 + model.T2, model.T1 * model.T2)) @ np.array([[1.0, 0.0], [1.0, 1.0]])
    lags = lag_intervals(
        model.T1 + model.T2,
        model.T1 * model.T2,
        sum_and_product @ of_fit[:2, :2] @ sum_and_product.T,
        quantile,
    )
    intervals |= {"T1": lags.T1, "T2": lags.T2}
    if not lags.merged:
        return Uncertainty(covariance, errors, intervals, tuple(changed))
    errors |= {name: (high - low) / (2.0 * quantile) for name, (low, high) in (("T1", lags.T1), ("T2", lags.T2))}
    return Uncertainty(None, errors, intervals, tuple(changed), _of_pair(solution, x, of_fit))


def _of_third_order(
    solution: Solution,
    model: ThirdOrder | ThirdOrderUnderdamped,
    fit: tuple[FloatArray, FloatArray, float],
    errors: dict[str, float],
    intervals: dict[str, tuple[float, float]],
    profiled: tuple[str, ...],
) -> Uncertainty:
    """Return the errors with the covariance of the coefficients; no lag is longer than all of them together.

    Three lags are roots: where two are nearly equal their own errors are not quadratic, those of the coefficients are.
    """
    x, of_fit, quantile = fit
    of_coefficients = _of_pair(solution, x, of_fit)
    of_sum = 0.0 if of_coefficients is None else math.sqrt(max(float(of_coefficients[1, 1]), 0.0))
    longest = model.rational().a[1] + quantile * of_sum
    lags = [name for name in model.parameters() if name.startswith("T")]
    errors |= {name: min(errors[name], longest) for name in lags}
    intervals |= {name: (intervals[name][0], min(intervals[name][1], longest)) for name in lags}
    return Uncertainty(None, errors, intervals, profiled, of_coefficients)


def _of_pair(solution: Solution, x: FloatArray, of_fit: FloatArray) -> FloatArray | None:
    """Return the covariance of the merged lags; None where the solution is not a pair."""
    base = _pair_at(solution, x)
    if base is None:
        return None
    slopes = _slopes(lambda other: _pair_at(solution, other), x, base)
    covariance: FloatArray = slopes @ of_fit @ slopes.T
    return covariance


def _as_pair(solution: Solution) -> Solution:
    """Return a double lag as the pair of equal lags that it is, so that both are uncertain."""
    problem = replace(solution.problem, structure=EQUAL_LAGS[solution.problem.structure])
    theta = np.concatenate(([solution.theta[0] + math.log(2.0), solution.theta[0] - math.log(2.0)], solution.theta[1:]))
    return Solution(problem, theta, solution.misfit)


def _freedom(solution: Solution) -> int:
    problem = solution.problem
    fitted = solution.theta.size + problem.linear(solution.theta).size - (problem.known_gain is not None)
    fitted += 0 if problem.memory_slopes is None else problem.memory_slopes.shape[1]
    return max(int(np.count_nonzero(problem.data.weight)) - int(fitted), 1)


def _independent_freedom(solution: Solution, inflation: float) -> float:
    """Return the degrees of freedom of the independent samples."""
    coloured = solution.problem.data.coloured
    samples_each = inflation if coloured is None else inflation * max(coloured.memory.samples_each, 1.0)
    counted = int(np.count_nonzero(solution.problem.data.weight))
    return max(counted / samples_each - (counted - _freedom(solution)), FEWEST_FREE)


def interval(name: str, value: float, error: float, quantile: float) -> tuple[float, float]:
    """Return the 95 % interval of one parameter; a dead time may be zero, everything else keeps its sign."""
    if name == "D" or value == 0.0:
        return max(value - quantile * error, 0.0), value + quantile * error
    factor = math.exp(min(quantile * error / abs(value), 700.0))
    low, high = sorted((value / factor, value * factor))
    return low, high


def scaled_inverse(J: FloatArray) -> FloatArray:
    """Return `(J' J)^-1`, scaled column by column; unobservable directions get a huge variance."""
    size = np.sqrt(np.einsum("ij,ij->j", J, J))
    size = np.maximum(size, SMALLEST * max(float(size.max()), SMALLEST))
    _, s, vt = np.linalg.svd(J / size, full_matrices=False)
    s = np.maximum(s, 1e-14)
    scaled = vt.T / s / size[:, None]
    result: FloatArray = scaled @ scaled.T
    return result


def _slopes(at: Callable[[FloatArray], FloatArray | None], x: FloatArray, base: FloatArray) -> FloatArray:
    """Return the derivatives of a model's values, `base` at `x`; forward, or backward where `at` returns None."""
    slopes = np.zeros((base.size, x.size))
    for k in range(x.size):
        for step in (STEP, -STEP):
            shifted = x.copy()
            shifted[k] += step * max(abs(x[k]), STEP)
            other = at(shifted)
            if other is not None:
                slopes[:, k] = (other - base) / (shifted[k] - x[k])
                break
    return slopes


def _pair_at(solution: Solution, x: FloatArray) -> FloatArray | None:
    """Return `(K, m, n, D)` or `(K, m, n, Z, D)`, or `(K, a1, a2, a3, D)`, at another `theta` and gains."""
    model = _model_at(solution, x)
    if model is None:
        return None
    rational, values = model.rational(), model.parameters()
    if len(rational.a) > 3:
        return np.array([values["K"], *rational.a[1:], model.D])
    zero = [values["Z"]] if "Z" in values else []
    return np.array([values["K"], rational.a[2], rational.a[1], *zero, model.D])


def _parameters_at(solution: Solution, x: FloatArray, model: ProcessModel) -> FloatArray | None:
    """Return the parameters at another `theta` and gains, or None where the model is of another kind there."""
    pair = isinstance(model, SopdtOverdamped | InverseResponse)
    other = _model_at(solution, x, within_equal_lags=pair)
    return np.array(list(other.parameters().values())) if other and other.structure == model.structure else None


def _model_at(solution: Solution, x: FloatArray, *, within_equal_lags: bool = False) -> ProcessModel | None:
    """Return the model at another `theta` and gains; None where there is none."""
    problem = solution.problem
    shape, delay = problem.split(x[: solution.theta.size])
    gains = ([] if problem.known_gain is None else [problem.known_gain]) + x[solution.theta.size :].tolist()
    if within_equal_lags:
        # Past equal lags the pair would be complex: the edge is as far as this model goes.
        shape[1] = min(shape[1], shape[0] / 4.0)
    try:
        return problem.structure.model(shape, gains, delay)
    except InputError:
        return None


REAL = 1e-9
"""Imaginary part, as a share of the whole, under which a root counts as real."""


@dataclass(frozen=True, slots=True)
class Lags:
    """Intervals of two time constants, s; `merged` when they are one."""

    T1: tuple[float, float]
    T2: tuple[float, float]
    merged: bool


def lag_intervals(n: float, m: float, covariance: FloatArray, quantile: float) -> Lags:
    """Return the intervals of both time constants.

    Parameters
    ----------
    n, m : float
        Sum and product, s and s^2.
    covariance : array of float, shape (2, 2)
        Of `(n, m)`.
    quantile : float
        Student's quantile of the interval.
    """
    x = m / n**2
    (vn, c), (_, vm) = (quantile**2 * covariance / np.array([[n**2, n**3], [n**3, n**4]])).tolist()
    bounds = np.roots([1.0, -2.0, 1.0 + 2.0 * x - vn, -2.0 * x + 2.0 * c, x * x - vm])
    real = np.sort(bounds.real[np.abs(bounds.imag) <= REAL * np.abs(bounds)])
    if real.size == 4:
        low, split, join, high = (n * real).tolist()
        return Lags((max(join, 0.0), high), (max(low, 0.0), max(split, 0.0)), merged=False)
    below, above = 0.5 - math.sqrt(vn) / 2.0, 0.5 + math.sqrt(vn) / 2.0
    low, high = (min(real[0], below), max(real[-1], above)) if real.size else (below, above)
    return Lags((max(n * below, 0.0), n * high), (max(n * low, 0.0), n * above), merged=True)
