"""Uneven sampling: samples at other times than recorded.

    var e_k = sigma^2 + tau^2 (dPV/dt)_k^2:   gain in likelihood over a constant variance

`e` residual, `tau` standard deviation of the sampling times (a variance regression, Davidian and Carroll, JASA 82,
1987). A loop with late samples moves its output late too: this colours the residual of the process alone, and is found
as delays of every move.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.effect import Place
from autotuner.core.diagnosis.extended.extended_model import without_rounding
from autotuner.core.diagnosis.extended.fitting import tangent
from autotuner.core.estimation.linear_least_squares import solve_linear
from autotuner.core.model.arrays import SMALLEST_DIVISOR
from autotuner.core.signals.noise import SIGNIFICANT, autocorrelation, inflation, rms

if TYPE_CHECKING:
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext
    from autotuner.core.model.arrays import FloatArray

JITTER_GAIN = 15.0
"""Gain in log likelihood from which sampling counts as uneven."""
BESIDE_ANY_MODEL = 5.0
"""The same for second differences, which are free of the misfit of a model: a missing smooth component grows
with the slope of the PV as well, but smoothly."""
MORE_THAN_NOISE = 1.25
"""Ratio of misfit to noise at rest from which sampling times are examined."""
GRADUALLY = (0.3, 0.3, 0.1, 0.1, 0.03, 0.03, 0.01, 0.003)
"""Noise, in misfits, of the rounds of a fit whose weights follow from it."""
SHARES = (1.0, 0.4, 0.1, 0.0)
"""Shares of a step that are tried."""
IN_RUNS, FORGOTTEN = 8, 0.25
"""Samples in a row that may be late together, and the autocorrelation after them: a process lacks it longer."""
ONE_INTERVAL = 1.2
"""Widest spread of the moves' latenesses that sampling makes, in sample intervals."""
LARGE_MOVE = 0.3
"""Share of the largest move from which a move's time counts."""
WITH_SLOPE, MOSTLY = 0.2, 0.55
"""Correlation of the sizes of residual and slope, and share of the residual, from which sampling times make it."""
WILDEST = 8.0
"""Largest residual over the standard deviation that sampling times and noise give it, of any that they make: they are
bounded, or nearly normal. Wherever it is larger, something else moved the PV while it should have been at rest."""
IN_PART = 0.35
"""Share of the residual from which sampling times make a part of it that nothing else makes."""


def jitter_seen(context: FitContext, chosen: Fitted) -> tuple[float, float] | None:
    """Return the spread of the sampling times, s, and the noise at rest, PV, when a residual shows jittered sampling.

    It grows with the slope of the PV, and is white or lasts for a few samples only.
    """
    dataset = context.dataset
    rows = chosen.problem.rows
    resting = rows < dataset.at_rest
    rest = max(float(np.std(chosen.residual[resting])) if resting.any() else dataset.noise, dataset.floor)
    if chosen.rms < MORE_THAN_NOISE * rest:
        return None
    chosen, tau, gain = _by_slope(context, chosen, rest)
    slope = _slope(context, chosen)
    scaled = _scaled(context, chosen, tau, rest)
    lasting = autocorrelation(scaled)[IN_RUNS:]
    short = np.abs(lasting).max(initial=0.0) < max(FORGOTTEN, SIGNIFICANT / math.sqrt(rows.size))
    with_slope = float(np.corrcoef(np.abs(chosen.residual), np.abs(slope))[0, 1])
    # Lateness of the moves absorbs a part of the evidence in the likelihood; then the slope decides.
    likely = with_slope > WITH_SLOPE if chosen.problem.effects else gain > JITTER_GAIN
    seen = likely and tau * rms(slope) > MOSTLY * chosen.rms and tau < dataset.data.interval_s
    rough = unevenness_of(chosen.residual, slope)[1] > BESIDE_ANY_MODEL
    tame = np.abs(scaled).max() < WILDEST * rms(scaled)
    return (tau, rest) if short and seen and rough and tame else None


def is_from_sample_to_sample(context: FitContext, chosen: Fitted, spread_s: float, rest: float) -> bool:
    """Return whether each sample is late by itself: several that are late together may be another effect's, too."""
    scaled = _scaled(context, chosen, spread_s, rest)
    return float(autocorrelation(scaled)[0]) < max(FORGOTTEN, SIGNIFICANT / math.sqrt(scaled.size))


def sampled_unevenly(context: FitContext, alone: Fitted) -> bool:
    """Return whether samples are at other times than recorded, independent of the residual of the process alone."""
    slope = _slope(context, alone)
    tau, gain = unevenness_of(alone.residual, slope)
    return gain > JITTER_GAIN and IN_PART * alone.rms < tau * rms(slope) and tau < context.dataset.data.interval_s


def _scaled(context: FitContext, chosen: Fitted, spread_s: float, rest: float) -> FloatArray:
    """Return the residual over the standard deviation that sampling times and noise give it."""
    result: FloatArray = chosen.residual / np.hypot(rest, spread_s * _slope(context, chosen))
    return result


def _slope(context: FitContext, chosen: Fitted) -> FloatArray:
    t = context.dataset.data.t
    result: FloatArray = np.gradient(chosen.simulated(np.arange(t.size)), t)[chosen.problem.rows]
    return result


