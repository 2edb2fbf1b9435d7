"""Displacement of the PV of an integrating process by the experiment, as the impulse of the output that removes it.

    left = (pv - pv_0)/K + I(t) - I(t - D - T),   I = int (u - u_0) dt

The first part is the present displacement, a load's included; the second is on its way in dead time and lag. Without a
load, `left` is `I`, which needs no model: so it is where the difference may be an error of the model. Output units s;
`K` PV per output and second.
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
GAIN_ERROR, LAG_ERROR = 0.2, 0.3
"""Errors of a running model's gain, and of its dead time and lag, as shares, within which no load is seen."""


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
        """Return the impulse that is left to remove, a load's included, output units s.

        Parameters
        ----------
        process : Integrating
            The process.
        mean_s : float
            Latest time over which the noise of the PV is averaged, s.
        """
        return self.impulse + self._seen(process, mean_s)[0]

    @property
    def impulse(self) -> float:
        """The impulse of the output so far, output units s."""
        return self._impulse[-1]

    def shows_load(self, process: Integrating, mean_s: float, amplitude: float) -> bool:
        """Return whether the PV is farther from where the output has moved it than an error of the model explains.

        Parameters
        ----------
        process, mean_s : Integrating, float
            As in `left`.
        amplitude : float
            Relay amplitude, output units.
        """
        seen, responded = self._seen(process, mean_s)
        return abs(seen) > GAIN_ERROR * abs(responded) + LAG_ERROR * amplitude * (process.D + process.T)

    def _seen(self, process: Integrating, mean_s: float) -> tuple[float, float]:
        """Return the impulse that the PV shows beyond that of the output that it has responded to, and the latter."""
        first = min(bisect_left(self._t, self._t[-1] - mean_s), len(self._t) - 1)
        t, pv = np.array(self._t[first:]), np.array(self._pv[first:])
        began = slice(max(bisect_left(self._t, t[0] - process.D - process.T) - 1, 0), None)
        responded = np.interp(t - process.D - process.T, self._t[began], self._impulse[began])
        seen = (pv - np.mean(self._pv[:AT_REST])) / process.K - responded
        return float(np.mean(seen)), float(np.mean(responded))
