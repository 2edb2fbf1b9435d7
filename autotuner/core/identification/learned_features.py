"""Features without unit that the learned correction sees: one function for training and for a live record.

    level   = sqrt(noise^2 + FLOOR^2 + interval^4)        what a harmonic may be wrong by
    missed  = (y_k - y_k of the start)/level, clipped     k = 2 ... 5, both parts

Order: start values; gain ratio, lag and describing-function estimates `T_df/Pu`, `D_df/Pu`; peak and duty; higher
harmonics; level of noise, sampling, hysteresis, cycles, error of the gain; what the start missed.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from autotuner.core.arrays import FloatArray
    from autotuner.core.identification.harmonic_start import Starts
    from autotuner.core.identification.relay_wave import RelayWaves

FLOOR = 1e-5
"""Level of a harmonic's error without noise, over the fundamental."""
CLIP = 6.0
GAIN_FLOOR = 1e-5
FINEST = 1.0 / 400.0
MOST_CYCLES = 3.0
"""Sample interval over the period, and whole cycles, beyond which a record is read as one of these: it is no worse."""


def features(wave: RelayWaves, r: FloatArray, gain_error: FloatArray, start: Starts) -> FloatArray:
    """Return the features, shape (B, F).

    Parameters
    ----------
    wave : RelayWaves
        The oscillations.
    r, gain_error : array of float, shape (B,)
        Static gain times `U1/A1`, and its relative standard error; 1 and 0 when integrating.
    start : Starts
        Start values of the structure.
    """
    interval, cycles = np.maximum(wave.interval, FINEST), np.minimum(wave.cycles, MOST_CYCLES)
    level = np.sqrt(wave.noise**2 + FLOOR**2 + interval**4)
    missed = start.missed[:, 1:] / level[:, None]
    lag = -np.angle(wave.y[:, 0]) % (2.0 * math.pi)
    T_df = np.sqrt(np.maximum((r / wave.peak) ** 2 - 1.0, 0.0))
    D_df = math.pi - np.arctan(T_df)
    columns = (
        start.values,
        np.stack((np.log(r), lag, np.log1p(T_df), D_df), axis=1),
        np.stack((np.log(wave.peak), wave.duty - 0.5), axis=1),
        np.log(np.abs(wave.y[:, 1:]) / (np.abs(wave.u[:, 1:]) + 0.05) + level[:, None]),
        np.log(np.stack((level, interval, cycles, gain_error + GAIN_FLOOR), axis=1)),
        np.stack((wave.hysteresis, np.log(start.misfit + level)), axis=1),
        np.clip(missed.real, -CLIP, CLIP),
        np.clip(missed.imag, -CLIP, CLIP),
    )
    return np.concatenate(columns, axis=1)
