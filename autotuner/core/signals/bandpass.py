"""Denoising: a streaming band-pass filter, centred on the running period.

    H(s) = (s/w0)/Q / ((s/w0)^2 + (s/w0)/Q + 1),   twice in a row

discretised by the trapezoidal rule, prewarped at `w0`: with `g = tan(w0 dt/2)`,

    H(w) = (k z)/(z^2 + k z + 1),   z = j tan(w dt/2)/g,   k = 1/Q

`w0` rad/s centre, `dt` s sample interval, `Q` quality. Gain 1 and phase 0 at `w0`; anywhere else gain and phase are
known exactly (`response_at`) and are divided out. Each section is a pair of trapezoidal integrators (Zavalishin, The
Art of VA Filter Design, 2018, ch. 3), whose state stays valid when `w0` or `dt` change between samples, so the centre
can follow the period and the samples need not be equally spaced.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

QUALITY = 0.7
"""Wide enough to settle in about one period, narrow enough to halve the third harmonic twice."""
SECTIONS = 2
"""Second-order sections in series; the order of the filter is twice that."""
EVEN = 0.01
"""Jitter of the steps, as a share, that no reading shows: it moves the phase of a sample by a hundredth of `w0 dt`."""
NYQUIST_MARGIN = 1e-3
"""Margin of the half angle `w0 dt/2` to pi/2, rad, where its tangent is not defined."""


@dataclass(slots=True)
class BandPass:
    """A causal band-pass that follows the period.

    Parameters
    ----------
    period_s : float
        Period on which it is centred, s; assign to it to move the centre.
    """

    period_s: float
    _state: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    def step(self, x: float, dt_s: float) -> float:
        """Return the filtered value of `x`, sampled `dt_s` after the one before."""
        return self.run((x,), (dt_s,))[0]

    def run(self, values: Sequence[float], steps_s: Sequence[float]) -> list[float]:
        """Return the filtered values; `steps_s` is the time from each value's sample before to its own.

        Steps that differ by no more than `EVEN` of themselves, the jitter of a clock, are taken for their mean.
        """
        if not steps_s:
            return []
        first_s = steps_s[0]
        if steps_s.count(first_s) == len(steps_s):
            return self._run_evenly(values, first_s)
        if max(steps_s) - min(steps_s) <= EVEN * first_s:
            return self._run_evenly(values, sum(steps_s) / len(steps_s))
        return [y for value, step_s in zip(values, steps_s, strict=True) for y in self._run_evenly((value,), step_s)]

    def _run_evenly(self, values: Iterable[float], step_s: float) -> list[float]:
        """Return the filtered values of samples with equal steps.

        A hot path: with `p = g/(1 + g (g + k))` the band of a section is `p y`, `y = x + a/g - b`, and afterwards
        `a' = 2 p y - a`, `b' = b + 2 g p y`. So difference and sum of `a/g` and `b` take each other's place, here those
        of both sections, scaled to the gain of the end.
        """
        a, b, c, d = self._state
        k, g = 1.0 / QUALITY, _bent(self.period_s, step_s)
        p = g / (1.0 + g * (g + k))
        gain = (p * k) ** SECTIONS
        less, more = 2.0 * p * (1.0 / g - g), 2.0 * p * (1.0 / g + g)
        by_first, by_second = gain / g, gain / (p * g)
        away, both = by_first * a - gain * b, by_first * a + gain * b
        away_2, both_2 = by_second * c - gain / p * d, by_second * c + gain / p * d
        filtered: list[float] = []
        keep = filtered.append
        for x in values:
            y = gain * x + away
            away, both = less * y - both, more * y - away
            y += away_2
            away_2, both_2 = less * y - both_2, more * y - away_2
            keep(y)
        first, second = 0.5 / gain, 0.5 * p / gain
        self._state = (
            first * g * (away + both),
            first * (both - away),
            second * g * (away_2 + both_2),
            second * (both_2 - away_2),
        )
        return filtered

    def response_at(self, period_s: float, dt_s: float) -> complex:
        """Return gain and phase of the filter for a sine of `period_s` sampled every `dt_s`, as a complex number."""
        z = 1j * _bent(period_s, dt_s) / _bent(self.period_s, dt_s)
        k = 1.0 / QUALITY
        return complex((k * z / (z * z + k * z + 1.0)) ** SECTIONS)


def _bent(period_s: float, dt_s: float) -> float:
    return math.tan(min(math.pi * dt_s / period_s, math.pi / 2.0 - NYQUIST_MARGIN))
