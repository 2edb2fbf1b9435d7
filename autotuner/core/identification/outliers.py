"""Samples that are not measurements: spikes that stand alone in the residual.

    d_k = e_k - median(e_{k-3} .. e_{k+3})
    outlier:  |d_k| > 6 * 1.4826 median |d|   and   |d_k| > 3 * 1.4826 median |e|

(Hampel 1974; Davies and Gather, JASA 88, 1993.) A residual that a wrong model leaves is smooth and follows its own
median, so it is not mistaken for outliers; and what is small beside the residual as a whole does no harm.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import median_filter

if TYPE_CHECKING:
    from autotuner.core.arrays import BoolArray, FloatArray

WINDOW = 7
MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
BEYOND = 6.0
HARMFUL = 3.0


def outliers(values: FloatArray, floor: float) -> BoolArray:
    """Return which values are spikes.

    Parameters
    ----------
    values : array of float, shape (N,)
        A residual, or a PV that moves little within seven samples.
    floor : float
        Smallest spread that is believed: the resolution of the values.
    """
    if values.size < WINDOW:
        return np.zeros(values.size, dtype=np.bool_)
    off = np.abs(values - median_filter(values, size=WINDOW, mode="nearest"))
    spread = MAD_TO_SIGMA * float(np.median(off))
    whole = MAD_TO_SIGMA * float(np.median(np.abs(values)))
    result: BoolArray = off > max(BEYOND * max(spread, floor), HARMFUL * whole)
    return result
