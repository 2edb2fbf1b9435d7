"""Least-squares line through the latest samples, updated with every sample.

    G = R R',   R = (1, t - t_0, y - y_0)            rows of N samples, t_0 and y_0 those of the oldest that is held
    slope = S_ty / S_tt,   S_ty = G_ty - G_1t G_1y / N and so on
    s^2 = (S_yy - slope S_ty) / (N - 2),   var(mean) = s^2 / N,   var(slope) = s^2 / S_tt

All sums of a line come from one product of the rows with themselves. Relative to a nearby sample they lose a few
digits of sixteen to rounding; a negative residual variance counts as zero.

`t` s; `y` PV units; `s` standard deviation about the line (Draper and Smith, Applied Regression Analysis, 1998, ch. 1).
"""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass

import numpy as np

MOST = 64
"""Samples in a line."""
HELD = 2 * MOST
"""Samples that are held: half of them go at once."""
CERTAIN = 3.0
"""Standard errors by which a prediction must pass a limit, and a slope must differ from zero."""


@dataclass(frozen=True, slots=True)
class Trend:
    """A line through the latest samples.

    Attributes
    ----------
    level, slope : float
        At the latest sample, PV and PV/s.
    _variances : tuple of float
        Variance of the mean and of the slope, and the distance of the latest sample from the mean time, s.
    """

    level: float
    slope: float
    _variances: tuple[float, float, float]

    @property
    def direction(self) -> float:
        """+1 rising, -1 falling, 0 when the noise could do it."""
        certain = abs(self.slope) > CERTAIN * math.sqrt(self._variances[1])
        return math.copysign(1.0, self.slope) if certain else 0.0

    def ahead(self, lead_s: float, direction: float) -> float:
        """Return the PV that is certain to be reached in `direction` after `lead_s`."""
        of_mean, of_slope, since_mean_s = self._variances
        error = math.sqrt(of_mean + of_slope * (since_mean_s + lead_s) ** 2)
        return self.level + self.slope * lead_s - direction * CERTAIN * error


class Latest:
    """The latest samples, at least `MOST` once there were as many."""

    def __init__(self) -> None:
        self._t: list[float] = []
        self._pv: list[float] = []
        self._rows = np.ones((3, HELD))

    @property
    def size(self) -> int:
        """Number of samples in the window."""
        return len(self._t)

    def take(self, t: float, pv: float) -> None:
        """Take a sample: its time, s, after all before, and its PV."""
        if len(self._t) == HELD:
            del self._t[:MOST], self._pv[:MOST]
            self._rows[1, :MOST] = np.array(self._t) - self._t[0]
            self._rows[2, :MOST] = np.array(self._pv) - self._pv[0]
        self._t.append(t)
        self._pv.append(pv)
        size = len(self._t)
        self._rows[1, size - 1] = t - self._t[0]
        self._rows[2, size - 1] = pv - self._pv[0]

    def trend(self, since_s: float, fewest: int) -> Trend:
        """Return the line through the samples from `since_s` on, `fewest` (three or more) to `MOST` of them."""
        size = len(self._t)
        first = min(bisect_left(self._t, since_s, max(size - MOST, 0)), size - fewest)
        rows = self._rows[:, first:size]
        (count, of_t, of_pv), (_, of_tt, of_ty), (_, _, of_yy) = rows.dot(rows.T).tolist()
        mean_t, mean_pv = of_t / count, of_pv / count
        power, rise = of_tt - mean_t * of_t, of_ty - mean_t * of_pv
        slope, since_mean_s = rise / power, self._t[-1] - self._t[0] - mean_t
        variance = max(of_yy - mean_pv * of_pv - slope * rise, 0.0) / (count - 2.0)
        level = self._pv[0] + mean_pv + slope * since_mean_s
        return Trend(level, slope, (variance / count, variance / power, since_mean_s))
