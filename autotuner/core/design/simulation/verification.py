"""Judge of a verification: the loop passes if it behaves as predicted, else the previous gains are restored.

The prediction is a band: the response of the model, widened by the responses of the models of its 95 % region (one
step of 1.96 standard deviations along each principal axis, both ways), by a share for unmodelled dynamics, by the noise
and by the uncertainty of the time at which the step acted. Measured PV and output are compared with it sample by sample
during the step, and so are moving means, which reveal a small lasting error: the output reveals a sticking valve when
the PV hardly does. A simultaneous step of set point and load is the most sensitive test.

`t` s from the step, PV and output as deviations from the rest before it.

Invariants: the judge depends on samples only; it fails a loop as soon as the evidence is clear, and
passes it only at the end; a single sample outside of the band is not evidence.

The step of a verification: large enough to be seen in the noise, small enough for the limits, over in time.

    step = min(wanted, ROOM x room of the output / move per unit step, ROOM x room of the PV / move per unit step)
    step >= SEEN sigma

The moves per unit step are those of the simulated loop (`closed_loop`). Time ends when the simulated PV has settled.

`sigma` standard deviation of the measurement noise; steps and rooms in PV and output units.

Invariants: a step that the limits leave no room for is a refusal with its numbers, never a smaller limit.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import scipy

from autotuner.core.design.optimisation.uncertainty import shifted
from autotuner.core.design.simulation.actuators import has_friction, seats
from autotuner.core.design.simulation.closed_loop import Prediction, Scenario, predict
from autotuner.core.model.process import sum_of_lags
from autotuner.core.quantiles import NORMAL_95
from autotuner.core.verdict import Verdict, refused

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.design.simulation.actuators import MakeActuator, Named
    from autotuner.core.design.simulation.pid import PidSettings
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.process import ProcessModel

TOLERATED, TOLERATED_MEAN = 0.03, 0.02
"""Shares of the largest deviation predicted for the last while by which a response, and its mean, may miss it."""
NOISE_MULTIPLE = 4.0
"""Standard deviations of the noise that a predicted band allows for: one sample in 16,000 lies beyond by chance."""
SMOOTHED, SMOOTHED_SHARE = 20, 0.05
"""Samples of which the mean is compared, at least and as a share of all; of the output, which carries much noise, only
the mean is."""
LONGER, MOST_SAMPLES = 8, 20_000
"""Length of the simulation of noise, in step durations, and its most samples."""
LATE = 4
"""The last quarter of a prediction shows whether it comes to rest."""
LEAST_SHARE = 0.5
"""Smallest share of valid samples in a mean: noise moves a mean of fewer by more than the band allows."""
WILD_SPANS = 2.0
"""Distance of an output from all that is predicted, in the span of that, from which a single reading is damaged."""
PATIENCE_SHARE = 0.02
"""Share of the samples outside the band, one after the other, that is evidence."""


class Decision(StrEnum):
    """Decision after a sample."""

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
    pv_play, output_play : float
        What noise may do to a single sample, `NOISE_MULTIPLE` standard deviations, PV and output units.
    """

    t: FloatArray
    pv: Range
    mean_pv: Range
    output: Range
    nominal: Prediction
    over: int
    pv_play: float
    output_play: float


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
        What a diagnosis has found in the actuator; the position of a valve with friction before the step is not known.
    rest_output : float
        Output at rest, output units.
    rest_samples : int
        Number of samples in the mean of the rest, which noise moves too; 0 for a known rest.
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
        *(NOISE_MULTIPLE * float(np.std(signal)) for signal in (wander, play)),
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


def _moved_in_time(signal: FloatArray, shift: int) -> list[FloatArray]:
    """Return a signal shifted by up to `shift` samples in both directions, at rest before."""
    late = [np.concatenate((np.zeros(k), signal[: signal.size - k])) for k in range(shift + 1)]
    early = [np.concatenate((signal[k:], np.full(k, signal[-1]))) for k in range(1, shift + 1)]
    return [*late, *early]


def _scans(timing_s: float, sample_time_s: float) -> int:
    """Return the uncertainty of the start of a step, samples; one more, for the PV may be read just before it acts."""
    return math.floor(timing_s / sample_time_s) + 1 if timing_s > 0.0 else 0


