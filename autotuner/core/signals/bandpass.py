"""Streaming band-pass, centred on the running period.

    H(s) = (s/w0)/Q / ((s/w0)^2 + (s/w0)/Q + 1),   twice in a row

discretised by the trapezoidal rule with the frequency axis bent so that `w0` stays in place: with `g = tan(w0 dt/2)`,

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
    from collections.abc import Iterable

QUALITY = 0.7
"""Wide enough to settle in about one period, narrow enough to halve the third harmonic twice."""
SECTIONS = 2
NYQUIST_MARGIN = 1e-3
"""How far below pi/2 the half angle `w0 dt/2` is kept, rad: at pi/2 its tangent has no value."""


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

    def run(self, values: Iterable[float], steps_s: Iterable[float]) -> list[float]:
        """Return the filtered values; `steps_s` is the time from each value's sample before to its own.

        A hot path: both sections are written out, their integrators `a`, `b` and `c`, `d`; the gain `k` of each is left
        to the end. With `p = g/(1 + g (g + k))` and `q = p/g` a section's band is `q a + p (x - b)`.
        """
        a, b, c, d = self._state
        k, period_s, last_s = 1.0 / QUALITY, self.period_s, math.nan
        twice_g = p = q = 0.0
        gain = k**SECTIONS
        filtered: list[float] = []
        keep = filtered.append
        for x, step_s in zip(values, steps_s, strict=True):
            if step_s != last_s:
                last_s, g = step_s, _bent(period_s, step_s)
                q = 1.0 / (1.0 + g * (g + k))
                p, twice_g = g * q, 2.0 * g
            band = q * a + p * (x - b)
            a = band + band - a
            b += twice_g * band
            last = q * c + p * (band - d)
            c = last + last - c
            d += twice_g * last
            keep(gain * last)
        self._state = a, b, c, d
        return filtered

    def response_at(self, period_s: float, dt_s: float) -> complex:
        """Return gain and phase of the filter for a sine of `period_s` sampled every `dt_s`, as a complex number."""
        z = 1j * _bent(period_s, dt_s) / _bent(self.period_s, dt_s)
        k = 1.0 / QUALITY
        return complex((k * z / (z * z + k * z + 1.0)) ** SECTIONS)


def _bent(period_s: float, dt_s: float) -> float:
    return math.tan(min(math.pi * dt_s / period_s, math.pi / 2.0 - NYQUIST_MARGIN))
