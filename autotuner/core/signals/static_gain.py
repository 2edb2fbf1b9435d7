"""The static gain of a process from one recording, without a model.

    asymmetric relay   K = (mean pv over whole cycles - pv at rest) / (mean output over them - output at rest)

Over whole cycles of a steady oscillation every harmonic drops out of both means, and the remainder is the response to a
constant, that is, the static gain (Shen, Wu and Yu, AIChE J. 42, 1996). The rest is the part before the first change
of the output. `K` PV/output.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.signals.noise import noise_sigma, resolution
from autotuner.core.signals.quiet import measure_quiet

if TYPE_CHECKING:
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.recording import Recording
    from autotuner.core.signals.limit_cycle import LimitCycle

SMALLEST_MOVE = 0.05
"""Smallest distance of the mean output from rest, in relay amplitudes, that shows a gain."""
FEWEST_AT_REST = 8
"""Samples before the first change of the output from which a rest can be determined."""
RESTLESS = 3.0
"""Spread of a PV over its noise, measured between neighbours, beyond which it moves: there and back, for example."""
ROUNDING = 1e-9
"""Spread, as a share of the PV, that is arithmetic."""


@dataclass(frozen=True, slots=True)
class StaticGain:
    """A static gain with its standard error, PV/output."""

    K: float
    standard_error: float


def gain_from_cycles(recording: Recording, cycle: LimitCycle) -> StaticGain | None:
    """Return the gain from an asymmetric relay; None without a rest before it, or when it is symmetric about the rest.

    The standard error is that of the noise; a drift of the PV adds to it.
    """
    quiet = rest_rows(recording.output)
    if not stands_still(recording.t[: quiet + 1], recording.pv[: quiet + 1]):
        return None
    whole = (recording.t >= cycle.start_s) & (recording.t <= cycle.end_s)
    t, pv, output = recording.t[whole], recording.pv[whole], recording.output[whole]
    span = float(t[-1] - t[0])
    mean_output_move = float(output[:-1] @ np.diff(t)) / span - float(recording.output[0])
    if abs(mean_output_move) < SMALLEST_MOVE * cycle.h:
        return None
    rest = float(recording.pv[: quiet + 1].mean())
    response = float(np.trapezoid(pv, t)) / span - rest
    if response == 0.0:
        return None
    sigma = noise_sigma(recording.pv)
    error = sigma * math.sqrt(1.0 / (quiet + 1) + 1.0 / t.size)
    return StaticGain(response / mean_output_move, error / abs(mean_output_move))


def rest_rows(output: FloatArray) -> int:
    """Return the index of the last sample before the first change of the output; 0 without a change."""
    changes = np.flatnonzero(np.diff(output))
    return int(changes[0]) if changes.size else 0


def stands_still(t: FloatArray, pv: FloatArray) -> bool:
    """Return whether a PV is at rest within its noise; that needs `FEWEST_AT_REST` samples."""
    if t.size < FEWEST_AT_REST or measure_quiet(t, pv).drifts:
        return False
    arithmetic = ROUNDING * float(np.abs(pv).max())
    return float(pv.std()) <= max(RESTLESS * max(noise_sigma(pv), resolution(pv)), arithmetic)
