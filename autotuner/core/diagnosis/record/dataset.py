"""A prepared recording: fitted samples, held-out samples, noise.

The part that is never fitted is the tail of a tuning's experiment, else the last quarter of the record. Spikes that
stand alone do not count.

    noise from second differences, and from the standard deviation of the PV at rest about a straight line
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.record.budget import UNLIMITED, Budget
from autotuner.core.diagnosis.record.sensor import visible_jumps
from autotuner.core.estimation.data import Data
from autotuner.core.model.arrays import SMALLEST_DIVISOR
from autotuner.core.model.zoh_input import held_input, smooth_input
from autotuner.core.signals.noise import noise_sigma

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.identification.controller_inverse import Controller
    from autotuner.core.model.arrays import BoolArray, FloatArray
    from autotuner.core.model.zoh_input import HeldInput
    from autotuner.core.recording import Recording

HELD_OUT_SHARE = 0.25
"""Share of a record without a tail that is not fitted."""
FLOOR = 1e-3
"""Misfit that counts as zero, as a share of the PV's standard deviation: no real plant is modelled better."""
FEWEST_AT_REST = 20
"""Samples at rest from which their deviation is accepted."""
AT_REST = 10
"""Samples before the first move from which a record is taken to begin at rest."""
COLOURED = 6.0
"""Most that the deviation at rest may count for, in noise of second differences."""
SWINGS = 0.75
"""Share of the motion at rest that one sine makes from which the PV swings there."""
STILL = 0.05
"""Motion before the first move over that of the whole record from which it does not begin at rest."""
OFTEN = 0.3
"""Share of the samples at which the output changes from which a controller moves it."""
AT_REST_FIRST, COLD = "at rest", "cold"
"""How a record may begin, beside from any state (see `Dataset.begins`)."""
AT_THE_END, IN_A_ROW = 0.005, 4
"""Share of a record that lies exactly at its highest or lowest PV, and how many of it in a row, where a range ends."""


@dataclass(frozen=True, slots=True, eq=False)
class Dataset:
    """A prepared recording.

    Attributes
    ----------
    data : Data
        All samples; weight 0 for a spike.
    fitted, held_out : array of bool, shape (N,)
        The two parts, spikes left out of both.
    extra : mapping of str to array of float
        Measured disturbances.
    spikes : array of bool, shape (N,)
        Samples that are not measurements.
    noise : float
        Standard deviation of the noise, PV.
    floor : float
        Misfit that counts as none, PV.
    output0, pv0 : float
        What `data` is a deviation from: first output and median of the PV.
    checked : bool
        Whether the record has the small moves of a tuning's check.
    tuned : bool
        Whether it is a tuning's own record.
    at_rest : int
        Samples before the output first moves.
    grid_noise : float
        Standard deviation of the error of a coarse sensor, PV.
    restarts_s : tuple of float
        Times at which the process begins from the state that it had at the first of them, s from the start.
    smooth : bool
        Whether the output is taken to move smoothly between its samples; otherwise each sample is held.
    begins : str
        How the record is taken to begin where that does not show: from any state (empty), ``at rest``, or ``cold``, at
        rest at an output of zero that ended as the record began.
    span_s : float
        Length of the recording that was searched, s: the unit of times in effects.
    bottom, top : float
        Ends of the sensor's range as deviation from `pv0`; a PV at one of them is there or beyond.
    budget : Budget
        How long the search may take.
    controller : Controller or None
        The controller that moves the output, where the record shows one.
    """

    data: Data
    fitted: BoolArray
    held_out: BoolArray
    extra: Mapping[str, FloatArray]
    spikes: BoolArray
    noise: float
    floor: float
    output0: float
    pv0: float
    checked: bool
    tuned: bool
    at_rest: int
    span_s: float
    grid_noise: float = 0.0
    restarts_s: tuple[float, ...] = (0.0,)
    bottom: float = -math.inf
    top: float = math.inf
    smooth: bool = False
    budget: Budget = UNLIMITED
    begins: str = ""
    controller: Controller | None = None

    @property
    def settled_first(self) -> bool:
        """Whether the record begins at rest."""
        return bool(self.begins) or self._rests_at_first

    @property
    def _rests_at_first(self) -> bool:
        if self.tuned or self.at_rest < AT_REST:
            return self.tuned
        pv = self.data.pv[: self.at_rest]
        moves = float(np.std(np.delete(pv, np.argmax(np.abs(pv - np.median(pv))))))  # one reading may be wild
        return moves < STILL * float(np.std(self.data.pv)) or moves < 3.0 * noise_sigma(pv)

    @property
    def in_loop(self) -> bool:
        """Whether a controller moves the output: at many samples, and not a tuning's experiment."""
        return not self.tuned and self.data.held.times.size > OFTEN * self.data.t.size

    @property
    def visible_jumps(self) -> list[tuple[float, float]]:
        """Times, s from the start, and sizes, PV, of possible jumps of the reading in the fitted part."""
        return visible_jumps(self.data.t[self.fitted], self.data.pv[self.fitted], self.floor)

    @property
    def finest_s(self) -> float:
        """Shortest step in which a motion between samples is written, s: half of one, as no PV is read between."""
        return self.data.interval_s / 2.0

    @property
    def swing(self) -> float:
        """Range of the output, output units."""
        return float(np.ptp(self.data.held.levels))

    @property
    def fitted_until_s(self) -> float:
        """Time of the last fitted sample, s from the start."""
        return float(self.data.t[self.fitted][-1])


