"""The static gain of a process from one recording, without a model.

    asymmetric relay   K = (mean pv over whole cycles - pv at rest) / (mean output over them - output at rest)
    step               K = (pv settled after - pv before) / (output after - output before)

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
SETTLED_PART = 0.2
"""Last part of a step's record that has to be flat."""
SETTLED_WITHIN = 0.02
"""Largest move over that part, as a share of the answer, of a settled PV."""


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


def gain_from_step(recording: Recording) -> StaticGain | None:
    """Return the gain of the last step of the output, or None without a step or a settled PV."""
    changes = np.flatnonzero(np.diff(recording.output)) + 1
    if not changes.size:
        return None
    row = int(changes[-1])
    before = int(changes[-2]) if changes.size > 1 else 0
    earlier, later = _settled(recording.pv[before : row + 1]), _settled(recording.pv[row:])
    if earlier is None or later is None:
        return None
    step = float(recording.output[row] - recording.output[row - 1])
    (low, low_error, low_move), (high, high_error, high_move) = earlier, later
    response, error = high - low, math.hypot(low_error, high_error)
    if max(low_move, high_move) > max(SETTLED_WITHIN * abs(response), 3.0 * error) or abs(response) <= 3.0 * error:
        return None
    return StaticGain(response / step, error / abs(step))


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


def _settled(pv: FloatArray) -> tuple[float, float, float] | None:
    """Return mean, standard error and travel over the last part of a stretch, or None when it is too short."""
    tail = pv[-max(3, round(SETTLED_PART * pv.size)) :]
    if tail.size < 3:
        return None
    half = tail.size // 2
    travel = 2.0 * abs(float(tail[half:].mean() - tail[:half].mean()))
    return float(tail.mean()), max(noise_sigma(tail), float(tail.std()) / 2.0) / math.sqrt(tail.size), travel
