"""The limit cycle in a recording: found by its switches, measured by the streaming detector.

    Pu  = time from a switch to the same switch `c` cycles later, over c
    A   = (max pv - min pv)/2 of each cycle, averaged
    A1  = |mean of Y1|,   Y1 the fundamental of each cycle after the band-pass, which is divided out
    U1  = |mean of 2/P int u e^{-j w t} dt|,   w = 2 pi/P      (exact: the output is constant between switches)

over `c` whole cycles. (Astrom and Hagglund, Automatica 20, 1984.) A recording is replayed through the same detector and
band-pass that watch a running experiment, so a file and a live tuning have one measurement.

Invariants:

1. A recording counts as a relay test when its output alternates between two levels and its last cycles repeat.
2. The transient does not count: cycles are taken from the end backward as long as they repeat.
3. Switches are read off the recorded output, so they are exact; the PV at a switch is extrapolated from the samples
   before it, because the sample that made the relay switch was picked by its noise.
4. Amplitudes are the detector's; nothing here measures the PV of a cycle a second time.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, field, fields
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.jsonable import jsonable
from autotuner.core.signals.detector import Detector

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.model.arrays import FloatArray, IntArray
    from autotuner.core.recording import Recording
    from autotuner.core.signals.detector import Cycle

SAME = 0.12
"""Relative difference of half periods within which the last cycle repeats; two samples are always granted."""
FEW, SAME_AS_FEW, SAME_AS_MANY = 3, 0.08, 0.04
"""The same for the cycles before it: while there are few to compare with, and at least."""
SCATTER = 3.0
"""Standard deviations of the later half periods within which earlier ones still belong to them."""
FEWEST_SWITCHES = 4
"""Fewest switches of a limit cycle: a period and a half, so that each half period is complete once."""
STEADY_SHARE = 0.3
"""Part of all switches that has to repeat: in a random binary sequence a few do by chance."""
CHATTER = 0.1
"""Half period, over a long one, that only noise makes."""
APPROACH = 0.02
"""Part of a period before a switch that its PV is extrapolated from."""
FEWEST_SAMPLES = 6
"""Samples of a cycle under which no amplitude can be read."""


@dataclass(frozen=True, slots=True)
class LimitCycle:
    """The steady oscillation under a relay, measured over whole cycles.

    Attributes
    ----------
    Pu : float
        Period, s.
    A, A1 : float
        PV amplitude, zero to peak: of the wave itself, and of its fundamental.
    h, bias : float
        Half the relay's swing and its centre, output units.
    relay_fundamental : float
        Amplitude of the relay wave's fundamental, output units; `4 h/pi` when the half periods are equal.
    hysteresis : float
        Half the distance of the PV at the two switches, PV units: the effective hysteresis, sampling included.
    high_s, low_s : float
        Half periods at the upper and at the lower output level, s.
    lowest, highest : float
        Extremes of the PV.
    pv_at_rise, pv_at_fall : float
        PV at the moments at which the output turned high, and low.
    cycles : int
        Whole cycles averaged.
    lag_rad : float
        Phase by which the PV's fundamental lags that of the output, 0 to 2 pi.
    start_s, end_s : float
        Times of the switches between which they lie, s.
    relative_error : mapping of str to float
        Relative standard errors of `Pu`, `A`, `A1` over the cycles; empty when there are too few.
    alone : bool
        Whether the relay drove the output alone; in parallel with a controller its gain is not the ultimate gain.
    """

    Pu: float
    A: float
    A1: float
    h: float
    bias: float
    relay_fundamental: float
    hysteresis: float
    high_s: float
    low_s: float
    lowest: float
    highest: float
    pv_at_rise: float
    pv_at_fall: float
    cycles: int
    lag_rad: float = math.nan
    start_s: float = math.nan
    end_s: float = math.nan
    relative_error: Mapping[str, float] = field(default_factory=dict)
    alone: bool = True

    @property
    def Ku(self) -> float:
        """Ultimate gain from the peak, `4 h/(pi A)` (thesis eq. 3.3), output/PV; NaN with a parallel controller."""
        return 4.0 * self.h / (math.pi * self.A) if self.alone else math.nan

    @property
    def Ku_fundamental(self) -> float:
        """Ratio of the fundamentals: exactly `1/|G(jw)|` at the period, output/PV; NaN with a parallel controller."""
        return self.relay_fundamental / self.A1 if self.alone else math.nan

    @property
    def duty(self) -> float:
        """Share of the period at the upper level."""
        return self.high_s / self.Pu

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        names = [f.name for f in fields(self)] + ["Ku", "Ku_fundamental", "duty"]
        return {name: jsonable(getattr(self, name)) for name in names}


def measure_limit_cycle(recording: Recording) -> LimitCycle | None:
    """Return the limit cycle at the end of a recording, or None for a recording without a relay test.

    Parameters
    ----------
    recording : Recording
        Any recording; a rest before the relay and a rest after it are skipped.
    """
    recording = _under_the_last_relay(recording)
    switches_seen = without_chatter(recording.t, relay_switches(recording.output))
    switches = _repeating(recording.t, switches_seen)
    if switches.size < 3 or int(np.diff(switches[::2]).min()) + 1 < FEWEST_SAMPLES:
        return None
    t, pv, output = recording.t, recording.pv, recording.output
    cycles = replayed(t, pv, output, switches_seen)[-(switches.size // 2) * 2 + 1 :: 2]
    driving = driving_fundamental(recording, switches)
    phasors = np.array([cycle.phasor for cycle in cycles])
    fundamental = phasors.mean()
    if fundamental == 0.0 or driving == 0.0:
        return None
    tops, bottoms = (np.array([getattr(cycle, name) for cycle in cycles]) for name in ("top", "bottom"))
    first_is_rise = bool(output[switches[0]] > output[switches[0] - 1])
    periods = np.array([cycle.period_s for cycle in cycles])
    highs = np.array([cycle.high_s for cycle in cycles])
    Pu = float(periods.mean())
    at_switch = np.array([_pv_before(t, pv, int(row), APPROACH * Pu) for row in switches])
    rises, falls = (at_switch[0::2], at_switch[1::2]) if first_is_rise else (at_switch[1::2], at_switch[0::2])
    whole = output[int(switches[0]) : int(switches[-1]) + 1]
    low, high = float(whole.min()), float(whole.max())
    peaks = (tops - bottoms) / 2.0
    return LimitCycle(
        Pu=Pu,
        A=float(peaks.mean()),
        A1=abs(complex(fundamental)),
        h=(high - low) / 2.0,
        bias=(high + low) / 2.0,
        relay_fundamental=abs(driving),
        hysteresis=abs(float(falls.mean() - rises.mean())) / 2.0,
        high_s=float(highs.mean()),
        low_s=float((periods - highs).mean()),
        lowest=float(bottoms.mean()),
        highest=float(tops.mean()),
        pv_at_rise=float(rises.mean()),
        pv_at_fall=float(falls.mean()),
        cycles=len(cycles),
        lag_rad=-cmath.phase(complex(fundamental / driving)) % (2.0 * math.pi),
        start_s=float(t[switches[0]]),
        end_s=float(t[switches[-1]]),
        relative_error=_scatter(Pu=periods, A=peaks, A1=np.abs(phasors)),
    )


def driving_fundamental(recording: Recording, switches: IntArray) -> complex:
    """Return the fundamental of the output, the mean over the whole cycles that the switches bound."""
    t, output = recording.t, recording.output
    cycles = pairwise(switches[::2].tolist())
    return complex(np.mean([_held_fourier(t[a : b + 1], output[a : b + 1], float(t[b] - t[a])) for a, b in cycles]))


def replayed(t: FloatArray, pv: FloatArray, output: FloatArray, switches: IntArray) -> list[Cycle]:
    """Return the cycles that the streaming detector reports: one for each switch from the third on.

    Parameters
    ----------
    t, pv, output : array of float, shape (N,)
        Samples, s, PV and output units.
    switches : array of int, shape (S,)
        Rows at which the relay switched.
    """
    first = int(switches[0]) - 1
    positions = np.zeros(t.size, dtype=np.bool_)
    is_high = bool(output[switches[0]] < output[first])
    for begin, end in pairwise((first, *switches.tolist(), t.size)):
        positions[begin:end] = is_high
        is_high = not is_high
    detector = Detector()
    rows = slice(first, int(switches[-1]) + 1)
    for sample in zip(t[rows].tolist(), pv[rows].tolist(), positions[rows].tolist(), strict=True):
        detector.step(*sample)
    return detector.cycles


def _under_the_last_relay(recording: Recording) -> Recording:
    """Return the part since the relay's bias or amplitude was last adjusted, where the settings have the time."""
    since_s = recording.settings.get("relay_since_s")
    if not isinstance(since_s, float) or int((recording.t >= since_s).sum()) < FEWEST_SAMPLES:
        return recording
    started_s = recording.segments.get("relay", since_s)
    return recording.window(since_s, float(recording.t[-1])) if since_s > started_s else recording