def _by_slope(context: FitContext, chosen: Fitted, rest: float) -> tuple[Fitted, float, float]:
    """Return a model fitted with weights `1/sqrt(rest^2 + (tau slope)^2)`, with `tau` and its gain in likelihood.

    Without them it follows the effect of the sampling times on steep parts, and misses the flat ones, which show more.
    The weights are introduced gradually: the noise begins at a part of the misfit.
    """
    tau, gain = jitter_of(chosen.residual, _slope(context, chosen), rest)
    for part in GRADUALLY:
        weight = 1.0 / np.sqrt(max(rest, part * chosen.rms) ** 2 + (tau * _slope(context, chosen)) ** 2)
        chosen = _weighted_step(chosen, weight)
        tau, gain = jitter_of(chosen.residual, _slope(context, chosen), rest)
    return chosen, tau, gain


def _weighted_step(chosen: Fitted, weight: FloatArray) -> Fitted:
    """Return the model after a Gauss-Newton step, as much of it as lowers the weighted misfit."""
    problem = chosen.problem
    pv = problem.dataset.data.pv[problem.rows]
    low, high = (np.array([getattr(s, end) for s in problem.searched]) for end in ("low", "high"))
    columns, slopes = tangent(problem, chosen.theta)
    _, found = solve_linear(np.hstack((columns, slopes)) * weight[:, None], pv * weight)
    move = np.zeros(chosen.theta.size)
    move[move.size - slopes.shape[1] :] = found[columns.shape[1] :]
    tried = [_at(chosen, np.clip(chosen.theta + share * move, low, high), pv, weight) for share in SHARES]
    return without_rounding(tried, lambda f: float(np.sum((weight * f.residual) ** 2)))[0]


def _at(chosen: Fitted, theta: FloatArray, pv: FloatArray, weight: FloatArray) -> Fitted:
    columns = chosen.problem.columns(theta, chosen.problem.rows)[0]
    _, linear = solve_linear(columns * weight[:, None], pv * weight)
    return replace(chosen, theta=theta, linear=linear, residual=pv - columns @ linear)


def jittered_moves(context: FitContext, timed: Fitted) -> Fitted | None:
    """Return delays of moves as the result of jittered sampling; None where this does not fit.

    A loop that samples late moves its output late as well, by less than one sample interval.
    """
    _, _, values = timed.problem.split(timed.theta)
    times = np.array(values[0])
    steps = np.abs(context.dataset.data.held.steps[1 : times.size + 1])
    large = times[steps > LARGE_MOVE * steps.max()]  # the time of a small move is hardly visible
    spread = float(np.ptp(np.quantile(large, (0.05, 0.95))))
    if spread > ONE_INTERVAL or jitter_seen(context, timed) is None:
        return None
    effect = replace(timed.problem.effects[0], name="timing_jitter", place=Place.SENSOR)
    return replace(timed, problem=replace(timed.problem, effects=(effect,)))


def jitter_of(residual: FloatArray, slope: FloatArray, sigma: float) -> tuple[float, float]:
    """Return the standard deviation of the sampling times, s, and the gain in log likelihood over constant noise.

    Parameters
    ----------
    residual : array of float, shape (N,)
        Measured minus simulated PV.
    slope : array of float, shape (N,)
        Slope of the simulated PV, PV/s.
    sigma : float
        Noise of the sensor, PV.
    """
    e2, s2 = residual**2, slope**2
    constant = -0.5 * residual.size * (math.log(e2.mean()) + 1.0) if e2.mean() > 0.0 else 0.0
    largest = math.sqrt(float(e2.mean()) / max(float(s2.mean()), SMALLEST_DIVISOR))
    best, found = -math.inf, 0.0
    for tau in largest * np.linspace(0.2, 1.6, 15):
        v = max(sigma, 1e-3 * math.sqrt(float(e2.mean()))) ** 2 + tau**2 * s2
        likelihood = -0.5 * float(np.sum(np.log(v) + e2 / v))
        if likelihood > best:
            best, found = likelihood, float(tau)
    scaled = residual / np.sqrt(sigma**2 + found**2 * s2 + SMALLEST_DIVISOR)
    return found, (best - constant) / inflation(scaled)


def unevenness_of(residual: FloatArray, slope: FloatArray) -> tuple[float, float]:
    """Return the result of `jitter_of` for the second differences alone, which are free of the misfit of a model.

    `d_k = (e_k - (e_k-1 + e_k+1)/2) sqrt(2/3)`, var `sigma^2 + tau^2 (s_k^2 + (s_k-1^2 + s_k+1^2)/4) 2/3`.
    Parameters and units are those of `jitter_of`; `sigma` is found with `tau`.
    """
    d2 = (residual[1:-1] - 0.5 * (residual[:-2] + residual[2:])) ** 2 / 1.5
    s2 = (slope[1:-1] ** 2 + 0.25 * (slope[:-2] ** 2 + slope[2:] ** 2)) / 1.5
    mean = float(d2.mean()) if d2.size else 0.0
    if mean <= 0.0 or not s2.any():
        return 0.0, 0.0
    shares = np.linspace(0.0, 1.6, 33) ** 2 / float(s2.mean())
    noise = np.linspace(0.05, 1.0, 20) ** 2
    v = noise[:, None, None] + shares[:, None] * s2
    likelihood = -0.5 * (np.log(v) + d2 / mean / v).sum(axis=2)
    best = np.unravel_index(int(np.argmax(likelihood)), likelihood.shape)
    return math.sqrt(float(shares[best[1]]) * mean), float(likelihood[best]) + 0.5 * d2.size
