"""Detection of outliers: isolated spikes in the residual.

    d_k = e_k - median(e_{k-3} .. e_{k+3})
    outlier:  |d_k| > 6 * 1.4826 median |d|   and   |d_k| > 3 * 1.4826 median |e|

(Hampel 1974; Davies and Gather, JASA 88, 1993.) The residual of a wrong model is smooth and follows its own
median, so it is not mistaken for outliers; and deviations within the residual's spread do no harm.

Peaks that recur at the same time after a move of the output are a response of the process that the model lacks
(the dip of an inverse response lasts a sample or two), and never a spike.

Impossible readings, a register full of ones for example, are replaced before the first fit, because
they would decide where the search begins:

    wild:  |pv_k - median(pv_{k-3} .. pv_{k+3})| > 3 (pv_95% - pv_5%)      30 times that near a pulse of the output
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import scipy

from autotuner.core.signals.noise import MAD_TO_SIGMA

if TYPE_CHECKING:
    from autotuner.core.model.arrays import BoolArray, FloatArray
    from autotuner.core.recording import Recording

WINDOW = 7
"""Samples of the running median: outliers of up to three samples in a row are found."""
BEYOND = 6.0
"""Robust standard deviations from the median beyond which a sample is an outlier: 2e-9 of normal ones are."""
HARMFUL = 3.0
"""Standard deviations of the whole record that an outlier is off as well: smaller ones hardly move a fit."""


FEWEST_MOVES, SHARE_OF_MOVES, SAMPLES_A_MOVE = 4, 0.3, 10
"""After how many moves, and which share of them, spikes at one lag are an answer; how far apart moves have to be."""
WILD, WILD_AT_PULSE = 3.0, 30.0
"""Distance from the neighbours, in spans of the PV, of a wild reading; by a short pulse of the output, a real one."""


def without_wild(recording: Recording) -> tuple[Recording, BoolArray]:
    """Return a recording whose wild readings are replaced by their neighbours' median, a note, and these readings."""
    pv, rows = recording.pv, np.zeros(len(recording), dtype=np.bool_)
    if pv.size < WINDOW:
        return recording, rows
    calm = scipy.ndimage.median_filter(pv, size=WINDOW, mode="nearest")
    span = float(np.subtract(*np.quantile(pv, (0.95, 0.05))))
    pulse = recording.output != scipy.ndimage.median_filter(recording.output, size=WINDOW, mode="nearest")
    near = scipy.ndimage.maximum_filter1d(pulse.astype(np.int8), 4 * WINDOW + 1).astype(np.bool_)
    rows = (np.abs(pv - calm) > np.where(near, WILD_AT_PULSE, WILD) * span) & (span > 0.0)
    if not rows.any():
        return recording, rows
    note = f"{rows.sum()} wild readings were left out as outliers, such as {pv[rows][0]:g}"
    return replace(recording, pv=np.where(rows, calm, pv), notes=(*recording.notes, note)), rows


def outliers(values: FloatArray, floor: float) -> BoolArray:
    """Return which values are spikes.

    Parameters
    ----------
    values : array of float, shape (N,)
        A residual, or a PV that moves little within seven samples.
    floor : float
        Smallest spread that is accepted: the resolution of the values.
    """
    if values.size < WINDOW:
        return np.zeros(values.size, dtype=np.bool_)
    distance = np.abs(values - scipy.ndimage.median_filter(values, size=WINDOW, mode="nearest"))
    spread = MAD_TO_SIGMA * float(np.median(distance))
    whole = MAD_TO_SIGMA * float(np.median(np.abs(values)))
    result: BoolArray = distance > max(BEYOND * max(spread, floor), HARMFUL * whole)
    return result


def answers(spikes: BoolArray, t: FloatArray, moves_s: FloatArray, interval_s: float) -> BoolArray:
    """Return the spikes that recur at the same lag after so many moves of the output that they are a response.

    Parameters
    ----------
    spikes : array of bool, shape (N,)
        Candidate spikes.
    t, moves_s : array of float, shape (N,) and (M,)
        Times of the samples, and of the moves, ascending, s.
    interval_s : float
        Time between two samples, s.
    """
    found, last = np.zeros(spikes.size, dtype=np.bool_), np.searchsorted(moves_s, t, side="right") - 1
    rows = np.flatnonzero(spikes & (last >= 0))
    if moves_s.size < FEWEST_MOVES or moves_s.size * SAMPLES_A_MOVE > t.size:
        return found
    lag = np.rint((t[rows] - moves_s[last[rows]]) / interval_s)
    for candidate_lag in np.unique(lag):
        together = rows[np.abs(lag - candidate_lag) <= 1.0]
        if np.unique(last[together]).size >= max(FEWEST_MOVES, SHARE_OF_MOVES * moves_s.size):
            found[together] = True
    return found
