"""Streaming detector of the limit cycle: switches, peaks, half periods, amplitudes and convergence.

    A  = (max pv - min pv) / 2                          over one period, peak
    A1 = |2/P int pv e^{-j w t} dt|,  w = 2 pi / P      over one period, fundamental

The peaks are read off a straight-sided fit near each extreme (`apex`), so that noise neither lifts nor rounds them.
The fundamental is taken on the band-passed PV and divided by the filter's own response at the oscillation, so that a
drift of the PV does not leak into it.

Rules of this file: one `step` a sample; memory is bounded by two periods of samples; a cycle is reported after EACH
half period, over the last full period. Between two switches a sample is only kept, which is a fraction of a
microsecond: filter and amplitudes wait for the switch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.signals.apex import apex
from autotuner.core.signals.bandpass import BandPass

if TYPE_CHECKING:
    from autotuner.core.arrays import FloatArray

RECENTRE_BEYOND = 0.1
"""Relative change of the period at which the band-pass is moved."""


@dataclass(frozen=True, slots=True)
class Cycle:
    """One full period, ended by the latest switch.

    Attributes
    ----------
    start_s, end_s : float
        Times of the two switches in the same direction, s.
    high_s : float
        Time spent at the high level, s.
    peak : float
        Zero-to-peak amplitude `A`, PV.
    fundamental : float
        Amplitude of the fundamental `A1`, PV.
    """

    start_s: float
    end_s: float
    high_s: float
    peak: float
    fundamental: float

    @property
    def period_s(self) -> float:
        """Length of the period, s."""
        return self.end_s - self.start_s

    @property
    def duty(self) -> float:
        """Share of the period spent at the high level."""
        return self.high_s / self.period_s


class Detector:
    """Feed it every sample of the relay phase; it answers with a cycle at each switch once a full period is seen.

    Attributes
    ----------
    cycles : list of Cycle
        The full periods so far.
    switch_times_s : list of float
        Times of the switches, s.
    longest_half_s : float
        Longest time between two of them, s; 0 before there are two.
    """

    def __init__(self) -> None:
        self.cycles: list[Cycle] = []
        self.switch_times_s: list[float] = []
        self.longest_half_s = 0.0
        self._t: list[float] = []
        self._pv: list[float] = []
        self._keep_t, self._keep_pv = self._t.append, self._pv.append
        self._filtered: list[float] = []
        self._switch_rows: list[int] = []
        self._is_high: bool | None = None
        self._filter: BandPass | None = None
        self._offset = 0.0

    @property
    def half_periods(self) -> int:
        """How many times between two switches have been seen."""
        return max(len(self.switch_times_s) - 1, 0)

    def step(self, t: float, pv: float, is_high: bool) -> Cycle | None:  # noqa: FBT001 - by name it costs a tenth more
        """Take one sample; `is_high` is the position of the relay from this sample on.

        Returns
        -------
        Cycle or None
            The last full period, when this sample switched the relay and two half periods lie behind it.
        """
        self._keep_t(t)
        self._keep_pv(pv)
        if is_high is self._is_high:
            return None
        was_high, self._is_high = self._is_high, is_high
        return None if was_high is None else self._switch(t, was_high=was_high)

    def _switch(self, t: float, *, was_high: bool) -> Cycle | None:
        if self.switch_times_s:
            self.longest_half_s = max(self.longest_half_s, t - self.switch_times_s[-1])
        self.switch_times_s.append(t)
        self._switch_rows.append(len(self._t) - 1)
        if len(self._switch_rows) < 3:
            return None
        cycle = self._measure(was_high=was_high)
        self.cycles.append(cycle)
        self._forget_before(self._switch_rows[1])
        return cycle

    def _catch_up(self, filter_: BandPass) -> None:
        """Filter what came since the switch before."""
        first = len(self._filtered)
        steps = [after - before for before, after in pairwise(self._t[first - 1 :])]
        self._filtered += filter_.run([pv - self._offset for pv in self._pv[first:]], steps)

    def _measure(self, *, was_high: bool) -> Cycle:
        start, middle, end = self.switch_times_s[-3:]
        rows = slice(self._switch_rows[0], None)
        t, pv = np.array(self._t[rows]), np.array(self._pv[rows])
        self._follow_period(end - start)
        interval_s = float(np.median(np.diff(t)))
        top, bottom = apex(t, pv, end - start, interval_s), -apex(t, -pv, end - start, interval_s)
        return Cycle(
            start_s=start,
            end_s=end,
            high_s=(end - middle) if was_high else (middle - start),
            peak=(top - bottom) / 2.0,
            fundamental=self._fundamental(t, np.array(self._filtered[rows]), end - start, interval_s),
        )

    def _follow_period(self, period_s: float) -> None:
        """Centre the band-pass; a new one runs over the samples at hand twice, so that its transient is behind it."""
        if self._filter is None:
            self._filter = BandPass(period_s)
            steps = np.diff(self._t, prepend=self._t[0] - np.diff(self._t[:2])).ravel().tolist()
            self._offset = float(np.mean(self._pv))
            deviations = [pv - self._offset for pv in self._pv]
            for _ in range(2):
                self._filtered = self._filter.run(deviations, steps)
            return
        self._catch_up(self._filter)
        if abs(period_s / self._filter.period_s - 1.0) > RECENTRE_BEYOND:
            self._filter.period_s = period_s

    def _fundamental(self, t: FloatArray, filtered: FloatArray, period_s: float, interval_s: float) -> float:
        assert self._filter is not None  # noqa: S101 - centred just before
        turns = np.exp(-2j * math.pi / period_s * t)
        gain = abs(self._filter.response_at(period_s, interval_s))
        return float(abs(np.trapezoid(filtered * turns, t))) * 2.0 / period_s / gain

    def _forget_before(self, row: int) -> None:
        for column in (self._t, self._pv, self._filtered):
            del column[:row]
        self._switch_rows = [kept - row for kept in self._switch_rows[1:]]
