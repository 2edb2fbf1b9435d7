"""The stages of the relay experiment: rest, push, oscillation. Each decides the output while it lasts.

Rules of this file:

1. A stage is made with all that it needs and answers every sample with a `Step`; it knows neither its successor's
inside nor
   inside nor the phase table.
2. A stage ends by itself: with an event, or with a refusal that carries numbers and advice.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core import refusals
from autotuner.core.approach import Approach
from autotuner.core.check import HalfRelay, Oscillated
from autotuner.core.phases import PhaseEvent
from autotuner.core.recentre import is_lopsided, recentred
from autotuner.core.relay import Relay
from autotuner.core.signals.detector import Cycle, Detector
from autotuner.core.signals.quiet import QuietMeasurement, measure_quiet
from autotuner.core.step import RunningEstimate, Step

if TYPE_CHECKING:
    from autotuner.core.recording import Sample
    from autotuner.core.relay import Levels
    from autotuner.core.settings import ExperimentSettings
    from autotuner.core.verdict import Verdict

MIN_QUIET_SAMPLES = 20
NOISE_MULTIPLE = 3.0
"""Hysteresis over noise sigma: a noise sample then crosses it once in 700."""
APPROACH_MULTIPLE = 3.0
"""Move of the PV that counts as an answer to the push, in hystereses."""
WRONG_WAY_MULTIPLE = 10.0
WRONG_WAY_SHARE = 1e-3
"""Move of the PV against the declared action that refuses it: in hystereses, and as a share of the PV itself."""
PATIENCE = 10.0
"""Longest half period allowed, in longest half periods seen so far."""
MAX_RECENTRES = 3
BURIED = 4.5
"""Amplitude over noise sigma under which switches and peaks are made by the noise, hysteresis included."""


@dataclass(frozen=True, slots=True)
class Rested:
    """A loop at rest: what the later stages start from.

    Attributes
    ----------
    settings : ExperimentSettings
        How the experiment is run.
    output : float
        Output at rest, output units.
    levels : Levels
        Relay levels placed around it.
    quiet : QuietMeasurement
        What was measured at rest.
    """

    settings: ExperimentSettings
    output: float
    levels: Levels
    quiet: QuietMeasurement

    @property
    def hysteresis(self) -> float:
        """Half width of the relay's dead zone, PV units."""
        if self.settings.hysteresis is not None:
            return self.settings.hysteresis
        return max(NOISE_MULTIPLE * self.quiet.noise_sigma, self.quiet.resolution)

    def relay_about(self, reference: float) -> Relay:
        """Return the relay that switches around `reference`, PV units."""
        direct = self.settings.direct
        return Relay(self.levels.low, self.levels.high, reference, self.hysteresis, direct=direct)

    def wrong_way(self, pv: float, *, is_high: bool) -> Verdict | None:
        """Return a refusal when the push to one level has moved the PV clearly against the declared action."""
        moved = (pv - self.quiet.pv) * (1.0 if is_high == self.settings.direct else -1.0)
        clear = WRONG_WAY_MULTIPLE * max(self.hysteresis, self.quiet.noise_sigma, self.quiet.resolution)
        if moved >= -max(clear, WRONG_WAY_SHARE * abs(self.quiet.pv), 1e-9):
            return None
        level = self.levels.high if is_high else self.levels.low
        return refusals.wrong_way(-moved, level, direct=self.settings.direct)


class Rest:
    """Hold the output and measure noise, drift, resolution and sampling."""

    def __init__(self, settings: ExperimentSettings, output: float, levels: Levels) -> None:
        self._settings = settings
        self._output = output
        self._levels = levels
        self._samples: list[tuple[float, float]] = []

    def step(self, sample: Sample) -> Step:
        """Collect; at the end go on to the relay, or refuse a PV that drifts."""
        self._samples.append((sample.t, sample.pv))
        watched_s = sample.t - self._samples[0][0]
        if watched_s < self._settings.quiet_duration_s or len(self._samples) < MIN_QUIET_SAMPLES:
            return Step(self._output)
        t, pv = np.array(self._samples).T
        quiet = measure_quiet(t, pv)
        if quiet.drifts:
            return Step(self._output, verdict=refusals.drifting(quiet))
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
        self._is_high = rested.output < (levels.low + levels.high) / 2.0
        answer = max(APPROACH_MULTIPLE * rested.hysteresis, WRONG_WAY_SHARE * abs(quiet.pv), 1e-9)
        self._approach = Approach(started_s, quiet.pv, answer)
        self.level = levels.high if self._is_high else levels.low

    def step(self, sample: Sample) -> Step:
        """Wait for the reference; refuse silence, and an answer in the wrong direction."""
        rested = self._rested
        limit_s = rested.settings.response_limit_s
        if verdict := rested.wrong_way(sample.pv, is_high=self._is_high):
            return Step(self.level, verdict=verdict)
        reference = self._approach.step(sample.t, sample.pv)
        if reference is not None:
            relay = rested.relay_about(reference)
            oscillation = Oscillation(rested, relay, sample.t, is_high=self._is_high)
            return Step(oscillation.step(sample).output, PhaseEvent.APPROACHED, oscillation, segment="relay")
        if sample.t - self._started_s > limit_s:
            return Step(self.level, verdict=refusals.no_response(self.level, rested.quiet, limit_s))
        return Step(self.level)


