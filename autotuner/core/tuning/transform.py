"""From a frequency response to the time response, as one matrix.

    y(t) = (2/pi) integral of Re Y(jw) cos(w t) dw over w from 0 to infinity

for a stable `Y` without poles on the axis. `Re Y` is taken as straight between the frequencies of the grid (constant
below the first), which makes the integral exact (Filon): with `F'' = cos(w t)`, each hat function contributes a second
divided difference of `F = (1 - cos(w t))/t^2 = 2 sin^2(w t/2)/t^2`. The matrix depends on the two grids alone, so a
search that evaluates hundreds of controllers pays for the cosines once.

`w` rad/s, `t` s.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from autotuner.core.arrays import FloatArray


def cosine_matrix(w: FloatArray, t: FloatArray) -> FloatArray:
    """Return the matrix that takes `Re Y(jw)` to `y(t)`.

    Parameters
    ----------
    w : array of float, shape (N,)
        Frequencies, rad/s, increasing, above 0.
    t : array of float, shape (M,)
        Times, s, above 0.

    Returns
    -------
    array of float, shape (M, N)
    """
    angle = np.outer(t, w)
    twice = 2.0 * np.sin(angle / 2.0) ** 2 / t[:, None] ** 2
    slope = np.diff(twice, axis=1) / np.diff(w)
    once = np.sin(angle[:, -1]) / t
    matrix = np.empty_like(angle)
    matrix[:, 0] = slope[:, 0]
    matrix[:, 1:-1] = slope[:, 1:] - slope[:, :-1]
    matrix[:, -1] = once - slope[:, -1]
    return matrix * (2.0 / math.pi)


def integral_weights(t: FloatArray) -> FloatArray:
    """Return the weights of the trapezoidal rule from 0 to the last time, for a function that is 0 at 0."""
    edges = np.concatenate(([0.0], t, t[-1:]))
    weights: FloatArray = (edges[2:] - edges[:-2]) / 2.0
    return weights