def _lately(signals: list[FloatArray]) -> FloatArray:
    """Return how far the first signal, the nominal one, was away from rest at most over the last while.

    A right model keeps no error of a large move long past: late errors are measured against the remaining motion.
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
    """Return the half width of the band of a mean, by noise and tolerance, at each sample.

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
    steps = [NORMAL_95 * math.sqrt(v) * axis for v, axis in zip(variances, axes.T, strict=True) if v > 0.0]
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
    _latest: deque[tuple[float, float, bool]] = field(init=False)
    _last_s: float | None = field(default=None, init=False)
    _held: float = field(default=0.0, init=False)
    _wild: bool = field(default=False, init=False)
    _outside: int = field(default=0, init=False)
    _worst: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        self._latest = deque(maxlen=self.band.over)

    def step(self, t: float, pv: float, output: float) -> Decision:
        """Take PV and output at a time after the step and decide."""
        if not (math.isfinite(pv) and math.isfinite(output)):
            self.evidence = f"the PV or the output was lost {t:.3g} s after the step"
            return self._decided(t, outside=True)
        self._take(
            t, self._clamped(t, pv), self._without_spike(output)
        )  # a mean keeps no trace of a single wild sample
        excess = max(self._excess("PV", self.band.pv, t, pv), self._excess_of_means(t))
        return self._decided(t, outside=excess > 0.0)

    def _take(self, t: float, pv: float, output: float) -> None:
        """Take a sample for the means."""
        if self._last_s is not None:
            missed = round((t - self._last_s) / float(self.band.t[1] - self.band.t[0])) - 1
            if missed > 0:
                self._fill(np.linspace(self._last_s, t, missed + 2), (pv, output))
        self._latest.append((pv, output, True))
        self._last_s = t

    def _fill(self, times: FloatArray, after: tuple[float, float]) -> None:
        """Put the prediction, plus a line of its error, in the place of samples that were missed between two others."""
        nominal = [np.interp(times, self.band.nominal.t, getattr(self.band.nominal, name)) for name in ("pv", "output")]
        ends = zip(nominal, self._latest[-1][:2], after, strict=True)
        filled = [one + np.linspace(old - one[0], new - one[-1], times.size) for one, old, new in ends]
        self._latest.extend((*pair, False) for pair in zip(*(one[1:-1].tolist() for one in filled), strict=True))

    def _excess_of_means(self, t: float) -> float:
        """Return the excess of the means over the latest `over` samples; 0 with too few of them.

        Values interpolated for `m` missed samples differ from them by the noise of each and of the two ends: the mean
        of `n` samples is off by at most `sqrt(2 m) / n` of the effect of noise on one.
        """
        pvs, outputs, came = zip(*self._latest, strict=True)
        n, m = len(came), len(came) - sum(came)
        if n - m < LEAST_SHARE * n:
            return 0.0
        share = math.sqrt(2.0 * m) / n
        return max(
            self._excess("PV", self.band.mean_pv, t, sum(pvs) / n, share * self.band.pv_play),
            self._excess("output", self.band.output, t, sum(outputs) / n, share * self.band.output_play),
        )

    def _decided(self, t: float, *, outside: bool) -> Decision:
        self._outside = self._outside + 1 if outside else 0
        if self._outside > max(2, PATIENCE_SHARE * self.band.t.size):
            return Decision.ROLL_BACK
        return Decision.PASS if t >= self.band.t[-1] else Decision.GO_ON

    def _clamped(self, t: float, pv: float) -> float:
        low, high = self.band.pv.low, self.band.pv.high
        return min(max(pv, float(np.interp(t, self.band.t, low))), float(np.interp(t, self.band.t, high)))

    def _without_spike(self, output: float) -> float:
        """Return the output, or the one before where a single one is far from all that is predicted."""
        low, high = float(np.min(self.band.output.low)), float(np.max(self.band.output.high))
        is_spike = max(low - output, output - high) > WILD_SPANS * (high - low)
        if not is_spike or self._wild:
            self._held = output
        self._wild = is_spike
        return self._held

    def _excess(self, name: str, limits: Range, t: float, value: float, margin: float = 0.0) -> float:
        """Return by which share of its range a signal is outside, with a margin, and keep the worst as evidence."""
        low, high = float(np.interp(t, self.band.t, limits.low)), float(np.interp(t, self.band.t, limits.high))
        outside = max(low - value, value - high) - margin
        share = outside / float(np.max(limits.high) - np.min(limits.low))
        if share > self._worst:
            self._worst = share
            self.evidence = f"the {name} left the predicted band by {outside:.3g}, {t:.3g} s after the step"
        return share


