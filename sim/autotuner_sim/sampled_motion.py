"""The free motion of thousands of plants between samples: where it is, and how long it is certain not to get far.

    z' = -z/T   or   z'' + 2 zeta z' + z = 0 (time in units of 1/w0),   z = y - L

`L` is where the PV is heading. Here all times are in samples; `v` is `z'` in units of `w0`, and 0 for a single lag.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from autotuner_sim.batch_motion import Creeping, Ringing

if TYPE_CHECKING:
    from autotuner_sim.batch import RelayTests
    from autotuner_sim.batch_motion import Free

Numbers = NDArray[np.float64]
Counts = NDArray[np.int64]
Rows = NDArray[np.intp]
Pair = tuple[Numbers, Numbers]

KNOT = ("begun", "level", "z", "v")
"""What is kept of each arrival: when, the level that arrived, and the state then, counted from that level."""
_SAFE = 1.0 - 1e-9
"""What rounding may take of a bound."""


class Motion(Protocol):
    """The free motion of plants of one kind."""

    def move(self, z: Numbers, v: Numbers, t: Numbers) -> Pair:
        """Return the state after a time."""

    def ahead(self, samples: int) -> Pair:
        """Return what `z` and `v` are multiplied with for the next samples, shape (N, samples)."""

    def before(self, z: Numbers, v: Numbers, way: Numbers, gap: Numbers) -> Numbers:
        """Return a time before which the PV has not gone farther than the gap, to the side `way`; infinite for ever."""

    def turns(self, z: Numbers, v: Numbers) -> tuple[Numbers, ...]:
        """Return when the PV turns first, and then; NaN for never."""

    def only(self, rows: Rows) -> Motion:
        """Return some of the plants."""

    def each(self) -> Motion:
        """Return the plants for states of shape (N, n)."""


class _Lag:
    """Single lags."""

    def __init__(self, rate: Numbers) -> None:
        self._rate = rate

    def move(self, z: Numbers, v: Numbers, t: Numbers) -> Pair:
        """Return the state after a time."""
        return z * np.exp(-self._rate * t), v

    def ahead(self, samples: int) -> Pair:
        """Return what `z` and `v` are multiplied with."""
        left = np.exp(-self._rate[:, None] * np.arange(samples))
        return left, np.zeros_like(left)

    def before(self, z: Numbers, v: Numbers, way: Numbers, gap: Numbers) -> Numbers:  # noqa: ARG002 - no slope
        """Return when it has gone that far."""
        level = z + way * gap
        time = np.log(z / level) / self._rate * _SAFE
        return np.where(gap <= 0.0, 0.0, np.where(way * level >= 0.0, math.inf, time))

    def turns(self, z: Numbers, v: Numbers) -> tuple[Numbers, ...]:  # noqa: ARG002 - none
        """Return nothing: a single lag turns at arrivals only."""
        return ()

    def only(self, rows: Rows) -> _Lag:
        """Return some of the plants."""
        return _Lag(self._rate[rows])

    def each(self) -> _Lag:
        """Return the plants for states of shape (N, n)."""
        return _Lag(self._rate[:, None])


class _Second:
    """Plants of second order."""

    def __init__(self, free: Free, step: Numbers) -> None:
        self._free, self._step = free, step

    def move(self, z: Numbers, v: Numbers, t: Numbers) -> Pair:
        """Return the state after a time."""
        c, o = self._free.motion(self._step * t)
        zeta_o = self._free.zeta * o
        return (c + zeta_o) * z + o * v, (c - zeta_o) * v - o * z

    def ahead(self, samples: int) -> Pair:
        """Return what `z` and `v` are multiplied with."""
        free = self._free.each()
        c, o = free.motion(self._step[:, None] * np.arange(samples))
        c += free.zeta * o
        return c, o

    def before(self, z: Numbers, v: Numbers, way: Numbers, gap: Numbers) -> Numbers:
        """Return when a parabola has gone that far that the PV never passes."""
        reach = np.sqrt(z * z + v * v)
        bend = (1.0 + 2.0 * self._free.zeta) * reach
        toward = way * v
        root = np.sqrt(toward * toward + 2.0 * bend * gap)
        time = np.where(toward > 0.0, 2.0 * gap / (toward + root), (root - toward) / bend)
        time *= _SAFE
        time /= self._step
        return np.where(gap > 0.0, np.where(gap + way * z >= reach, math.inf, time), 0.0)

    def turns(self, z: Numbers, v: Numbers) -> tuple[Numbers, ...]:
        """Return when the PV turns first, and then."""
        wait = self._free.turn(v / (self._free.zeta * v + z))
        wait = np.where(wait < 0.0, wait + self._free.again, wait)
        return wait / self._step, (wait + self._free.again) / self._step

    def only(self, rows: Rows) -> _Second:
        """Return some of the plants."""
        return _Second(self._free.only(rows), self._step[rows])

    def each(self) -> _Second:
        """Return the plants for states of shape (N, n)."""
        return _Second(self._free.each(), self._step[:, None])


def motion_of(tests: RelayTests, sample_time_s: float) -> Motion:
    """Return the motion of plants, all of first order, or all of second with real poles, or with complex ones."""
    if not tests.m.any():
        return _Lag(sample_time_s / tests.n)
    w0 = 1.0 / np.sqrt(tests.m)
    zeta = 0.5 * tests.n * w0
    return _Second((Ringing if zeta[0] < 1.0 else Creeping)(zeta), sample_time_s * w0)


def peaks(motion: Motion, taken: Counts, knots: Numbers) -> Numbers:
    """Return half the range of the PV over the last full period, shape (N,); NaN where a switch is missing.

    Parameters
    ----------
    motion : Motion
        The plants.
    taken : array of int, shape (N, n)
        Samples of the switches, -1 for none.
    knots : array of float, shape (4, N, k)
        What is kept of the arrivals (`KNOT`); NaN for none.
    """
    begun, level, z, v = knots
    first, last = (taken[:, k, None].astype(np.float64) for k in (-3, -1))
    until = np.fmin(np.append(begun[:, 1:], np.full_like(last, math.nan), axis=1), last)
    start, end = np.maximum(first - begun, 0.0), until - begun
    plants = motion.each()
    within = [np.where((start < t) & (t < end), t, start) for t in plants.turns(z, v)]
    pv = np.array([plants.move(z, v, t)[0] + level for t in (start, end, *within)])
    pv[:, ~(start < end)] = math.nan
    highest, lowest = np.fmax.reduce(pv, axis=(0, 2)), np.fmin.reduce(pv, axis=(0, 2))
    return np.where(taken[:, -1] < 0, math.nan, (highest - lowest) / 2.0)
