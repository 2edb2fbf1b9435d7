"""Whether a loop does under its new gains what was predicted: pass, or back to the old gains with the evidence.

The prediction is a band: the response of the model, widened by the responses of the models of its 95 % region (one
step of 1.96 standard deviations along each principal axis, both ways), by a share for what no model holds, by the noise
and by the uncertainty of the time at which the step acted. Measured PV and output are compared with it sample by sample
while the step runs, and so are their means over some samples, which show a small error that lasts: the output tells of
a valve that sticks when the PV hardly does. A step of the set point and of the load at once tells most.

`t` s from the step, PV and output as deviations from the rest before it.

Rules of this file: the judge sees samples and nothing else; it decides to go back as soon as the evidence is clear, and
to pass only at the end; a single sample outside is no evidence.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from autotuner.core.tuning.closed_loop import Prediction, Scenario, predict
from autotuner.core.tuning.uncertainty import Z95, shifted

if TYPE_CHECKING:
    from autotuner.core.arrays import FloatArray
    from autotuner.core.process import ProcessModel
    from autotuner.core.tuning.pid import PidSettings

TOLERATED, TOLERATED_MEAN = 0.03, 0.02
"""Shares of the largest predicted deviation by which a response, and its mean, may miss the model's."""
NOISE_MULTIPLE = 4.0
SMOOTHED = 20
"""Samples of which the mean is compared; of the output only the mean is, because it carries much noise."""
PATIENCE_SHARE = 0.02
"""Share of the samples outside the band, one after the other, that is evidence."""


class Decision(StrEnum):
    """What to do after a sample."""

    GO_ON = "go_on"
    PASS = "pass"  # noqa: S105 - not a password
    ROLL_BACK = "roll_back"


@dataclass(frozen=True, slots=True, eq=False)
class Range:
    """Limits of a signal at the samples of a prediction; arrays of shape (N,)."""

    low: FloatArray
    high: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Band:
    """The predicted band.

    Attributes
    ----------
    t : array of float, shape (N,)
        Times of the samples, s from the step.
    pv, mean_pv, output : Range
        Limits of the PV, and of PV and controller's output after `smoothed`.
    nominal : Prediction
        What the model does.
    """

    t: FloatArray
    pv: Range
    mean_pv: Range
    output: Range
    nominal: Prediction


def predicted_band(
    model: ProcessModel,
    settings: PidSettings,
    scenario: Scenario,
    *,
    noise_sigma: float = 0.0,
    covariance: FloatArray | None = None,
    timing_s: float = 0.0,
    sample_time_s: float | None = None,
) -> Band:
    """Return the band in which PV and output will stay when the model is right.

    Parameters
    ----------
    model : ProcessModel
        The process.
    settings : PidSettings
        The controller to be verified, with the limits of the output.
    scenario : Scenario
        The step that will be made.
    noise_sigma : float
        Standard deviation of the measurement noise, PV units.
    covariance : array of float, shape (p, p), optional
        Covariance of the model's parameters.
    timing_s : float
        How much earlier or later than known the step may have acted, s.
    sample_time_s : float, optional
        Time between two samples that are judged, s, a multiple of the scenario's; the same by default.
    """
    every = slice(None, None, round((sample_time_s or scenario.sample_time_s) / scenario.sample_time_s))
    nominal = predict(model, settings, scenario)
    loops = [nominal, *(predict(other, settings, scenario) for other in _neighbours(model, covariance))]
    noise = noise_sigma * np.random.default_rng(0).standard_normal(nominal.t.size)
    noisy = predict(model, settings, scenario, noise=noise)
    shift = math.ceil(timing_s / scenario.sample_time_s)
    wander, play = noisy.pv - nominal.pv, noisy.output - nominal.output  # the controller turns noise into motion
    return Band(
        nominal.t[every],
        _range([loop.pv[every] for loop in loops], TOLERATED, float(np.std(wander)), shift),
        _range([smoothed(loop.pv[every]) for loop in loops], TOLERATED_MEAN, float(np.std(smoothed(wander))), shift),
        _range([smoothed(loop.output[every]) for loop in loops], TOLERATED, float(np.std(smoothed(play))), shift),
        nominal,
    )