def dataset_of(
    recording: Recording,
    left_out: BoolArray | None = None,
    grid_noise: float = 0.0,
    tail_share: float = 0.0,
    *,
    smooth: bool = False,
    begins: str = "",
) -> Dataset:
    """Make a recording ready.

    Parameters
    ----------
    recording : Recording
        Output and PV.
    left_out : array of bool, shape (N,), optional
        Samples that are no measurements.
    grid_noise : float
        Standard deviation of the error of a coarse sensor, PV.
    tail_share : float
        Share of the part that is otherwise not fitted that is, from its beginning.
    smooth : bool
        Whether the output moves smoothly between its samples.
    begins : str
        How the record is taken to begin.
    """
    t = recording.t - recording.t[0]
    middle = float(np.median(recording.pv))
    held = input_of(recording, smooth=smooth, begins=begins)
    raw = np.array(recording.pv)
    spikes = np.zeros(t.size, dtype=np.bool_) if left_out is None else left_out
    data = Data(t, raw - middle, held, np.where(spikes, 0.0, 1.0))
    until_s = _fitted_until(recording, t)
    early = t <= until_s + tail_share * (float(t[-1]) - until_s)
    at_rest = int(np.searchsorted(t, held.times[1])) if held.times.size > 1 else t.size
    floor = FLOOR * float(np.std(recording.pv))
    named = recording.segments
    bottom, top = (-math.inf, math.inf) if "staircase" in named else _range_of(raw)
    inside = (raw > bottom) & (raw < top)
    return Dataset(
        data,
        early & ~spikes & inside,
        ~early & ~spikes,
        dict(recording.extra),
        spikes,
        _noise(t, raw, spikes, at_rest),
        floor,
        0.0 if begins == COLD else float(recording.output[0]),
        middle,
        "staircase" in named,
        bool(set(named) - {"tail"}),
        at_rest,
        data.span_s,
        grid_noise,
        _restarts(recording),
        bottom - middle,
        top - middle,
        smooth,
        begins=begins,
    )


def input_of(recording: Recording, *, smooth: bool, begins: str) -> HeldInput:
    """Return the output of a recording, held or smooth between its samples, as deviation from its start.

    One that begins cold is a deviation from zero: its first level is a step.
    """
    held = (smooth_input if smooth else held_input)(recording.acts_s - recording.t[0], recording.output)
    return replace(held, levels=held.levels + recording.output[0]) if begins == COLD else held


def _restarts(recording: Recording) -> tuple[float, ...]:
    restarts_s = recording.settings.get("restarts_s")
    given = restarts_s if isinstance(restarts_s, list | tuple) else ()
    return (0.0, *(float(at) - float(recording.t[0]) for at in given))


def _range_of(pv: FloatArray) -> tuple[float, float]:
    """Return the ends of the sensor's range where the PV rests at them; infinite ones where it does not."""
    ends = []
    for end in (float(pv.min()), float(pv.max())):
        at = pv == end
        runs = np.diff(np.flatnonzero(np.diff(np.concatenate(([0], at.astype(int), [0])))))[::2]
        ends.append(end if at.mean() > AT_THE_END and runs.max() >= IN_A_ROW else None)
    coarse = np.unique(pv).size < pv.size / 5
    low, high = (None, None) if coarse else ends
    return -math.inf if low is None else low, math.inf if high is None else high


def _fitted_until(recording: Recording, t: FloatArray) -> float:
    tail = recording.segments.get("tail")
    if isinstance(tail, int | float) and math.isfinite(tail):
        until = float(tail) - float(recording.t[0])
        if t[5] < until < t[-5]:
            return until
    return float(t[-1] * (1.0 - HELD_OUT_SHARE))


def _noise(t: FloatArray, pv: FloatArray, spikes: BoolArray, at_rest: int) -> float:
    sigma = noise_sigma(pv[~spikes])
    rows = np.flatnonzero(~spikes[:at_rest])
    if rows.size < FEWEST_AT_REST:
        return sigma
    line = np.polyfit(t[rows], pv[rows], 1)
    return noise_at_rest(sigma, pv[rows] - np.polyval(line, t[rows]))


def noise_at_rest(sigma: float, resting: FloatArray) -> float:
    """Return the noise from that of second differences and the samples at rest, PV, without oscillations."""
    rest = float(np.std(resting, ddof=1))
    return sigma if rest > sigma and _of_a_wave(resting) > SWINGS else one_noise(sigma, rest)


def one_noise(sigma: float, rest: float) -> float:
    """Return the noise from its two measures, PV: that of second differences, and the deviation at rest.

    At rest coloured noise deviates by more than its differences suggest, a disturbance by far more, which is not noise.
    """
    return min(rest, COLOURED * sigma) if rest > sigma else min(sigma, 3.0 * rest)


def _of_a_wave(resting: FloatArray) -> float:
    """Return the share of the squares that the best sine explains."""
    t = np.arange(resting.size) / resting.size
    waves = np.linspace(0.5, resting.size / 4.0, 2 * resting.size)[:, None] * 2.0 * math.pi * t
    left = resting - resting.mean()
    c, s = np.cos(waves), np.sin(waves)
    c, s = c - c.mean(axis=1, keepdims=True), s - s.mean(axis=1, keepdims=True)
    cc, ss, cs = (np.einsum("ij,ij->i", a, b) for a, b in ((c, c), (s, s), (c, s)))
    bc, bs = c @ left, s @ left
    explained = (ss * bc**2 - 2.0 * cs * bc * bs + cc * bs**2) / np.maximum(cc * ss - cs**2, 1e-12)
    return float(explained.max()) / max(float(left @ left), SMALLEST_DIVISOR)