def relay_switches(output: FloatArray, fewest: int = FEWEST_SWITCHES) -> IntArray:
    """Return the rows at which the output switches in its longest stretch that alternates between two levels.

    None where there are fewer switches than `fewest`.
    The first row of the stretch, where the relay was switched on, is a switch only if the other level was before it.
    """
    rows = np.flatnonzero(np.diff(output)) + 1
    levels = output[np.concatenate(([0], rows))]
    # A held level continues the alternation when it is the level before the last one.
    goes_on = np.concatenate(([False, False], levels[2:] == levels[:-2]))
    longest, start = (0, 0), 0
    for i in range(1, levels.size):
        if not goes_on[i]:
            start = i - 1
        longest = max(longest, (i - start, start))
    count, start = longest
    if count < fewest:
        return np.zeros(0, dtype=np.int64)
    return rows[start : start + count]


def without_chatter(t: FloatArray, switches: IntArray) -> IntArray:
    """Return the switches without those that noise made: pairs between which the relay was hardly away."""
    while switches.size > 2:
        halves = np.diff(t[switches])
        shortest = int(np.argmin(halves))
        if halves[shortest] >= CHATTER * float(np.quantile(halves, 0.75)):
            break
        switches = np.delete(switches, (shortest, shortest + 1))
    return switches


