"""A slow part of a residual that white noise hides, and what it does to the errors of a fit.

    e = M (d + w),   M = I - Q Q',   cov w = s^2 I,   cov d = s^2 r R,   R_ij = a^|i-j|

`d` is what the model lacks: smooth, and a share `r` of the noise (Kennedy and O'Hagan, J. R. Stat. Soc. B 63, 2001: the
discrepancy of a model). `Q` spans the slopes of the fit, which absorb most of it: the residual shows the rest. Its
expected periodogram is that of `M (I + r R) M`, frequency by frequency, and `r` and `a` maximise

    -sum_f (ln E_f + I_f/E_f)                         (Whittle, Ark. Mat. 2, 1953; restricted to the residual: Patterson
                                                       and Thompson, Biometrika 58, 1971)

It counts where the criterion of Akaike speaks for its two numbers. The autocorrelations of such a residual are each
within their own error, so that sums over the significant ones (`inflation`) miss it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.model.zoh_input import accumulate

if TYPE_CHECKING:
    from autotuner.core.model.arrays import ComplexArray, FloatArray

RATIOS = np.geomspace(0.01, 100.0, 17)
"""Tried variances of the slow part, relative to those of the noise: factors of 1.8 apart, which no record resolves."""
SHORTEST, LONGEST = 2.0, 0.25
"""Tried memories: from two samples, each twice the one before, to a share of the samples."""
TWO_NUMBERS = 4.0
"""Twice the log likelihood that two numbers more have to bring (Akaike)."""
LEAST_LEFT = 1e-3
"""Share of a frequency that a fit leaves at least, where its slopes absorb all of it."""
FEWEST_FREE = 3.0
"""Degrees of freedom that a slow part is given at least: with fewer, an interval has no end."""
FEWEST = 20
"""Samples below which no slow part is searched."""


@dataclass(frozen=True, slots=True)
class SlowPart:
    """Noise with a slow part.

    Attributes
    ----------
    variance : float
        `s^2`, of the white noise, in the unit of the residual squared.
    ratio : float
        `r`, the variance of the slow part over it; 0 without one.
    forgets : float
        `a`, the share that a sample keeps of the one before.
    """

    variance: float
    ratio: float = 0.0
    forgets: float = 0.0

    def of(self, slopes: FloatArray) -> FloatArray:
        """Return `J' cov(d + w) J` of the slopes `J`, shape (N, P)."""
        result: FloatArray = self.variance * (slopes.T @ (slopes + self.ratio * remembered(slopes, self.forgets)))
        return result

    def freedom(self, samples: int, fitted: int) -> float:
        """Return the degrees of freedom of its variance, of a slow part where there is one (Satterthwaite, 1946)."""
        square = self.forgets**2 if self.ratio else 0.0
        return max(samples * (1.0 - square) / (1.0 + square) - fitted, FEWEST_FREE)


def slow_part(residual: FloatArray, slopes: FloatArray) -> SlowPart:
    """Return the slow part of a residual at N samples in even steps, given the slopes of its fit, shape (N, P)."""
    n = residual.size
    Q = np.linalg.qr(slopes)[0]
    of_residual, of_slopes = np.abs(_spectrum(residual)) ** 2, _spectrum(Q)
    white = np.maximum(1.0 - np.sum(np.abs(of_slopes) ** 2, axis=1), LEAST_LEFT)
    best = SlowPart(float(np.mean(of_residual / white)))
    if n < FEWEST or best.variance <= 0.0:
        return best
    least = _surprise(of_residual, white[:, None])[1][0] - TWO_NUMBERS / 2.0
    memories = SHORTEST * 2.0 ** np.arange(max(int(math.log2(LONGEST * n / SHORTEST)), 0) + 1)
    for a in np.exp(-1.0 / memories).tolist():
        variances, surprises = _surprise(of_residual, white[:, None] + RATIOS * _left_of(Q, of_slopes, a)[:, None])
        k = int(np.argmin(surprises))
        if surprises[k] < least:
            best, least = SlowPart(float(variances[k]), float(RATIOS[k]), a), surprises[k]
    return best


def remembered(values: FloatArray, a: float) -> FloatArray:
    """Return `R x` of columns `x`, with `R_ij = a^|i-j|`."""
    kept = np.full(len(values), a)
    forward, backward = accumulate(kept, values.T), accumulate(kept, values[::-1].T)[:, ::-1]
    result: FloatArray = (forward + backward).T - values
    return result


def _spectrum(values: FloatArray) -> ComplexArray:
    spectrum: ComplexArray = np.fft.rfft(values, axis=0)[1:] / math.sqrt(len(values))
    return spectrum


def _left_of(Q: FloatArray, of_slopes: ComplexArray, a: float) -> FloatArray:
    """Return the expected periodogram of `M d` for a slow part of unit variance."""
    n, lag = len(Q), np.arange(len(Q))
    slow = 2.0 * np.fft.rfft((1.0 - lag / n) * a**lag)[1:].real - 1.0
    RQ = remembered(Q, a)
    across = np.sum((of_slopes * _spectrum(RQ).conj()).real, axis=1)
    within = np.einsum("fj,jk,fk->f", of_slopes, Q.T @ RQ, of_slopes.conj()).real
    result: FloatArray = np.maximum(slow - 2.0 * across + within, 0.0)
    return result


def _surprise(of_residual: FloatArray, expected: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return `s^2` and the negative log likelihood for each column of expected periodograms with `s^2 = 1`."""
    variances = np.mean(of_residual[:, None] / expected, axis=0)
    return variances, np.sum(np.log(expected), axis=0) + len(of_residual) * np.log(variances)