def smoothed(values: FloatArray) -> FloatArray:
    """Return the mean of the latest samples at each sample."""
    sums = np.cumsum(values)
    count = np.minimum(np.arange(1, values.size + 1), SMOOTHED)
    sums[SMOOTHED:] -= sums[:-SMOOTHED].copy()
    mean: FloatArray = sums / count
    return mean


def _range(signals: list[FloatArray], tolerated: float, sigma: float, shift: int) -> Range:
    """Return the range of the signals, the first being the nominal one, widened by what is tolerated and by noise.

    Over `shift` samples before and after each sample too, those before the first being at rest.
    """
    margin = tolerated * float(np.max(np.abs(signals[0]))) + NOISE_MULTIPLE * sigma
    low, high = np.min(signals, axis=0), np.max(signals, axis=0)
    if shift:
        rest = [0.0] * shift
        low = minimum_filter1d(np.concatenate((rest, low)), 2 * shift + 1, mode="nearest")[shift:]
        high = maximum_filter1d(np.concatenate((rest, high)), 2 * shift + 1, mode="nearest")[shift:]
    return Range(low - margin, high + margin)


def _neighbours(model: ProcessModel, covariance: FloatArray | None) -> list[ProcessModel]:
    """Return the models one step of the 95 % region away along each principal axis."""
    if covariance is None:
        return []
    variances, axes = np.linalg.eigh(covariance)
    steps = [Z95 * math.sqrt(v) * axis for v, axis in zip(variances, axes.T, strict=True) if v > 0.0]
    return [shifted(model, sign * step) for step in steps for sign in (1.0, -1.0)]


@dataclass(slots=True)
class Verification:
    """The judge of one step, fed sample by sample.

    Attributes
    ----------
    band : Band
        What was predicted.
    """

    band: Band
    evidence: str = field(default="PV and output stayed inside the predicted band", init=False)
    _latest: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=SMOOTHED), init=False)
    _outside: int = field(default=0, init=False)
    _worst: float = field(default=0.0, init=False)

    def step(self, t: float, pv: float, output: float) -> Decision:
        """Take PV and output at a time after the step and decide; a value that is not finite is evidence at once."""
        if not (math.isfinite(pv) and math.isfinite(output)):
            self.evidence = f"the PV or the output was lost {t:.3g} s after the step"
            return Decision.ROLL_BACK
        self._latest.append((self._clamped(t, pv), output))  # of one wild sample the mean must not keep a trace
        mean_pv, mean_output = (sum(column) / len(column) for column in zip(*self._latest, strict=True))
        excess = max(
            self._excess("PV", self.band.pv, t, pv),
            self._excess("PV", self.band.mean_pv, t, mean_pv),
            self._excess("output", self.band.output, t, mean_output),
        )
        self._outside = self._outside + 1 if excess > 0.0 else 0
        if self._outside > max(2, PATIENCE_SHARE * self.band.t.size):
            return Decision.ROLL_BACK
        return Decision.PASS if t >= self.band.t[-1] else Decision.GO_ON

    def _clamped(self, t: float, pv: float) -> float:
        low, high = self.band.pv.low, self.band.pv.high
        return min(max(pv, float(np.interp(t, self.band.t, low))), float(np.interp(t, self.band.t, high)))

    def _excess(self, name: str, limits: Range, t: float, value: float) -> float:
        """Return by which share of its range a signal is outside, and keep the worst as evidence."""
        low, high = float(np.interp(t, self.band.t, limits.low)), float(np.interp(t, self.band.t, limits.high))
        outside = max(low - value, value - high)
        share = outside / float(np.max(limits.high) - np.min(limits.low))
        if share > self._worst:
            self._worst = share
            self.evidence = f"the {name} left the predicted band by {outside:.3g}, {t:.3g} s after the step"
        return share
