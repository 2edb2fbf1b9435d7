"""95 % intervals of the reported sizes, from the derivatives of the fit.

    cov = s^2 i (J'J + s^2 i W)^-1,   J = [derivatives to searched values, columns],   i inflation of the residual
    W     12/width^2 for searched values within bounds of that width: a move merged with another one shows no time
    s^2   the larger mean square of the fitted and of the held-out part
    var f = (df)' cov (df)                                               (delta method)
    J     without its part along the slopes of the innovations with the memory of the noise, which is estimated too
    cov   at least (J'J)^-1 J' V J (J'J)^-1 per number, `V` of noise with a slow part: a model of lower order leaves a
          small slow part of the residual, which hides in the noise of its autocorrelation (see `slow_part`)

A size in which the simulation is a staircase (the band of a sticking valve), or strongly nonlinear, has a profile
interval instead: all values at which the misfit, all else refitted, rises by less than chi^2(0.95) = 3.84 allows.
The time of a jump of the reading lies anywhere between two samples: this uncertainty is added.

The process beside such a number `s` has what its covariance is with `s` held, and what the profile of `s` adds:

    cov x = E cov(x | s) + cov E(x | s),   cov E(x | s) ~ v v',   v = (x(end of the profile) - x)/1.96

(law of total covariance): steps of an actuator that are 1 % larger leave a gain that is 1 % smaller.

Explanations with one term more (`neighbours`), of weights `w_i`, leave the gain and the sizes `x` open by

    var x = sum_i w_i (var_i x + (x_i - x)^2)                            (Buckland and others, Biometrics 53, 1997)
"""

from __future__ import annotations

import math
from functools import lru_cache, partial
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.extended_model import sizes_at
from autotuner.core.diagnosis.extended.fitting import tangent
from autotuner.core.estimation.linear_least_squares import solve_linear
from autotuner.core.estimation.noise.slow_part import slow_part
from autotuner.core.model.arrays import SMALLEST_DIVISOR
from autotuner.core.quantiles import CHI2_95, NORMAL_95, student_quantile
from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext
    from autotuner.core.model.arrays import FloatArray

ROUGH = 1e-3
"""Step of the difference from which a number counts as a staircase."""
MOST_MORE = 4.0
"""Largest weight of the mean square of the held-out part, relative to the fitted part."""
TRIED, NEAREST = 50, 1e-4
BISECTIONS = 6
"""Halvings of the last step of a profile: its end is found to a 64th of it, 0.3 % of the distance from the centre."""
SHARES = {"share": 1.0, "share_against": -1.0}
"""Sizes that are shares of the static gain beside the process, and whether they add to it."""
RIDGE = 1e-14
"""Regularisation of normal equations whose columns have length 1: above rounding (2e-16), below any information."""
Interval = tuple[float, float]
Ends = tuple[tuple["FloatArray", "FloatArray"], ...]
"""`theta` and linear parameters at the ends of a profile."""
Neighbours = tuple[tuple[float, "Fitted"], ...]
"""Explanations and their weights, the one in question among them."""


def covariance(context: FitContext, fitted: Fitted, held_at: Sequence[int] = ()) -> FloatArray:
    """Return the covariance of `theta` and the linear parameters; 0 for fixed ones, and where `theta` is held."""
    columns, slopes = tangent(fitted.problem, fitted.theta)
    held = fitted.theta.size - slopes.shape[1]
    slopes[:, [k - held for k in held_at]] = 0.0
    J = _beside_memory(fitted, np.hstack((slopes, columns)))
    scale = np.sqrt(np.einsum("ij,ij->j", J, J))
    live = scale > 0.0
    normal = (J[:, live] / scale[live]).T @ (J[:, live] / scale[live])
    residual = _residual(context, fitted)
    free = max(residual.size - J.shape[1], 1)
    square = float(residual @ residual) / free
    # Innovations are not the error of simulation, and are the same on both parts where noise with a memory is accepted.
    elsewhere = square if fitted.problem.memory else float(np.mean(context.held_out_residual(fitted) ** 2))
    variance = min(max(elsewhere, square), MOST_MORE * square) * context.inflation(residual)
    cov = np.zeros((fitted.theta.size + columns.shape[1],) * 2)
    at = held + np.flatnonzero(live)
    widths = np.concatenate(
        ([s.high - s.low or math.inf for s in fitted.problem.searched], np.full(columns.shape[1], math.inf))
    )
    within = 12.0 * variance / (widths[at] * scale[live]) ** 2
    inverse = np.linalg.pinv(normal + np.diag(RIDGE + within), hermitian=True)
    stretch = _stretch(residual, J[:, live] / scale[live], inverse, variance)
    cov[np.ix_(at, at)] = variance * inverse * np.outer(stretch, stretch) / np.outer(scale[live], scale[live])
    return cov


