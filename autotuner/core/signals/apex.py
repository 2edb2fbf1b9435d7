"""The height of an extreme under noise.

    round     y(t) = c0 + c1 tau + c2 tau^2
    cornered  y(t) = c0 + c1 tau + c2 |tau|,   tau = t - t0

fitted by least squares around the highest smoothed sample. A second-order process has a round top, whose height is
that of the parabola. Dead time leaves a first-order process with a corner, two straight sides that meet at `t0`,
whose height is `c0`; `t0` is searched on a grid. Under noise neither shape can be ruled out, so the two heights are
averaged with the weights of Akaike's criterion (Burnham and Anderson, Model Selection, 2002, ch. 4). Noise is
averaged, whereas the largest sample would be biased.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.model.arrays import SMALLEST_DIVISOR

if TYPE_CHECKING:
    from autotuner.core.model.arrays import FloatArray

SMOOTHING = 0.02
"""Half width of the moving mean that finds the top, in periods."""
WINDOW = 0.06
"""Half width of the fit, in periods: short against the curvature of the sides."""
FEWEST = 8
"""Samples in the window that a fit needs."""
RIDGE = 1e-13
"""Relative weight of a small slope, which decides where the samples do not."""
CORNERS = np.linspace(-0.5, 0.5, 21)
"""Places tried for the corner, in half widths of the window."""


def apex(t: FloatArray, pv: FloatArray, period_s: float, interval_s: float | None = None) -> float:
    """Return the height of the maximum of `pv`, PV units.

    Parameters
    ----------
    t, pv : array of float, shape (N,)
        Samples of at least one period, s and PV.
    period_s : float
        Period of the oscillation, s. With too few samples in the window the largest sample is returned.
    interval_s : float, optional
        Median time between samples, s, where known.
    """
    interval = float(np.median(np.diff(t))) if interval_s is None else interval_s
    top = t[int(np.argmax(_moving_mean(pv, round(SMOOTHING * period_s / interval))))]
    tau = (t - top) / (WINDOW * period_s)
    near = np.abs(tau) <= 1.0
    if int(near.sum()) < FEWEST:
        return float(pv.max())
    tau, y = tau[near], pv[near]
    round_misfit, c = _fit(np.column_stack((np.ones_like(tau), tau, tau * tau)), y)
    corner_misfit, height = _corner(tau, y)
    # the corner has one parameter more than the parabola: its place
    gain = tau.size * math.log(max(round_misfit, SMALLEST_DIVISOR) / max(corner_misfit, SMALLEST_DIVISOR)) - 2.0
    weight = 1.0 / (1.0 + math.exp(-min(max(gain, -100.0), 100.0) / 2.0))
    return weight * height + (1.0 - weight) * _top_of_parabola(c, y)


def _moving_mean(y: FloatArray, half_width: int) -> FloatArray:
    """Return the mean over each sample and its neighbours, by differences of a running sum: as fast for any width."""
    length = 2 * half_width + 1
    away = y - y[0]
    edges = np.zeros(half_width + 1), away, np.full(half_width, away[-1])
    running = np.cumsum(np.concatenate(edges))
    mean: FloatArray = y[0] + (running[length:] - running[:-length]) / length
    return mean


def _corner(tau: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Return the residual sum of squares with the corner at the best of its places, and the height there.

    All places at once by their normal equations, 3 by 3: times are of order one, so that their condition is harmless. A
    corner with all samples on one side of it leaves its two slopes open, between which `RIDGE` decides.
    """
    from_corner = tau - CORNERS[:, np.newaxis]
    basis = np.stack((np.ones_like(from_corner), from_corner, np.abs(from_corner)), axis=1)
    squares = basis @ basis.transpose(0, 2, 1)
    c = np.linalg.solve(squares + RIDGE * y.size * np.eye(3), (basis @ y)[:, :, np.newaxis])
    residual = y - np.einsum("pk,pkn->pn", c[:, :, 0], basis)
    misfits = np.einsum("pn,pn->p", residual, residual)
    index = int(np.argmin(misfits))
    return float(misfits[index]), float(c[index, 0, 0])


def _fit(basis: FloatArray, y: FloatArray) -> tuple[float, FloatArray]:
    """Return the residual sum of squares and the coefficients."""
    c = np.asarray(np.linalg.lstsq(basis, y, rcond=None)[0], dtype=np.float64)
    residual = y - basis @ c
    return float(residual @ residual), c


def _top_of_parabola(c: FloatArray, y: FloatArray) -> float:
    """Return the top of `c0 + c1 tau + c2 tau^2`; where it has none inside the window, the largest sample."""
    if c[2] >= 0.0 or abs(c[1]) > -2.0 * c[2]:
        return float(y.max())
    return float(c[0] - c[1] ** 2 / (4.0 * c[2]))
