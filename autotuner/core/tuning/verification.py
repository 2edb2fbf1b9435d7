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
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import scipy

from autotuner.core.tuning.actuators import has_friction, seats
from autotuner.core.tuning.closed_loop import Prediction, Scenario, predict
from autotuner.core.tuning.uncertainty import Z95, shifted

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.arrays import FloatArray
    from autotuner.core.process import ProcessModel
    from autotuner.core.tuning.actuators import MakeActuator, Named
    from autotuner.core.tuning.pid import PidSettings

TOLERATED, TOLERATED_MEAN = 0.03, 0.02
"""Shares of the largest deviation predicted for the last while by which a response, and its mean, may miss it."""
NOISE_MULTIPLE = 4.0
SMOOTHED, SMOOTHED_SHARE = 20, 0.05
"""Samples of which the mean is compared, at least and as a share of all; of the output, which carries much noise, only
the mean is."""
LONGER, MOST_SAMPLES = 8, 20_000
"""What noise does to the loop is seen over so many times the step's time, of so many samples at most."""
LATE = 4
"""The last quarter of a prediction shows whether it comes to rest."""
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
    over : int
        Samples of which the mean is taken.
    """

    t: FloatArray
    pv: Range
    mean_pv: Range
    output: Range
    nominal: Prediction
    over: int


def predicted_band(
    model: ProcessModel,
    settings: PidSettings,
    scenario: Scenario,
    *,
    noise_sigma: float = 0.0,
    covariance: FloatArray | None = None,
    timing_s: float = 0.0,
    sample_time_s: float | None = None,
    effects: Sequence[Named] = (),
    rest_output: float = 0.0,
    rest_samples: int = 0,
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
    effects : sequence of Named
        What a diagnosis has found in the actuator; where a valve with friction stands before the step is not known.
    rest_output : float
        Output at rest, output units.
    rest_samples : int
        Samples whose mean is the rest, which noise moves too; 0 where the rest is known.
    """
    every = slice(None, None, round((sample_time_s or scenario.sample_time_s) / scenario.sample_time_s))
    makers = seats(effects, rest_output, scenario.sample_time_s)
    loops = _possible_loops(model, settings, scenario, covariance, makers)
    nominal, friction = loops[0], has_friction(effects)
    wander, play = _what_noise_does(model, settings, scenario, makers[0], noise_sigma, friction)
    t, over = nominal.t[every], max(SMOOTHED, round(SMOOTHED_SHARE * nominal.t[every].size))
    widened = partial(_range, unsteady=friction)
    latest = _scans(timing_s, sample_time_s or scenario.sample_time_s)
    pvs, outputs = (
        [later for one in loops for later in _moved_in_time(getattr(one, name)[every], latest)]
        for name in ("pv", "output")
    )
    means, mean_outputs = ([smoothed(signal, over) for signal in signals] for signals in (pvs, outputs))
    return Band(
        t,
        widened(pvs, _spread(wander[every], TOLERATED * _lately(pvs), 1, rest_samples)),
        widened(means, _spread(wander[every], TOLERATED_MEAN * _lately(means), over, rest_samples)),
        widened(mean_outputs, _spread(play[every], TOLERATED * _lately(mean_outputs), over, rest_samples)),
        nominal,
        over,
    )


def _possible_loops(
    model: ProcessModel,
    settings: PidSettings,
    scenario: Scenario,
    covariance: FloatArray | None,
    makers: Sequence[MakeActuator],
) -> list[Prediction]:
    """Return the responses of the model, the first, of its neighbours, and from where else the actuator may stand."""
    processes = [model, *_neighbours(model, covariance)]
    chances = [*((process, makers[0]) for process in processes), *((model, end) for end in makers[1:])]
    return [predict(process, settings, scenario, actuator=make()) for process, make in chances]


