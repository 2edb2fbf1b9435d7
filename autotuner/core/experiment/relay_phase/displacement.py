"""Displacement of the PV of an integrating process by the experiment, as the impulse of the output that removes it.

    left = (pv - pv_0)/K + I(t) - I(t - D - T),   I = int (u - u_0) dt

The first part is the present displacement, a load's included; the second is on its way in dead time and lag. Without a
load, `left` is `I`, whatever the error of `K`. Output units s; `K` PV per output and second.
"""

from __future__ import annotations

from bisect import bisect_left
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from autotuner.core.model.process import Integrating
    from autotuner.core.recording import Sample

AT_REST = 20
"""First samples, whose mean is the PV as it was found."""


class Displacement:
    """The samples so far, with the impulse of the output at each.

    Parameters
    ----------
    rest : float
        Output at rest, output units.
    """

    def __init__(self, rest: float) -> None:
        self._rest = rest
        self._t: list[float] = []
        self._pv: list[float] = []
        self._impulse: list[float] = []

    def step(self, sample: Sample) -> None:
        """Take a sample, whose output was in force since the sample before."""
        since_s = sample.t - self._t[-1] if self._t else 0.0
        before = self._impulse[-1] if self._impulse else 0.0
        self._impulse.append(before + (sample.output - self._rest) * since_s)
        self._t.append(sample.t)
        self._pv.append(sample.pv)

    def left(self, process: Integrating, mean_s: float) -> float:
        """Return the impulse that is left to remove, output units s.

        Parameters
        ----------
        process : Integrating
            The process.
        mean_s : float
            Latest time over which the noise of the PV is averaged, s.
        """
        first = min(bisect_left(self._t, self._t[-1] - mean_s), len(self._t) - 1)
        t, pv = np.array(self._t[first:]), np.array(self._pv[first:])
        began = bisect_left(self._t, t[0] - process.D - process.T)
        before = slice(max(began - 1, 0), None)
        responded = np.interp(t - process.D - process.T, self._t[before], self._impulse[before])
        seen = float(np.mean((pv - np.mean(self._pv[:AT_REST])) / process.K - responded))
        return self._impulse[-1] + seen