def _repeating(t: FloatArray, switches: IntArray) -> IntArray:
    """Return the latest switches that bound whole cycles which repeat; empty when not even the last two halves do."""
    if switches.size < FEWEST_SWITCHES:
        return switches[:0]
    halves = np.diff(t[switches])
    grant = 2.0 * float(np.median(np.diff(t)))
    keep = 2
    while keep + 2 <= halves.size and _belongs(halves[-keep - 2 : halves.size - keep], halves[-keep:], grant):
        keep += 2
    # With a single cycle left, the half period before it has to repeat too: otherwise nothing shows that it is steady.
    if keep == 2 and (halves.size < 3 or abs(halves[-3] - halves[-1]) > SAME * halves[-1] + grant):
        return switches[:0]
    return switches[-keep - 1 :] if keep + 1 >= STEADY_SHARE * switches.size else switches[:0]


def _belongs(earlier: FloatArray, later: FloatArray, grant: float) -> bool:
    """Return whether two half periods are like the later ones of their kind, up to the scatter of those."""
    kinds = later.reshape(-1, 2)
    usual = kinds.mean(axis=0)
    if kinds.shape[0] < FEW:
        scatter = SAME_AS_FEW * usual
    else:
        scatter = np.maximum(SAME_AS_MANY * usual, SCATTER * kinds.std(axis=0, ddof=1))
    return bool(np.all(np.abs(earlier - usual) <= scatter + grant))


def _held_fourier(t: FloatArray, output: FloatArray, period_s: float) -> complex:
    """Return the fundamental of an output that is held from each sample to the next, exactly."""
    turns = np.exp(-2j * math.pi / period_s * (t - t[0]))
    return complex(output[:-1] @ np.diff(turns)) * 1j / math.pi * period_s / float(t[-1] - t[0])


def _pv_before(t: FloatArray, pv: FloatArray, row: int, span_s: float) -> float:
    """Return the PV at a switch: a straight line through the samples before it, or the sample when there are few."""
    first = max(min(int(np.searchsorted(t, t[row] - span_s)), row - 3), 0)
    if row - first < 3:
        return float(pv[row])
    _slope, offset = np.polyfit(t[first:row] - t[row], pv[first:row], 1)
    return float(offset)


def _scatter(**values: FloatArray) -> dict[str, float]:
    """Return the relative standard error of the mean of each, where there are two cycles at least."""
    return {name: float(v.std(ddof=1) / math.sqrt(v.size) / abs(v.mean())) for name, v in values.items() if v.size > 1}
