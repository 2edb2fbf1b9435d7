"""Streaming detector of the limit cycle: switches, peaks, half periods, amplitudes and convergence.

    A  = (max pv - min pv) / 2                          over one period, peak
    A1 = |2/P int pv e^{-j w t} dt|,  w = 2 pi / P      over one period, fundamental

The peaks are read off a straight-sided fit near each extreme (`apex`), so that noise neither lifts nor rounds them.
The fundamental is taken on the band-passed PV and divided by the filter's own response at the oscillation. A drift
that moves the mean of a period by a quarter of the swing or more is taken out first.

Invariants: one `step` a sample; memory is bounded by two periods of samples; a cycle is reported after EACH
half period, over the last full period. Between two switches a sample is only kept, which is a fraction of a
microsecond: filter and amplitudes wait for the switch. The measurement of a recording (`limit_cycle`) is this one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.signals.apex import apex
from autotuner.core.signals.bandpass import BandPass

if TYPE_CHECKING:
    from autotuner.core.model.arrays import FloatArray

PASSES = 4
"""Times the band-pass runs over a period: its transient falls to about a hundredth in each."""
DRIFTS = 0.25
"""Drift in a period, over the swing of the PV, that is taken out; less may be the relay's own unequal half periods."""
BACK = 2
"""Cycles between two means for the drift: a cycle is reported in each half period, so these do not overlap."""


@dataclass(frozen=True, slots=True)
class Cycle:
    """One full period, at its last switch.

    Attributes
    ----------
    start_s, end_s : float
        Times of the two switches in the same direction, s.
    high_s : float
        Time spent at the high level, s.
    top, bottom : float
        Extremes of the PV.
    phasor : complex
        Fundamental of the PV after the band-pass, gain and phase of which are divided out; the phase is that at
        `start_s`.
    """

    start_s: float
    end_s: float
    high_s: float
    top: float
    bottom: float
    phasor: complex

    @property
    def period_s(self) -> float:
        """Length of the period, s."""
        return self.end_s - self.start_s

    @property
    def peak(self) -> float:
        """Zero-to-peak amplitude `A`, PV."""
        return (self.top - self.bottom) / 2.0

    @property
    def fundamental(self) -> float:
        """Amplitude of the fundamental `A1`, PV."""
        return abs(self.phasor)

    @property
    def duty(self) -> float:
        """Share of the period spent at the high level."""
        return self.high_s / self.period_s


class Detector:
    """Feed it every sample of the relay phase; it answers with a cycle at each switch once a full period is seen.

    Attributes
    ----------
    cycles : list of Cycle
        Full periods so far.
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
        self._switch_rows: list[int] = []
        self._is_high: bool | None = None
        self._means: list[tuple[float, float]] = []

    @property
    def half_periods(self) -> int:
        """Number of complete half periods."""
        return max(len(self.switch_times_s) - 1, 0)

    def step(self, t: float, pv: float, is_high: bool) -> Cycle | None:  # noqa: FBT001 - by name it costs a tenth more
        """Take one sample; `is_high` is the position of the relay from this sample on.

        Returns
        -------
        Cycle or None
            The last full period, when this sample switched the relay and two half periods are complete.
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

    def _measure(self, *, was_high: bool) -> Cycle:
        start, middle, end = self.switch_times_s[-3:]
        rows = slice(self._switch_rows[0], None)
        t, pv = np.array(self._t[rows]), np.array(self._pv[rows])
        interval_s = float(np.median(np.diff(t)))
        return Cycle(
            start_s=start,
            end_s=end,
            high_s=(end - middle) if was_high else (middle - start),
            top=apex(t, pv, end - start, interval_s),
            bottom=-apex(t, -pv, end - start, interval_s),
            phasor=self._fundamental(t, pv, end - start, interval_s),
        )

    def _fundamental(self, t: FloatArray, pv: FloatArray, period_s: float, interval_s: float) -> complex:
        """Return the fundamental of one period after the band-pass.

        The filter runs over the period repeatedly until its transient has decayed. Its output is then that of a
        periodic signal, without any influence of the rest before the relay or of an earlier, different period.
        """
        drift_per_s = self._drift_per_s(t, pv)
        drifts = abs(drift_per_s) * period_s > DRIFTS * float(np.ptp(pv))
        level = pv - drift_per_s * (t - t.mean()) if drifts else pv
        deviations = (level - level.mean())[1:].tolist()
        steps = np.diff(t).tolist()
        band_pass = BandPass(period_s)
        filtered = [band_pass.run(deviations, steps) for _ in range(PASSES)][-1]
        turns = np.exp(-2j * math.pi / period_s * (t - t[0]))
        wave = np.array([filtered[-1], *filtered])
        response = band_pass.response_at(period_s, interval_s)
        return complex(np.trapezoid(wave * turns, t)) * 2.0 / period_s / response

    def _drift_per_s(self, t: FloatArray, pv: FloatArray) -> float:
        """Return the slope from the mean of a period to that of the next, PV/s; 0 before there are two."""
        middle, mean = (t[0] + t[-1]) / 2.0, float(np.trapezoid(pv, t)) / (t[-1] - t[0])
        self._means.append((middle, mean))
        if len(self._means) <= BACK:
            return 0.0
        earlier, before = self._means[-1 - BACK]
        return float((mean - before) / (middle - earlier))

    def _forget_before(self, row: int) -> None:
        for column in (self._t, self._pv):
            del column[:row]
        self._switch_rows = [kept - row for kept in self._switch_rows[1:]]
