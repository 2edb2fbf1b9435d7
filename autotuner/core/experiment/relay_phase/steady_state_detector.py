"""Steady-state detector: a PV that settles within the relay's dead zone, because the relay is too weak.

    answered   |mean of the last quarter - rest| > 4 standard errors
    settled    |mean of the last quarter - mean of the quarter before| within 4 standard errors and 2 % of the response

over the time since the relay last switched, evaluated each time it has doubled. A PV that has not responded at all may
still be within its dead time, so that alone does not count.
"""

from __future__ import annotations

import math

import numpy as np

CERTAIN = 4.0
"""Standard errors of a significant move of a mean: by chance once in 16,000."""
SETTLED = 0.02
"""Share of the response by which two windows of a settled PV may differ: the 2 % band of a settling time."""
FIRST_LOOK = 32
"""Samples before the first evaluation."""


class SteadyStateDetector:
    """Watches a half period.

    Parameters
    ----------
    rest : float
        PV before the relay moved the output, PV units.
    noise_sigma : float
        Noise of the PV.
    rest_error : float
        Standard error of `rest`, PV units.

    Attributes
    ----------
    looks : int
        Number of consecutive evaluations at rest, the latest included: a PV so slow that it once passes for
        settled has moved further when the time has doubled.
    """

    def __init__(self, rest: float, noise_sigma: float, rest_error: float = 0.0) -> None:
        self._rest = rest
        self._sigma = noise_sigma
        self._rest_error = rest_error
        self._pv: list[float] = []
        self.looks = 0

    def begin(self) -> None:
        """Watch a new half period."""
        self._pv.clear()
        self.looks = 0

    @property
    def changed(self) -> bool:
        """Whether the PV has changed at all in this half period."""
        return any(pv != self._pv[0] for pv in self._pv)

    def step(self, pv: float) -> float | None:
        """Process a sample; return the move of the PV when it has settled, PV units."""
        self._pv.append(pv)
        count = len(self._pv)
        if count < FIRST_LOOK or count & (count - 1):
            return None
        quarter = count // 4
        before, last = float(np.mean(self._pv[-2 * quarter : -quarter])), float(np.mean(self._pv[-quarter:]))
        moved, error = last - self._rest, self._sigma * math.sqrt(2.0 / quarter)
        responded = abs(moved) > CERTAIN * math.hypot(error, self._rest_error) and moved != 0.0
        settled = abs(last - before) <= max(CERTAIN * error / 2.0, SETTLED * abs(moved))
        self.looks = self.looks + 1 if responded and settled else 0
        return moved if responded and settled else None
