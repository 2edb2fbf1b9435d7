"""Noise, resolution and whiteness of a signal, without a model.

    sigma       = 1.4826 median |d2| / sqrt(6),  d2 = x[k-1] - 2 x[k] + x[k+1]     (robust, blind to straight lines)
    resolution  = smallest step between two different values
    r_k         = sum x_i x_{i+k} / sum x_i^2                                      (autocorrelation)

Where most second differences vanish (a quantised sensor) their root mean square takes the place of the median.
"""

from __future__ import annotations

import math

import numpy as np

from autotuner.core.model.arrays import FloatArray  # noqa: TC001 - part of the public signature

MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
SIGNIFICANT = 4.0
"""Autocorrelations count as such beyond this many of their standard errors `1/sqrt(N)`."""
LAGS = 40
"""Longest lag of the autocorrelation, samples: a longer memory counts as drift in an experiment."""
OFF_GRID = 0.05
"""Largest distance from a grid, in its steps, that the rounding of decimal numbers explains."""


def rms(values: FloatArray) -> float:
    """Return the root mean square, in the unit of the values; NaN of none."""
    return float(np.sqrt(np.mean(values**2))) if values.size else math.nan


def noise_sigma(values: FloatArray) -> float:
    """Return the standard deviation of the noise on a smooth signal, in its units; 0 under three samples."""
    second = np.diff(values, 2)
    if not second.size:
        return 0.0
    spread = MAD_TO_SIGMA * float(np.median(np.abs(second)))
    if np.mean(second == 0.0) > 0.25:
        spread = float(np.sqrt(np.mean(second**2)))
    return spread / math.sqrt(6.0)


def resolution(values: FloatArray) -> float:
    """Return the smallest step between two different values, in their units; 0 for a constant."""
    steps = np.diff(np.unique(values))
    return float(steps.min()) if steps.size else 0.0


def quantisation(values: FloatArray) -> float:
    """Return the step of the grid that all values lie on, in their units; 0 where they lie on none.

    Unlike `resolution` it is 0 for a signal in floating point, whose smallest difference is not the sensor's.
    """
    step = resolution(values)
    if step == 0.0:
        return 0.0
    steps = (values - values[0]) / step
    return step if float(np.max(np.abs(steps - np.round(steps)))) < OFF_GRID else 0.0


def autocorrelation(values: FloatArray, lags: int = LAGS) -> FloatArray:
    """Return the autocorrelation at lags 1 to `lags`, fewer for a short signal."""
    power = float(values @ values)
    count = min(lags, values.size - 1)
    if power == 0.0:
        return np.zeros(count)
    return np.array([float(values[k:] @ values[:-k]) for k in range(1, count + 1)]) / power


def inflation(residual: FloatArray) -> float:
    """Return the number of samples of a residual per independent sample, 1 for white noise.

    `1 + 2 sum r_k` up to the first lag whose autocorrelation is within its own error (Bartlett 1946).
    """
    r = autocorrelation(residual)
    lost = np.flatnonzero(r < SIGNIFICANT / math.sqrt(residual.size))
    return float(1.0 + 2.0 * r[: lost[0] if lost.size else r.size].sum())