ROOM = 0.8
"""Share of the room inside the limits that a step may use."""
SEEN = 10.0
"""Least step in standard deviations of the noise."""
WANTED = 40.0
"""Step in standard deviations of the noise where none is wanted."""
SPANS = 8.0
"""Longest step in dead times and lags of the process and integral times of the controller."""
LONGEST_SAMPLES = 20_000
"""Most scans of a predicted step: bounds the time that the prediction takes."""
AFTER_SETTLING = 1.3
"""Ratio of the length of a step to the predicted settling time, to observe the time after the settling too."""


@dataclass(frozen=True, slots=True)
class Rest:
    """The loop before the step.

    Attributes
    ----------
    pv, output : float
        Where it rests, PV and output units.
    noise_sigma : float
        Standard deviation of the measurement noise, PV units.
    """

    pv: float
    output: float
    noise_sigma: float


@dataclass(frozen=True, slots=True)
class Bounds:
    """Limits of output and PV, their units."""

    output: tuple[float, float]
    pv: tuple[float, float] = (-math.inf, math.inf)


def planned_step(
    model: ProcessModel,
    settings: PidSettings,
    rest: Rest,
    bounds: Bounds,
    *,
    sample_time_s: float,
    scan_s: float | None = None,
    wanted: float | None = None,
    with_load: bool = False,
) -> Scenario | Verdict:
    """Return the step to make, or a refusal where no visible step fits.

    Parameters
    ----------
    model : ProcessModel
        The process.
    settings : PidSettings
        The controller to be verified; its limits are ignored.
    rest : Rest
        The loop before the step.
    bounds : Bounds
        Limits of output and PV.
    sample_time_s : float
        Time between two samples, s.
    scan_s : float, optional
        Time between two steps of the controller, s, at most that of the samples, which is the default; the scenario
        goes by it, or by a larger part of the sample time where there would be too many steps.
    wanted : float, optional
        Size of the set-point step, PV units; `WANTED` standard deviations of the noise by default.
    with_load : bool
        Whether a load of the same weight is put on the output at the same time.
    """
    span_s = SPANS * (model.D + sum_of_lags(model) + (settings.gains.Ti if math.isfinite(settings.gains.Ti) else 0.0))
    h = sample_time_s / _parts(sample_time_s, scan_s or sample_time_s, span_s)
    free = replace(settings, low=-math.inf, high=math.inf, slew_per_s=math.inf)
    load = _load_of(model) if with_load else 0.0
    unit = predict(model, free, Scenario(span_s, h, 1.0, load))
    size = wanted or WANTED * rest.noise_sigma or ROOM * _largest(unit.output, unit.pv, rest, bounds)[0]
    upward, sign = _largest(unit.output, unit.pv, rest, bounds)
    step = min(size, upward)
    if not step > 0.0 or step < SEEN * rest.noise_sigma or not math.isfinite(step):
        return refused(
            "no_room_to_verify",
            f"the limits leave room for a step of {max(upward, 0.0):.3g}, but under {SEEN * rest.noise_sigma:.3g} "
            f"it would not be seen in the noise",
            "Move the loop to the middle of its limits, or verify by watching it.",
        )
    settled_s = max(AFTER_SETTLING * unit.settling_time_s + 2.0 * model.D, 20.0 * sample_time_s)
    return Scenario(min(span_s, settled_s), h, sign * step, sign * step * load)


def _parts(sample_time_s: float, scan_s: float, span_s: float) -> int:
    """Return into how many steps of the controller a sample time is divided."""
    return max(1, min(round(sample_time_s / scan_s), math.floor(LONGEST_SAMPLES * sample_time_s / span_s)))


def _load_of(model: ProcessModel) -> float:
    """Return a load, output units, that moves the PV by one unit as a set point of one unit does."""
    K = model.parameters().get("K", 0.0)
    return 1.0 / K if model.rational().a[0] != 0.0 and K else 0.0


def _largest(output: FloatArray, pv: FloatArray, rest: Rest, bounds: Bounds) -> tuple[float, float]:
    """Return the largest step that stays inside the room, and its sign."""
    sizes = {}
    for sign in (1.0, -1.0):
        by_output = _fits(sign * output, rest.output, bounds.output)
        by_pv = _fits(sign * pv, rest.pv, bounds.pv)
        sizes[sign] = ROOM * min(by_output, by_pv)
    direction = max(sizes, key=lambda sign: sizes[sign])
    return sizes[direction], direction


def _fits(moves: FloatArray, rest: float, limits: tuple[float, float]) -> float:
    """Return by how much a move per unit may be multiplied before it leaves the limits."""
    up, down = float(np.max(moves)), float(-np.min(moves))
    above = (limits[1] - rest) / up if up > 0.0 else math.inf
    below = (rest - limits[0]) / down if down > 0.0 else math.inf
    return min(above, below)
