"""The height of an extreme under noise.

    y(t) = c0 + c1 tau + c2 tau^2 + c3 |tau|,   tau = t - t0

fitted by least squares around the highest smoothed sample, with the corner `t0` tried at several places. The `|tau|`
term follows the corner that dead time leaves on a first-order process, `tau^2` the round top of a second-order one;
the height is the largest value of the fit, so noise is averaged instead of picked out, as the largest sample would
do.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from autotuner.core.arrays import FloatArray

SMOOTHING = 0.02
"""Half width of the moving mean that finds the top, in periods."""
WINDOW = 0.06
"""Half width of the fit, in periods: short against the curvature of the sides."""
CORNERS = 9
"""Places tried for the corner, over the middle of the window."""


def apex(t: FloatArray, pv: FloatArray, period_s: float) -> float:
    """Return the height of the maximum of `pv`, PV units.

    Parameters
    ----------
    t, pv : array of float, shape (N,)
        Samples of at least one period, s and PV.
    period_s : float
        Period of the oscillation, s. With under six samples in the window the largest sample is returned.
    """
    interval = float(np.median(np.diff(t)))
    top = t[int(np.argmax(_moving_mean(pv, round(SMOOTHING * period_s / interval))))]
    near = np.abs(t - top) <= WINDOW * period_s
    if int(near.sum()) < 6:
        return float(pv.max())
    places = np.linspace(-0.5, 0.5, CORNERS) * WINDOW * period_s
    fits = [_fit((t[near] - top - place) / (WINDOW * period_s), pv[near]) for place in places]
    return min(fits)[1]


def _moving_mean(y: FloatArray, half_width: int) -> FloatArray:
    length = 2 * half_width + 1
    return np.convolve(np.pad(y, half_width, mode="edge"), np.full(length, 1.0 / length), "valid")


def _fit(tau: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Return the residual sum of squares and the largest value of the fit, the corner included."""
    basis = np.column_stack((np.ones_like(tau), tau, tau * tau, np.abs(tau)))
    c, *_ = np.linalg.lstsq(basis, y, rcond=None)
    fitted = basis @ c
    return float(((y - fitted) ** 2).sum()), max(float(fitted.max()), float(c[0]))
