"""The largest gain of a controller of given shape within limits of the sensitivities, in closed form.

With `L = k L1`, each frequency forbids an interval of gains `k`:

    |1 + k L1| < 1/Ms          where  k^2 |L1|^2 + 2 k Re L1 + 1 - 1/Ms^2 < 0
    |k L1| > Mt |1 + k L1|     where  k^2 |L1|^2 (Mt^2 - 1) + 2 k Mt^2 Re L1 + Mt^2 < 0

Their union over all frequencies (and over all processes that the controller must suit) leaves gaps; in a gap the number
of unstable closed-loop poles does not change. The answer is the upper edge of the highest stable gap.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.core.model.arrays import ComplexArray, FloatArray


def forbidden_gains(loop: ComplexArray, Ms: float, Mt: float) -> tuple[FloatArray, FloatArray]:
    """Return lower and upper ends of the forbidden intervals of `k` for the loop `k * loop`, shape (n,) each.

    Parameters
    ----------
    loop : array of complex, any shape
        Frequency response of the loop for `k = 1`.
    Ms, Mt : float
        Largest sensitivities allowed, above 1.
    """
    square = np.abs(loop).ravel() ** 2
    real = loop.real.ravel()
    by_S = _negative_between(square, real, 1.0 - 1.0 / Ms**2)
    by_T = _negative_between(square * (Mt**2 - 1.0), real * Mt**2, Mt**2)
    return np.concatenate((by_S[0], by_T[0])), np.concatenate((by_S[1], by_T[1]))


def _negative_between(a: FloatArray, b: FloatArray, c: float) -> tuple[FloatArray, FloatArray]:
    """Return the roots, where positive, between which `a k^2 + 2 b k + c` is negative; `a`, `c` positive."""
    discriminant = b * b - a * c
    found = (discriminant > 0.0) & (b < 0.0)
    sum_of_roots = np.sqrt(discriminant[found]) - b[found]
    return c / sum_of_roots, sum_of_roots / a[found]


def largest_gains(loop: ComplexArray, Ms: float, Mt: float) -> list[float]:
    """Return the upper edges of the gaps between the forbidden gains, highest first."""
    lower, upper = forbidden_gains(loop, Ms, Mt)
    if lower.size == 0:
        return []
    order = np.argsort(lower)
    starts, reached = lower[order], np.maximum.accumulate(upper[order])
    open_below = np.flatnonzero(starts[1:] > reached[:-1]) + 1
    return [float(starts[i]) for i in (*open_below[::-1], 0)]


def largest_gain(loop: ComplexArray, Ms: float, Mt: float, is_stable: Callable[[float], bool]) -> float | None:
    """Return the largest `k` with both sensitivities within their limits and a stable loop, or None.

    Parameters
    ----------
    loop : array of complex, any shape
        Frequency response of the loop for `k = 1`; several processes as several rows.
    Ms, Mt : float
        Largest sensitivities allowed, above 1.
    is_stable : callable
        Whether the loop with that `k` is stable; called for the highest gap first.
    """
    return next((k for k in largest_gains(loop, Ms, Mt) if is_stable(k)), None)