def _beside_memory(fitted: Fitted, slopes: FloatArray) -> FloatArray:
    """Return what slopes have beside those of the noise's memory, which is estimated too: in a loop they are alike."""
    problem, noise = fitted.problem, fitted.problem.noise
    if noise is None:
        return slopes
    rows = problem.computed
    past = problem.of_fitted(noise.past(problem.dataset.data.pv[rows] - fitted.simulated(rows)))
    q, _ = solve_linear(past, slopes[:, 0])
    result: FloatArray = slopes - q @ (q.T @ slopes)
    return result


def _stretch(residual: FloatArray, slopes: FloatArray, inverse: FloatArray, variance: float) -> FloatArray:
    """Return by how much the standard errors with a slow part exceed those without, at least 1."""
    slow = slow_part(residual, slopes)
    robust = np.einsum("ij,jk,ki->i", inverse, slow.of(slopes), inverse)
    robust *= (student_quantile(slow.freedom(*slopes.shape)) / NORMAL_95) ** 2
    plain = variance * np.maximum(np.diag(inverse), SMALLEST_DIVISOR)
    stretched: FloatArray = np.sqrt(np.maximum(robust / np.maximum(plain, SMALLEST_DIVISOR), 1.0))
    return stretched


def _residual(context: FitContext, fitted: Fitted) -> FloatArray:
    """Return measured minus simulated PV: of a coarse sensor with the error of its readings, within which it fits."""
    rows = fitted.problem.rows
    moved = fitted.problem.dataset.data.pv[rows] - context.dataset.data.pv[rows]
    return fitted.residual - moved


def effect_intervals(context: FitContext, fitted: Fitted, others: Neighbours = ()) -> list[dict[str, Interval]]:
    """Return the intervals of the sizes of all effects, in their order; `others` with their weights.

    Those with other sizes do not count: the curvature of a cubic is not that of the line and the square alone.
    """
    centre, own = fitted.sizes(), _effect_intervals(context, fitted)
    others = tuple((weight, f) for weight, f in others if _names_of_sizes(f) == _names_of_sizes(fitted))
    if len(others) < 2:
        return own
    found = [(w, f.sizes(), own if f is fitted else _effect_intervals(context, f)) for w, f in others]
    return [
        {name: averaged(sizes[name], ((w, s[row][name], i[row][name]) for w, s, i in found)) for name in sizes}
        for row, sizes in enumerate(centre)
    ]


def _names_of_sizes(fitted: Fitted) -> list[tuple[str, ...]]:
    """Return the name of each effect with the names of its sizes."""
    return [(name, *sizes) for name, sizes in zip(fitted.names, fitted.sizes(), strict=True)]


def averaged(value: float, alternatives: Iterable[tuple[float, float, Interval]]) -> Interval:
    """Return the interval about a value that alternatives leave, each with its weight, value and interval."""
    whole = below = above = 0.0
    for weight, other, (low, high) in alternatives:
        off = (NORMAL_95 * (other - value)) ** 2
        whole += weight
        below += weight * ((other - low) ** 2 + off)
        above += weight * ((high - other) ** 2 + off)
    return value - math.sqrt(below / whole), value + math.sqrt(above / whole)


def _effect_intervals(context: FitContext, fitted: Fitted) -> list[dict[str, Interval]]:
    centre = fitted.sizes()
    profiles = _profiles(context, fitted)
    cov = covariance(context, fitted, [k for k, *_ in profiles])  # a staircase has no slope of its own
    _, _, values = fitted.problem.split(fitted.theta)
    result = []
    for row, (sizes, effect, p) in enumerate(zip(centre, fitted.problem.effects, values, strict=True)):

        def one(theta: FloatArray, linear: FloatArray, row: int = row) -> Mapping[str, float]:
            return sizes_at(fitted.problem, theta, linear, fitted.counts)[row]

        spread = _delta(one, sizes, fitted, cov)
        blur = {} if effect.blur is None else effect.blur(p)
        wide = {name: spread[name] + blur.get(name, 0.0) for name in sizes}
        found = {name: (value - wide[name], value + wide[name]) for name, value in sizes.items()}
        for _, of, ends in profiles:
            for there in (one(*end) for end in ends if of == row):
                found = {name: (min(low, there[name]), max(high, there[name])) for name, (low, high) in found.items()}
        result.append(found)
    return result


