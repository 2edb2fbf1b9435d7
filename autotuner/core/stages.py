"""The first stages of the experiment: rest, and the push off a limit of the output.

Rules of the stages:

1. A stage is made with all that it needs and answers every sample with a `Step`; it does not know the phase table.
2. A stage ends by itself: with an event, or with a refusal that carries numbers and advice.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core import refusals
from autotuner.core.approach import Approach
from autotuner.core.baseline import Baseline, line_of
from autotuner.core.oscillation import Oscillation
from autotuner.core.phases import PhaseEvent
from autotuner.core.rested import Rested
from autotuner.core.signals.quiet import measure_quiet
from autotuner.core.step import Step
from autotuner.core.wrong_way import WrongWay

if TYPE_CHECKING:
    from autotuner.core.recording import Sample
    from autotuner.core.relay import Levels
    from autotuner.core.settings import ExperimentSettings
    from autotuner.core.signals.quiet import QuietMeasurement

MIN_QUIET_SAMPLES = 20
LONGEST_REST = 20.0
"""Longest wait for a drift that can be foreseen, in quiet times."""
ANSWER_MULTIPLE = 3.0
"""Move of the PV that counts as an answer to the push, in hystereses."""


class Rest:
    """Hold the output and measure noise, drift, resolution and sampling."""

    def __init__(self, settings: ExperimentSettings, output: float, levels: Levels) -> None:
        self._settings = settings
        self._output = output
        self._levels = levels
        self._samples: list[tuple[float, float]] = []
        self._started_s = math.inf

    def step(self, sample: Sample) -> Step:
        """Collect; at the end go on to the relay; refuse a PV that drifts, or follow it from now on."""
        self._samples.append((sample.t, sample.pv))
        self._started_s = min(self._started_s, sample.t)
        watched_s = sample.t - self._samples[0][0]
        if watched_s < self._settings.quiet_duration_s or len(self._samples) < MIN_QUIET_SAMPLES:
            return Step(self._output)
        t, pv = np.array(self._samples).T
        quiet = measure_quiet(t, pv)
        if not quiet.drifts:
            return self._go_on(sample, quiet)
        settings = self._settings
        if not settings.drift_compensation or sample.t - self._started_s > LONGEST_REST * settings.quiet_duration_s:
            return Step(self._output, verdict=refusals.drifting(quiet, settings))
        line = line_of(t, pv)
        if line is None:  # it bends: look again when half of these samples are gone
            del self._samples[: len(self._samples) // 2]
            return Step(self._output)
        level = pv - np.array([line.at(moment) - line.pv for moment in t])
        baseline = Baseline(line, self._output, 1.0 if settings.direct else -1.0)
        return replace(self._go_on(sample, measure_quiet(t, level)), baseline=baseline)

    def _go_on(self, sample: Sample, quiet: QuietMeasurement) -> Step:
        rested = Rested(self._settings, self._output, self._levels, quiet)
        if self._levels.one_sided:
            push = Push(rested, sample.t)
            return Step(push.level, PhaseEvent.RESTED_AT_LIMIT, push)
        oscillation = Oscillation(rested, rested.relay_about(quiet.pv), sample.t, is_high=True, from_rest=True)
        return Step(oscillation.step(sample).output, PhaseEvent.RESTED, oscillation, segment="relay")


class Push:
    """From an output at its limit: hold the far level until there is a PV to oscillate about (see `approach`)."""

    def __init__(self, rested: Rested, started_s: float) -> None:
        levels, quiet = rested.levels, rested.quiet
        self._rested = rested
        self._started_s = started_s
        self._wrong_way = WrongWay(rested, started_s)
        self._is_high = rested.output < (levels.low + levels.high) / 2.0
        answer = max(ANSWER_MULTIPLE * rested.hysteresis, rested.perceptible)
        self._approach = Approach(started_s, quiet.pv, answer)
        self.level = levels.high if self._is_high else levels.low

    def step(self, sample: Sample) -> Step:
        """Wait for the reference; refuse silence, and an answer in the wrong direction."""
        rested = self._rested
        limit_s = rested.settings.response_limit_s
        if verdict := self._wrong_way.step(sample, is_high=self._is_high):
            return Step(self.level, verdict=verdict)
        reference = self._approach.step(sample.t, sample.pv)
        if reference is not None:
            relay = rested.relay_about(reference)
            oscillation = Oscillation(rested, relay, sample.t, is_high=self._is_high)
            return Step(oscillation.step(sample).output, PhaseEvent.APPROACHED, oscillation, segment="relay")
        if sample.t - self._started_s > limit_s:
            return Step(self.level, verdict=refusals.no_response(self.level, rested.quiet, limit_s))
        return Step(self.level)
