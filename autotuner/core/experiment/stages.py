"""The first stages of the experiment: rest, and the push off a limit of the output.

Invariants of the stages:

1. A stage is made with all that it needs and answers every sample with a `Step`; it does not know the phase table.
2. A stage always ends: with an event, or with a refusal with numbers and advice.

Finding a PV to oscillate about when the present output lies at the edge of the relay's range.

A loop at rest with its output at a limit (a cold oven at 0 %) has its equilibrium at the edge: a relay about the
present PV would never switch back. So the output is held at the far level until the PV has answered and moved on, and
the reference is put on that way:

    t1   time until the PV has moved by `threshold`
    r1   rise of the PV from t1 to 2 t1,   r2   rise from 2 t1 to 3 t1
    reference = pv0 + (1/2 + 1/2 r2/r1) (pv(3 t1) - pv0),  r2/r1 limited to 0..1

`r2/r1` near 1 is a lag-dominated process, far from settled: its PV itself serves. Near 0 it has settled: half way up
serves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.experiment import refusals
from autotuner.core.experiment.baseline import Baseline, grows, line_of
from autotuner.core.experiment.phases import PhaseEvent
from autotuner.core.experiment.relay_phase.action_check import ActionCheck
from autotuner.core.experiment.relay_phase.operating_point import OperatingPoint
from autotuner.core.experiment.relay_phase.oscillation import Oscillation
from autotuner.core.experiment.step import Step
from autotuner.core.signals.quiet import measure_quiet

if TYPE_CHECKING:
    from autotuner.core.experiment.baseline import Line
    from autotuner.core.experiment.relay import Levels
    from autotuner.core.experiment.settings import ExperimentSettings
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.recording import Sample
    from autotuner.core.signals.quiet import QuietMeasurement

MIN_QUIET_SAMPLES = 20
"""Fewest samples at rest: their standard deviation is then known to a sixth."""
LONGEST_REST = 20.0
"""Longest wait for a drift that can be foreseen, in quiet times."""
STRAIGHT = 1.25
"""Spread about a line, in the noise of neighbouring readings, up to which a drift is straight: two errors of 50."""
LONGEST_DOUBT = 5.0
"""Longest wait for that, in quiet times: slow noise stays, a load step that fell into the rest has settled."""
ANSWER_MULTIPLE = 3.0
"""Move of the PV that counts as an answer to the push, in hystereses."""


class Rest:
    """Hold the output and measure noise, drift, resolution and sampling.

    Parameters
    ----------
    settings : ExperimentSettings
        How the experiment is run.
    output : float
        Output that is held, output units.
    levels : Levels
        Relay levels placed around it.
    left : Oscillation, optional
        An earlier relay that followed a line which the PV left: now a relay about a fixed reference works against a
        drift.
    """

    def __init__(
        self, settings: ExperimentSettings, output: float, levels: Levels, left: Oscillation | None = None
    ) -> None:
        self._settings = settings
        self._output = output
        self._levels = levels
        self._follows = left is None
        self._half_s = 0.0 if left is None else left.longest_half_s
        self._samples: list[tuple[float, float]] = []
        self._started_s = math.inf

    def step(self, sample: Sample) -> Step:
        """Collect samples; at the end continue with the relay; refuse a PV that drifts, or follow its drift."""
        self._samples.append((sample.t, sample.pv))
        self._started_s = min(self._started_s, sample.t)
        watched_s = sample.t - self._samples[0][0]
        if watched_s < self._settings.quiet_duration_s or len(self._samples) < MIN_QUIET_SAMPLES:
            return Step(self._output)
        t, pv = np.array(self._samples).T
        quiet = measure_quiet(t, pv)
        if not quiet.drifts and (self._follows or self._is_straight(quiet, sample.t)):
            return self._go_on(sample, quiet)
        if self._settings.online is not None:  # the controller moves the output against the drift: no line to follow
            return Step(self._output, verdict=refusals.drifting(quiet, self._settings))
        return self._with_drift(t, pv, quiet, sample)

    def _with_drift(self, t: FloatArray, pv: FloatArray, quiet: QuietMeasurement, sample: Sample) -> Step:
        """Follow a drift that is a line; wait for one that bends, and work against one that does not come to rest.

        After a relay the PV bends back, which over few samples resembles noise.
        """
        line = line_of(t, pv)
        if line is not None and self._is_straight(quiet, sample.t):
            return self._along(line, quiet, sample) if self._follows else self._against(t, pv, quiet, sample)
        doubted = line is None and self._has_rested(LONGEST_DOUBT, sample.t)
        if doubted and (not self._follows or grows(t, pv)):
            return self._against(t, pv, quiet, sample)
        if doubted and self._has_rested(LONGEST_REST, sample.t):
            return Step(self._output, verdict=refusals.drifting(quiet, self._settings))
        del self._samples[: len(self._samples) // 2]  # measured again when as many new ones have come
        return Step(self._output)

    def _has_rested(self, quiet_times: float, t: float) -> bool:
        return t - self._started_s > quiet_times * self._settings.quiet_duration_s

    def _is_straight(self, quiet: QuietMeasurement, t: float) -> bool:
        return quiet.spread <= STRAIGHT * quiet.noise_sigma or self._has_rested(LONGEST_DOUBT, t)

    def _along(self, line: Line, quiet: QuietMeasurement, sample: Sample) -> Step:
        """Begin a relay about a reference that moves with the drift."""
        level = [(t, pv - line.at(t) + line.pv) for t, pv in self._samples]
        baseline = Baseline(line, self._output, 1.0 if self._settings.direct else -1.0)
        drift = None if self._settings.drift_compensation else quiet
        return replace(self._go_on(sample, measure_quiet(*np.array(level).T), drift), baseline=baseline)

    def _against(self, t: FloatArray, pv: FloatArray, quiet: QuietMeasurement, sample: Sample) -> Step:
        """Begin a relay about the present PV: its duty balances what moves the PV, as far as the output reaches."""
        bend = np.polyfit(t - t[-1], pv, 2)
        rested = measure_quiet(t, pv - np.polyval(bend[:2], t - t[-1]) * (t - t[-1]))
        return self._go_on(sample, rested, quiet, follows=False)

    def _go_on(
        self, sample: Sample, quiet: QuietMeasurement, drift: QuietMeasurement | None = None, *, follows: bool = True
    ) -> Step:
        """Begin the relay phase; `drift` is the rest of a drifting PV, which a relay that follows must find small."""
        rested = OperatingPoint(self._settings, self._output, self._levels, quiet, drift, follows, self._half_s)
        if self._levels.one_sided:
            push = Push(rested, sample.t)
            return Step(push.level, PhaseEvent.RESTED_AT_LIMIT, push)
        oscillation = Oscillation(rested, rested.relay_about(quiet.pv), sample.t, is_high=True, from_rest=True)
        return Step(oscillation.step(sample).output, PhaseEvent.RESTED, oscillation, segment="relay")


class Push:
    """From an output at its limit: hold the far level until the PV can oscillate about a value (see `approach`)."""

    def __init__(self, rested: OperatingPoint, started_s: float) -> None:
        levels, quiet = rested.levels, rested.quiet
        self._rested = rested
        self._started_s = started_s
        self._action_check = ActionCheck(rested, started_s)
        self._is_high = rested.output < (levels.low + levels.high) / 2.0
        answer = max(ANSWER_MULTIPLE * rested.hysteresis, rested.perceptible)
        rises = 1.0 if self._is_high == rested.settings.direct else -1.0
        self._approach = Approach(started_s, quiet.pv, answer, rises)
        self.level = levels.high if self._is_high else levels.low

    def step(self, sample: Sample) -> Step:
        """Wait for the reference; refuse silence, and an answer in the wrong direction."""
        rested = self._rested
        limit_s = rested.settings.longest_response_s
        if verdict := self._action_check.step(sample, is_high=self._is_high):
            return Step(self.level, verdict=verdict)
        reference = self._approach.step(sample.t, sample.pv)
        if reference is not None:
            relay = rested.relay_about(reference)
            oscillation = Oscillation(rested, relay, sample.t, is_high=self._is_high)
            return Step(oscillation.step(sample).output, PhaseEvent.APPROACHED, oscillation, segment="relay")
        if sample.t - self._started_s > limit_s:
            return Step(self.level, verdict=refusals.no_response(self.level, rested.quiet, limit_s))
        return Step(self.level)


@dataclass(slots=True)
class Approach:
    """The push towards the far level.

    Attributes
    ----------
    started_s : float
        Time of the push, s.
    pv0 : float
        PV at rest, PV units.
    threshold : float
        Move of the PV that counts as an answer, PV units.
    direction : float
        +1 where the push raises the PV by the declared action, -1 where it lowers it.
    """

    started_s: float
    pv0: float
    threshold: float
    direction: float
    _marks: list[float] = field(default_factory=list)
    _answered_s: float | None = None

    def step(self, t: float, pv: float) -> float | None:
        """Take a sample; return the reference once it is found.

        The marks are the PV at `t1`, `2 t1` and `3 t1` after the push.
        """
        elapsed = t - self.started_s
        if self._answered_s is None:
            if self.direction * (pv - self.pv0) < self.threshold:
                return None
            self._answered_s = elapsed
        if elapsed >= self._answered_s * (len(self._marks) + 1):
            self._marks.append(pv)
        if len(self._marks) < 3:
            return None
        first, second, third = self._marks
        slowing = (third - second) / (second - first) if second != first else 0.0
        return self.pv0 + (0.5 + 0.5 * min(max(slowing, 0.0), 1.0)) * (third - self.pv0)