def process_covariance(context: FitContext, fitted: Fitted, others: Neighbours = ()) -> FloatArray | None:
    """Return the covariance of the process parameters, in their order; None for one at its bound.

    `others` with their weights widen the error of the gain, the first parameter: lags of another order mean another.
    """
    result = _process_covariance(context, fitted)
    if result is None or len(others) < 2 or result[0, 0] <= 0.0:
        return result
    gain, variance = float(fitted.linear[0]), 0.0
    for weight, other in others:
        cov = result if other is fitted else _process_covariance(context, other)
        open_by = float(result[0, 0] if cov is None else cov[0, 0])
        variance += weight * (open_by + (float(other.linear[0]) - gain) ** 2)
    stretch = np.ones(result.shape[0])
    stretch[0] = math.sqrt(variance / result[0, 0])
    return result * np.outer(stretch, stretch)


def _process_covariance(context: FitContext, fitted: Fitted) -> FloatArray | None:
    parameters = partial(_parameters, fitted)
    try:
        centre = dict(parameters(fitted.theta, fitted.linear))
        profiles = _profiles(context, fitted)
        cov = covariance(context, fitted, [k for k, *_ in profiles])
        slopes = _slopes(parameters, centre, fitted, cov)
    except (InputError, KeyError):
        return None
    rows = np.array([slopes[name] for name in centre])
    result: FloatArray = rows @ cov @ rows.T
    for _, _, ends in profiles:
        result = result + _spread_over(parameters, centre, ends)
    return result


def _parameters(fitted: Fitted, theta: FloatArray, linear: FloatArray) -> Mapping[str, float]:
    """Return the process parameters at any `theta` and `linear`."""
    structure = fitted.problem.structure
    shape, D, _ = fitted.problem.split(theta)
    return structure.model(shape, linear[: structure.gains].tolist(), max(D, 0.0)).parameters()


def whole_gain(context: FitContext, fitted: Fitted, others: Neighbours = ()) -> tuple[float, Interval] | None:
    """Return the gain of a process with a slow mode, a second way or a recycle, and its interval; None without.

    `others` with their weights widen it, as far as they have one.
    """
    own = _whole_gain(context, fitted)
    if own is None or len(others) < 2:
        return own
    found = ((weight, own if f is fitted else _whole_gain(context, f)) for weight, f in others)
    return own[0], averaged(own[0], ((weight, *gain) for weight, gain in found if gain is not None))


def _whole_gain(context: FitContext, fitted: Fitted) -> tuple[float, Interval] | None:
    def whole(theta: FloatArray, linear: FloatArray) -> Mapping[str, float]:
        share = sum(shares_beside(sizes_at(fitted.problem, theta, linear, fitted.counts)))
        return {"K": _parameters(fitted, theta, linear)["K"] / (1.0 - share)} if share < 1.0 else {}

    if not shares_beside(fitted.sizes()):
        return None
    try:
        centre = dict(whole(fitted.theta, fitted.linear))
        half = _delta(whole, centre, fitted, covariance(context, fitted))
    except (InputError, KeyError):
        return None
    return (centre["K"], (centre["K"] - half["K"], centre["K"] + half["K"])) if centre else None


def shares_beside(sizes: Sequence[Mapping[str, float]]) -> list[float]:
    """Return the shares of the whole static gain that are beside the process; that of a way against it is negative."""
    return [sign * s[name] for s in sizes for name, sign in SHARES.items() if name in s]


def _spread_over(
    parameters: Callable[[FloatArray, FloatArray], Mapping[str, float]], centre: Mapping[str, float], ends: Ends
) -> FloatArray:
    """Return the covariance that a number adds between the ends of its profile; 0 where no process is left there."""
    spread = np.zeros((len(centre), len(centre)))
    for theta, linear in ends:
        try:
            there = parameters(theta, linear)
        except (InputError, ValueError, OverflowError):
            continue
        away = np.array([there.get(name, value) - value for name, value in centre.items()]) / NORMAL_95
        spread = max(spread, np.outer(away, away), key=lambda found: float(found[0, 0]))
    return spread


