"""Two time constants that a recording can hardly tell apart.

    T1, T2 are the roots of  g(T) = T^2 - n T + m,   n = T1 + T2,   m = T1 T2

`n` and `m` are well behaved; their roots are not, where they meet. The 95 % set of a root is all `T` at which
`g(T) = 0` is not refuted (Fieller, J. R. Stat. Soc. B 16, 1954),

    g(T)^2 <= q^2 var g(T),   var g(T) = T^2 var n - 2 T cov(n, m) + var m

two separate intervals for roots well apart, one common interval for roots that cannot be told apart. `T`, `n` s,
`m` s^2; `q` the quantile of the interval.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from autotuner.core.arrays import FloatArray  # noqa: TC001 - part of the public signature

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