def _what_noise_does(
    model: ProcessModel,
    settings: PidSettings,
    scenario: Scenario,
    make: MakeActuator,
    noise_sigma: float,
    friction: bool,  # noqa: FBT001
) -> tuple[FloatArray, FloatArray]:
    """Return PV and output as noise moves them, for long enough to know how far they wander.

    In an actuator with friction noise decides when it moves: there it is the difference that noise makes to the step.
    """
    h, short = scenario.sample_time_s, math.ceil(scenario.duration_s / scenario.sample_time_s) + 1
    count = short if friction else max(short, min(LONGER * short, MOST_SAMPLES))
    noise = noise_sigma * np.random.default_rng(0).standard_normal(count)
    if not friction:
        noisy = predict(model, settings, Scenario((count - 1) * h, h), actuator=make(), noise=noise)
        return noisy.pv, noisy.output
    noisy, still = (predict(model, settings, scenario, actuator=make(), noise=one) for one in (noise, None))
    return noisy.pv - still.pv, noisy.output - still.output


def _moved_in_time(signal: FloatArray, most: int) -> list[FloatArray]:
    """Return a signal that begins up to so many samples later or earlier, at rest before."""
    late = [np.concatenate((np.zeros(k), signal[: signal.size - k])) for k in range(most + 1)]
    early = [np.concatenate((signal[k:], np.full(k, signal[-1]))) for k in range(1, most + 1)]
    return [*late, *early]


def _scans(timing_s: float, sample_time_s: float) -> int:
    """Return the samples by which a step may act beside its time; one more, for it may be read just before it acts."""
    return math.floor(timing_s / sample_time_s) + 1 if timing_s > 0.0 else 0


def _lately(signals: list[FloatArray]) -> FloatArray:
    """Return how far the first signal, the nominal one, was away from rest at most over the last while.

    Of a large move long past a right model keeps no error: what it misses late is measured against what is left.
    """
    size = signals[0].size // LATE | 1  # odd, so that it can end at the sample
    largest: FloatArray = scipy.ndimage.maximum_filter1d(np.abs(signals[0]), size, origin=size // 2, mode="nearest")
    return largest


def smoothed(values: FloatArray, over: int) -> FloatArray:
    """Return the mean of the latest `over` samples at each sample."""
    sums = np.cumsum(values)
    count = np.minimum(np.arange(1, values.size + 1), over)
    sums[over:] -= sums[:-over].copy()
    mean: FloatArray = sums / count
    return mean


def _spread(noise: FloatArray, tolerated: FloatArray, over: int, rest_samples: int) -> FloatArray:
    """Return by how much `smoothed` noise and what is tolerated may move a signal, at each sample.

    Both are independent, so their squares add. The first means are over few samples; the error of the rest, a mean
    itself, is the same at all of them.
    """
    sums = np.concatenate(([0.0], np.cumsum(noise)))

    def reach(k: int) -> float:
        return NOISE_MULTIPLE * float(np.std(sums[k:] - sums[:-k])) / k

    rest = reach(min(rest_samples, noise.size // 2)) if rest_samples else 0.0
    reached = [reach(k) for k in range(1, over + 1)]
    far: FloatArray = np.array(reached + reached[-1:] * (tolerated.size - over))
    return np.hypot(far, tolerated) + rest


def _range(signals: list[FloatArray], margin: FloatArray, *, unsteady: bool) -> Range:
    """Return the range of the signals, widened by a margin; an `unsteady` loop swings on in the end, in any phase."""
    if unsteady:
        margin = margin + np.max([_swing(signal) for signal in signals], axis=0)
    return Range(np.min(signals, axis=0) - margin, np.max(signals, axis=0) + margin)


def _swing(signal: FloatArray) -> FloatArray:
    """Return half the swing in which a signal ends, at the samples from which it stays inside it; before them 0."""
    late = signal[-signal.size // LATE :]
    swing = float(np.ptp(late))
    outside = np.flatnonzero(np.abs(signal - np.mean(late)) > swing)
    begin = int(outside[-1]) + 1 if outside.size else 0
    return np.where(np.arange(signal.size) < begin, 0.0, swing / 2.0)


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
    _latest: deque[tuple[float, float]] = field(init=False)
    _outside: int = field(default=0, init=False)
    _worst: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        self._latest = deque(maxlen=self.band.over)

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