def process_intervals(fitted: Fitted, cov: FloatArray | None) -> dict[str, Interval]:
    """Return the intervals of the process parameters from their covariance; empty without one."""
    if cov is None:
        return {}
    values = fitted.process().parameters()
    spread = NORMAL_95 * np.sqrt(np.maximum(np.diag(cov), 0.0))
    return {name: (v - s, v + s) for (name, v), s in zip(values.items(), spread.tolist(), strict=True)}


def _delta(
    f: Callable[[FloatArray, FloatArray], Mapping[str, float]],
    centre: Mapping[str, float],
    fitted: Fitted,
    cov: FloatArray,
) -> dict[str, float]:
    """Return the half widths of the intervals of the values of `f`."""
    slopes = _slopes(f, centre, fitted, cov)
    return {name: NORMAL_95 * math.sqrt(max(float(s @ cov @ s), 0.0)) for name, s in slopes.items()}


def _slopes(
    f: Callable[[FloatArray, FloatArray], Mapping[str, float]],
    centre: Mapping[str, float],
    fitted: Fitted,
    cov: FloatArray,
) -> dict[str, FloatArray]:
    """Return the slopes of the values of `f` with all that was fitted."""
    size = fitted.theta.size
    x = np.concatenate((fitted.theta, fitted.linear))
    error = np.sqrt(np.maximum(np.diag(cov), 0.0))
    slopes = {name: np.zeros(x.size) for name in centre}
    for k in np.flatnonzero(error > 0.0):
        step = min(0.01 * error[k], 1e-3) if k < size else 0.01 * error[k]
        moved = x.copy()
        moved[k] += step
        for name, value in f(moved[:size], moved[size:]).items():
            if name in slopes:
                slopes[name][k] = (value - centre[name]) / step
    return slopes


@lru_cache(maxsize=4)
def _profiles(context: FitContext, fitted: Fitted) -> tuple[tuple[int, int, Ends], ...]:
    """Return of each number that has a profile: its place in `theta`, its effect, and all that was fitted at the ends.

    Cached, because sizes and process need them.
    """
    result = []
    at = len(fitted.problem.structure.shape) + 1
    for row, effect in enumerate(fitted.problem.effects):
        for k, searched in enumerate(effect.searched):
            if searched.profiled or (searched.step >= ROUGH and effect.position is not None):
                result.append((at + k, row, _profile(context, fitted, at + k, (searched.low, searched.high))))
        at += len(effect.searched)
    return tuple(result)


def _profile(context: FitContext, fitted: Fitted, k: int, bounds: Interval) -> Ends:
    """Return all that was fitted at the two ends of the values of one number that explain the record as well."""
    least = float(fitted.residual @ fitted.residual) + fitted.residual.size * context.dataset.floor**2 * 0.01
    allowed = least * (1.0 + CHI2_95 * context.colour(fitted) / fitted.residual.size)
    centre = float(fitted.theta[k])
    ends = []
    for end in bounds:
        kept, inside, outside = (fitted.theta, fitted.linear), centre, end
        for value in (centre + (end - centre) * np.geomspace(NEAREST, 1.0, TRIED)).tolist():
            *there, misfit = _nearest_at(fitted, k, value)
            if misfit > allowed:
                outside = value
                break
            kept, inside = (there[0], there[1]), value
        for _ in range(BISECTIONS if inside != outside else 0):
            middle = (inside + outside) / 2.0
            *there, misfit = _nearest_at(fitted, k, middle)
            if misfit > allowed:
                outside = middle
            else:
                kept, inside = (there[0], there[1]), middle
        ends.append(kept)
    return tuple(ends)


def _nearest_at(fitted: Fitted, k: int, value: float) -> tuple[FloatArray, FloatArray, float]:
    """Return all that is fitted with one number held, the others moved along their slopes, and the misfit."""
    theta = fitted.theta.copy()
    theta[k] = value
    columns, slopes = tangent(fitted.problem, theta)
    held = fitted.theta.size - slopes.shape[1]
    others = np.delete(np.arange(held, theta.size), k - held)
    pv = fitted.problem.target
    q, found = solve_linear(np.hstack((columns, slopes[:, others - held])), pv)
    left = pv - q @ (q.T @ pv)
    theta[others] += found[columns.shape[1] :]
    searched = fitted.problem.searched
    theta = np.clip(theta, [s.low for s in searched], [s.high for s in searched])
    return theta, found[: columns.shape[1]], float(left @ left)
