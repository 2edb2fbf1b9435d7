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
from dataclasses import dataclass, field

QUALITY = 0.7
"""Wide enough to settle in about one period, narrow enough to halve the third harmonic twice."""
SECTIONS = 2
NYQUIST_MARGIN = 1e-3
"""How far below pi/2 the half angle `w0 dt/2` is kept, rad: at pi/2 its tangent has no value."""


@dataclass(slots=True)
class _Section:
    """One second-order section: the two integrator states."""

    first: float = 0.0
    second: float = 0.0

    def step(self, x: float, g: float, k: float) -> float:
        scale = 1.0 / (1.0 + g * (g + k))
        band = (self.first + g * (x - self.second)) * scale
        low = self.second + g * band
        self.first = 2.0 * band - self.first
        self.second = 2.0 * low - self.second
        return k * band


@dataclass(slots=True)
class BandPass:
    """A causal band-pass that follows the period.

    Parameters
    ----------
    period_s : float
        Period on which it is centred, s; assign to it to move the centre.
    """

    period_s: float
    _sections: list[_Section] = field(default_factory=lambda: [_Section() for _ in range(SECTIONS)])

    def step(self, x: float, dt_s: float) -> float:
        """Return the filtered value of `x`, sampled `dt_s` after the one before."""
        g = _bent(self.period_s, dt_s)
        for section in self._sections:
            x = section.step(x, g, 1.0 / QUALITY)
        return x

    def response_at(self, period_s: float, dt_s: float) -> complex:
        """Return gain and phase of the filter for a sine of `period_s` sampled every `dt_s`, as a complex number."""
        z = 1j * _bent(period_s, dt_s) / _bent(self.period_s, dt_s)
        k = 1.0 / QUALITY
        return complex((k * z / (z * z + k * z + 1.0)) ** SECTIONS)


def _bent(period_s: float, dt_s: float) -> float:
    return math.tan(min(math.pi * dt_s / period_s, math.pi / 2.0 - NYQUIST_MARGIN))
