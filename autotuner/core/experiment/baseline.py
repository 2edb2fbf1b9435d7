"""Baseline of a drifting loop: the PV under the output at rest, as a line that is followed during the relay phase.

    level(t) = pv0 + slope tau (1 - e^{-(t - t0)/tau})
    mean pv_k - pv_0 = K (mean u_k - u_0) + s (t_k - t_0)   over the whole cycles k of the relay

The relay switches about a reference that moves with the line, so that it keeps its duty however far the PV drifts.
Under a reference that moves too fast or too slowly the mean of the output must drift too: least squares
estimates the static gain `K` from the cycles together with the mean slope `s`, and the centres of the latest cycles
then give the present slope. A process that has not settled drifts ever more slowly: where the rest shows that, `tau`
follows from slope and curvature; the experiment waits for a PV whose curvature is too large, or whose drift grows.

`t` s, `pv` PV units, `u` output units; `pv_0`, `u_0`, `t_0` at the end of the rest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.recording import Sample

FEWEST = 3
"""Cycles, one after each half period, from which a slope is determined."""
CERTAIN = 4.0
"""Standard errors beyond which a bend is seen."""
MOST_BENT = 0.7
"""Largest change of the slope over the rest, in the slope at its end, that is foreseen instead of waited for."""
EXTRAPOLATED = 60.0
"""Time for which a straight drift is taken to last, in the time for which it has been seen."""
LATEST = 4
"""Latest cycles, which show the present slope."""
FASTEST = 1.5
"""Largest slope that is accepted, in slopes at rest."""


@dataclass(frozen=True, slots=True)
class Line:
    """Drift of the PV: a point, s and PV units, the slope there, PV/s, and its time constant of decay, s."""

    t: float
    pv: float
    slope_per_s: float
    decay_s: float

    def at(self, t: float) -> float:
        """Return the PV on the line."""
        since_s = t - self.t
        return self.pv - self.slope_per_s * self.decay_s * math.expm1(-since_s / self.decay_s)

    def slope_at(self, t: float) -> float:
        """Return the slope at a later time, PV/s."""
        return self.slope_per_s * math.exp(-(t - self.t) / self.decay_s)


def line_of(t: FloatArray, pv: FloatArray) -> Line | None:
    """Return how a PV drifts at the end of its rest, or None where it bends too much to be foreseen.

    Parameters
    ----------
    t, pv : array of float, shape (N,), N >= 4
        Samples at rest, s and PV units.
    """
    since, span_s = t - t[-1], float(t[-1] - t[0])
    (curvature, slope, level), covariance = np.polyfit(since, pv, 2, cov=True)
    if abs(curvature) <= CERTAIN * math.sqrt(covariance[0, 0]):
        slope, level = np.polyfit(since, pv, 1)
        return Line(float(t[-1]), float(level), float(slope), EXTRAPOLATED * span_s)
    decay_s = -slope / (2.0 * curvature)
    if decay_s * MOST_BENT < span_s:
        return None
    return Line(float(t[-1]), float(level), float(slope), min(float(decay_s), EXTRAPOLATED * span_s))


def grows(t: FloatArray, pv: FloatArray) -> bool:
    """Return whether the drift of a PV becomes faster, as that of an integrating process under a growing load.

    Parameters
    ----------
    t, pv : array of float, shape (N,), N >= 4
        Samples at rest, s and PV units.
    """
    (curvature, slope, _), covariance = np.polyfit(t - t[-1], pv, 2, cov=True)
    return bool(curvature * slope > 0.0 and abs(curvature) > CERTAIN * math.sqrt(covariance[0, 0]))


class Baseline:
    """The line as it is followed.

    Parameters
    ----------
    rest : Line
        The PV at the end of the rest.
    output : float
        Output at rest, output units.
    gain_sign : float
        Sign of the static gain.
    """

    def __init__(self, rest: Line, output: float, gain_sign: float) -> None:
        self.line = rest
        self._rest = rest
        self._centres = Centres((rest.t, rest.pv, output), gain_sign)

    def levelled(self, sample: Sample) -> Sample:
        """Return a sample as it would be without the drift since the rest."""
        return replace(sample, pv=sample.pv - self.line.at(sample.t) + self._rest.pv)

    def follow(self, sample: Sample, wanted: float) -> None:
        """Process a sample of the relay with the requested output; correct the line where needed."""
        slope = self._centres.step(sample, wanted)
        if slope is not None:
            extrapolated_s = EXTRAPOLATED * (sample.t - self._rest.t)
            self.line = Line(
                sample.t,
                self.line.at(sample.t),
                self._limited_slope(slope, self.line.slope_at(sample.t)),
                extrapolated_s,
            )

    def _limited_slope(self, slope: float, present: float) -> float:
        """Return a slope half way from the present one, between none and a little more than the one at rest."""
        ends = sorted((0.0, FASTEST * self._rest.slope_per_s))
        return min(max((slope + present) / 2.0, ends[0]), ends[1])


class Centres:
    """The centres of the relay's cycles; `rest` is time, PV and output at rest, `gain_sign` that of the static gain."""

    def __init__(self, rest: tuple[float, float, float], gain_sign: float) -> None:
        self._rest = np.array(rest)
        self._gain_sign = gain_sign
        self._last: Sample | None = None
        self._wanted = rest[2]
        self._area = np.zeros(3)
        self._switches: list[FloatArray] = []

    def step(self, sample: Sample, wanted: float) -> float | None:
        """Take a sample; return the slope of the latest cycles as it would be under the output at rest, PV/s.

        None between two switches, and while it is not known.
        """
        if self._last is not None:
            dt, pv = sample.t - self._last.t, (sample.pv + self._last.pv) / 2.0
            self._area += np.array((dt * (sample.t + self._last.t) / 2.0, dt * pv, dt * sample.output))
        self._last, before, self._wanted = sample, self._wanted, wanted
        if wanted == before:
            return None
        self._switches.append(np.array((sample.t, *self._area)))
        return self._slope_per_s() if len(self._switches) >= FEWEST + 2 else None

    def _slope_per_s(self) -> float | None:
        marks = np.array(self._switches)
        cycles = marks[2:] - marks[:-2]
        t, pv, output = (cycles[:, 1:] / cycles[:, :1] - self._rest).T
        gain = float(np.linalg.lstsq(np.column_stack((output, t)), pv, rcond=None)[0][0])
        if gain * self._gain_sign <= 0.0:
            return None
        return float(np.polyfit(t[-LATEST:], (pv - gain * output)[-LATEST:], 1)[0])