class Oscillation:
    """The relay: oscillate until period and amplitude are known well enough."""

    def __init__(
        self, rested: Rested, relay: Relay, started_s: float, *, is_high: bool, from_rest: bool = False
    ) -> None:
        self._rested = rested
        self._from_rest = from_rest
        self.relay = relay
        self.detector = Detector()
        self._is_high = is_high
        self._half_started_s = started_s
        self._recentres = 0

    def step(self, sample: Sample) -> Step:
        """Switch the relay; judge each full period; refuse what does not oscillate."""
        is_high = self.relay.switched(is_high=self._is_high, pv=sample.pv)
        if is_high != self._is_high:
            self._is_high, self._half_started_s = is_high, sample.t
        cycle = self.detector.step(sample.t, sample.pv, is_high=is_high)
        if cycle is not None:
            return self._judge(cycle)
        verdict = self._no_oscillation(sample)
        return Step(self.relay.level(is_high=is_high), verdict=verdict)

    def settings_seen(self) -> dict[str, object]:
        """Return the relay and the rest it started from, JSON-ready."""
        return {
            "rest_pv": self._rested.quiet.pv,
            "noise_sigma": self._rested.quiet.noise_sigma,
            "relay_low": self.relay.low,
            "relay_high": self.relay.high,
            "relay_reference": self.relay.reference,
            "hysteresis": self.relay.hysteresis,
        }

    def _judge(self, cycle: Cycle) -> Step:
        """Decide at the end of a half period: move a lopsided relay, stop, or go on."""
        output, estimate = self.relay.level(is_high=self._is_high), self._estimate(cycle)
        if is_lopsided(cycle.duty) and self._recentres < MAX_RECENTRES:
            return self._recentre(cycle)
        settled, settings = settled_cycles(self.detector.cycles, self._rested.settings), self._rested.settings
        accurate = bool(settled) and relative_error(settled) <= settings.accuracy
        if not accurate and len(self.detector.cycles) < 2 * settings.max_periods:
            return Step(output, estimate=estimate)
        peak, sigma = float(np.mean([c.peak for c in settled])), self._rested.quiet.noise_sigma
        if peak < BURIED * sigma:
            return Step(output, verdict=refusals.buried(peak, sigma, self.relay.amplitude), estimate=estimate)
        warning = None if accurate else refusals.not_accurate(relative_error(settled), settings)
        if not settings.check:
            return Step(output, PhaseEvent.CONVERGED_UNCHECKED, estimate=estimate, warning=warning)
        following = HalfRelay(Oscillated(self.relay, cycle), cycle.end_s, is_high=self._is_high)
        return Step(
            following.output, PhaseEvent.CONVERGED, following, estimate=estimate, warning=warning, segment="half_relay"
        )

    def _estimate(self, cycle: Cycle) -> RunningEstimate:
        gain = 4.0 * self.relay.amplitude / (math.pi * cycle.peak) if cycle.peak > 0.0 else math.inf
        return RunningEstimate(len(self.detector.half_periods_s()), cycle.period_s, cycle.peak, cycle.fundamental, gain)

    def _recentre(self, cycle: Cycle) -> Step:
        rested, estimate = self._rested, self._estimate(cycle)
        self._recentres += 1
        self.detector = Detector()
        self.relay = recentred(self.relay, cycle.duty, (rested.output, rested.quiet.pv), rested.settings.limits.output)
        return Step(self.relay.level(is_high=self._is_high), estimate=estimate)

    def _no_oscillation(self, sample: Sample) -> Verdict | None:
        halves = self.detector.half_periods_s()
        settings, switches = self._rested.settings, len(self.detector.switch_times_s)
        patience_s = PATIENCE * max(halves) if len(halves) >= 2 else settings.response_limit_s
        if sample.t - self._half_started_s > patience_s:
            return refusals.no_oscillation(self.relay, switches, sample.pv, patience_s)
        if switches or not self._from_rest:
            return None
        return self._rested.wrong_way(sample.pv, is_high=self._is_high)


def settled_cycles(cycles: list[Cycle], settings: ExperimentSettings) -> list[Cycle]:
    """Return the cycles that count, none while there are too few.

    The first cycle still carries the transient. Of the others the latest half counts, `min_periods` periods at least; a
    cycle is reported every half period.
    """
    settled, fewest = cycles[1:], 2 * settings.min_periods - 1
    return settled[-max(fewest, len(settled) // 2) :] if len(settled) >= fewest else []


def relative_error(cycles: list[Cycle]) -> float:
    """Return the larger relative standard error of the mean of period and peak amplitude.

    Neighbouring cycles share a half period, so n of them count as n/2.
    """
    columns = np.array([(c.period_s, c.peak) for c in cycles])
    errors = columns.std(axis=0, ddof=1) / np.sqrt(len(cycles) / 2.0) / np.abs(columns.mean(axis=0))
    return float(errors.max())
