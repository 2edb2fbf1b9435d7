"""The relay stage: oscillate until period and amplitude, or a model of the process, are known well enough.

    relative error = standard error of the mean / mean,   over the latest settled cycles

Two conditions end it: the cycles agree with each other, or a model fitted to the record so far explains the PV and its
parameters are known to the requested accuracy (`inform`). Neither ends it while further periods would improve the
gains by more than their cost: the expected loss is that of a design which is robust over the model's uncertainty. The
largest number of periods ends it in any case. The first cycle contains the transient and does not count.
Between two half periods the bias and the amplitude of the relay may be adjusted (`adjustment`).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.experiment import refusals
from autotuner.core.experiment.phases import PhaseEvent
from autotuner.core.experiment.relay import SwitchFilter
from autotuner.core.experiment.relay_phase.action_check import ActionCheck
from autotuner.core.experiment.relay_phase.adjustment import (
    adapted,
    is_lopsided,
    one_amplitude_further,
    recentred,
    shifted_in_vain,
    strengthened,
)
from autotuner.core.experiment.relay_phase.check import HalfRelay, Oscillated
from autotuner.core.experiment.relay_phase.steady_state_detector import SteadyStateDetector
from autotuner.core.experiment.step import RunningEstimate, Step
from autotuner.core.signals.detector import Cycle, Detector

if TYPE_CHECKING:
    from autotuner.core.experiment.relay import Relay
    from autotuner.core.experiment.relay_phase.operating_point import OperatingPoint
    from autotuner.core.experiment.settings import ExperimentSettings
    from autotuner.core.recording import Sample
    from autotuner.core.verdict import Verdict

PATIENCE = 10.0
"""Longest half period allowed, as a multiple of the longest one so far."""
CARRIED_OFF = 5.0
"""Half period, as a multiple of the longest one so far, after which the levels follow a PV that a drift or a load has
carried beyond them: half of `PATIENCE`, so that the answer to it can be waited for."""
MAX_RECENTRES = 3
"""Most changes of the relay's centre: each costs about two periods."""
MAX_ADAPTIONS = 8
"""Most changes of the relay's amplitude: each costs about a period."""
LONG_PAST = 4.0
"""Time since a switch, as a multiple of the time before it, after which noise may have caused the switch."""
PAST_THE_ZONE = 2.0
"""Target of a PV that stopped short, under a stronger relay, in half widths of the dead zone."""
SMALL_DRIFT = 1.5
"""Largest drift of the PV over a period that is followed without a request, in amplitudes of the oscillation."""
WORTHWHILE = 0.05
"""Expected loss of the gains, by the uncertainty of the process, above which more periods are worth their time."""
BURIED = 4.5
"""Ratio of amplitude to noise sigma below which noise causes switches and peaks, hysteresis included."""


class Oscillation:
    """The relay: oscillate until period and amplitude are known well enough."""

    def __init__(
        self, rested: OperatingPoint, relay: Relay, started_s: float, *, is_high: bool, from_rest: bool = False
    ) -> None:
        self._rested = rested
        self._from_rest = self._about_rest = from_rest
        self.detector = Detector()
        self._is_high = is_high
        self._use(relay, started_s)
        self._half_started_s = started_s
        self._action_check = ActionCheck(rested, started_s)
        self._recentres = self._adaptions = 0
        self._was_carried_off = False
        self._shifted_from: tuple[Relay, float] | None = None
        self._model_error, self._expected_loss = math.inf, 0.0
        self._first_half_s = 0.0
        self.longest_half_s = rested.half_s

    def step(self, sample: Sample) -> Step:
        """Switch the relay; evaluate each full period; refuse a PV that does not oscillate."""
        is_high = self._switch_filter.switched(self.relay, is_high=self._is_high, pv=sample.pv)
        if is_high != self._is_high:
            self._first_half_s = self._first_half_s or sample.t - self._half_started_s
            self._is_high, self._half_started_s = is_high, sample.t
            self._stall.begin()
        cycle = self.detector.step(sample.t, sample.pv, is_high)
        if cycle is not None:
            return self._judge(cycle, sample.pv)
        known = self._model_error <= self._rested.settings.accuracy
        if self.detector.cycles and known and not self._is_worth_more:
            return self._finish(sample.t, self.detector.cycles[-1:])
        verdict = self._strengthen(sample) if self._hangs(sample.t) else None
        if self._is_carried_off(sample.t):
            self._bring_back(sample)
        return Step(self.relay.level(is_high=is_high), verdict=verdict or self._no_oscillation(sample))

    @property
    def _is_worth_more(self) -> bool:
        """Whether the gains could still win by knowing the process better."""
        return self._expected_loss > WORTHWHILE

    def inform(self, model_error: float, expected_loss: float) -> None:
        """Take the uncertainty of a model that explains the record so far, see `Experiment.inform`."""
        self._model_error, self._expected_loss = model_error, expected_loss

    def settings_so_far(self) -> dict[str, object]:
        """Return the relay and the rest it started from, JSON-ready."""
        return {
            "rest_pv": self._rested.quiet.pv,
            "noise_sigma": self._rested.quiet.noise_sigma,
            "disturbance_sigma": self._rested.quiet.disturbance_sigma,
            "relay_low": self.relay.low,
            "relay_high": self.relay.high,
            "relay_reference": self.relay.reference,
            "hysteresis": self.relay.hysteresis,
            "relay_since_s": self._moved_s,
            "relay_from_rest": self._from_rest,
            "relay_began_high": self._began_high,
        }

    def _judge(self, cycle: Cycle, pv: float) -> Step:
        """Decide at the end of a half period: adjust an asymmetric relay, stop, or continue.

        Switches by noise alone show neither the level of the oscillation nor the length of a half period.
        """
        duty = usual_duty(self.detector.cycles)
        if not self._is_buried(cycle.peak):
            self.longest_half_s = max(self.longest_half_s, self.detector.longest_half_s)
            if is_lopsided(duty) and self._recentres < MAX_RECENTRES and not self._is_shifted_in_vain(duty):
                return self._recentre(cycle, duty, pv)
        if self._adaptions < MAX_ADAPTIONS and (stronger := adapted(self.relay, cycle, self._rested)):
            self._adaptions += 1
            return self._begin_again(cycle, stronger, pv)
        settings = self._rested.settings
        if verdict := self._drifts_too_fast(cycle):
            return Step(self.relay.level(is_high=self._is_high), verdict=verdict)
        settled = settled_cycles(self.detector.cycles, settings)
        accurate = bool(settled) and relative_error(settled) <= settings.accuracy
        if (not accurate or self._is_worth_more) and not self._is_enough(settled):
            return Step(self.relay.level(is_high=self._is_high), estimate=self._estimate(cycle))
        periods = len(self.detector.cycles) // 2
        warning = None if accurate else refusals.not_accurate(relative_error(settled), settings, periods)
        return replace(self._finish(cycle.end_s, settled), warning=warning, estimate=self._estimate(cycle))

    def _is_enough(self, settled: list[Cycle]) -> bool:
        """Return whether the oscillation ends as it is: after the most periods, or before it is carried off again."""
        most = 2 * self._rested.settings.max_periods
        return len(self.detector.cycles) >= most or (self._was_carried_off and bool(settled))

    def _finish(self, t: float, settled: list[Cycle]) -> Step:
        """End the oscillation, unless noise causes it; continue with the check when it is requested."""
        output = self.relay.level(is_high=self._is_high)
        peak = float(np.mean([c.peak for c in settled]))
        if self._is_buried(peak):
            return Step(output, verdict=self._buried(peak))
        if not self._rested.settings.check:
            return Step(output, PhaseEvent.CONVERGED_UNCHECKED)
        following = HalfRelay(Oscillated(self.relay, settled[-1]), t, is_high=self._is_high)
        return Step(following.output, PhaseEvent.CONVERGED, following, segment="half_relay")

    def _drifts_too_fast(self, cycle: Cycle) -> Verdict | None:
        """Refuse a PV whose drift at rest is large compared with the relay's oscillation."""
        rested = self._rested
        if rested.drift is None or not rested.is_followed:
            return None
        too_fast = abs(rested.drift.drift_per_s) * cycle.period_s > SMALL_DRIFT * cycle.peak
        return refusals.drifting(rested.drift, rested.settings) if too_fast else None

    def _is_buried(self, swing: float) -> bool:
        """Return whether noise alone could cause such a swing of the PV."""
        return swing < BURIED * self._rested.quiet.disturbance_sigma

    def _buried(self, swing: float) -> Verdict:
        return refusals.buried(swing, self._rested.quiet.disturbance_sigma, self.relay.amplitude)

    def _estimate(self, cycle: Cycle) -> RunningEstimate:
        alone = self._rested.settings.online is None
        gain = 4.0 * self.relay.amplitude / (math.pi * cycle.peak) if alone and cycle.peak > 0.0 else math.nan
        return RunningEstimate(self.detector.half_periods, cycle.period_s, cycle.peak, cycle.fundamental, gain)

    def _recentre(self, cycle: Cycle, duty: float, pv: float) -> Step:
        settings = self._rested.settings
        self._recentres += 1
        relay = recentred(self.relay, duty, self._rest, settings.relay_limits, settings.limits.pv)
        self._shifted_from = (self.relay, duty) if relay.reference != self.relay.reference else None
        return self._begin_again(cycle, relay, pv)

    @property
    def _rest(self) -> tuple[float, float]:
        """Output and PV at rest."""
        return self._rested.output, self._rested.quiet.pv

    def _is_shifted_in_vain(self, duty: float) -> bool:
        """Return whether another reference made no difference: a further one would only carry the PV away."""
        before = self._shifted_from
        return before is not None and shifted_in_vain(before, (self.relay, duty), self._rest)

    def _begin_again(self, cycle: Cycle, relay: Relay, pv: float) -> Step:
        """Continue with another relay from the end of a period."""
        estimate = self._estimate(cycle)
        self._replace(relay, cycle.end_s, pv)
        return Step(relay.level(is_high=self._is_high), estimate=estimate)

    def _replace(self, relay: Relay, t: float, pv: float) -> None:
        """Continue with another relay: observations of the previous one do not count for the limit cycle."""
        self._from_rest = False
        self._model_error, self._expected_loss = math.inf, 0.0
        self.detector = Detector()
        self._change_to(relay, t, pv)

    def _hangs(self, t: float) -> bool:
        """Return whether nothing oscillated yet, and a single switch, which noise can have made, is long past."""
        if not self._about_rest or self.longest_half_s:
            return False
        return t - self._half_started_s >= LONG_PAST * (self._half_started_s - self._moved_s)

    def _is_carried_off(self, t: float) -> bool:
        """Return whether a PV that oscillated stays on one side; along a line that is followed it has left that."""
        is_long = t - self._half_started_s > CARRIED_OFF * self.longest_half_s > 0.0
        return is_long and self._recentres < MAX_RECENTRES and self._rested.drift is None

    def _bring_back(self, sample: Sample) -> None:
        """Move both levels by an amplitude towards the one in force, not beyond the limits of the output."""
        further = one_amplitude_further(self.relay, self._rested.settings.relay_limits, is_high=self._is_high)
        if further == self.relay:
            return
        self._recentres += 1
        self._was_carried_off, self._half_started_s = True, sample.t
        self._replace(further, sample.t, sample.pv)

    def _strengthen(self, sample: Sample) -> Verdict | None:
        """Strengthen the relay where the PV settled short of the dead zone's edge, or has not responded in time.

        At the largest allowed amplitude, a PV that is still at rest after twice the time is refused.
        """
        moved, edge = self._stall.step(sample.pv), self.relay.hysteresis
        silent = sample.t - self._half_started_s > self._rested.settings.longest_response_s
        if silent and not self._stall.changed:  # the sensor may be dead: no stronger relay
            waited_s = sample.t - self._half_started_s
            return refusals.no_response(self.relay.level(is_high=self._is_high), self._rested.quiet, waited_s)
        short = moved is not None and abs(moved) <= edge
        if not (short or silent):
            return None
        factor = PAST_THE_ZONE * edge / abs(moved) if short and moved else PAST_THE_ZONE
        stronger = strengthened(self.relay, self._rested, factor) if self._adaptions < MAX_ADAPTIONS else None
        if stronger is not None:
            self._adaptions += 1
            self._half_started_s = sample.t
            self._change_to(stronger, sample.t, sample.pv)
        elif short and moved and self._stall.looks > 1:
            return self._too_weak(abs(moved), sample)
        return None

    def _too_weak(self, moved: float, sample: Sample) -> Verdict:
        if self._is_buried(moved):
            return self._buried(moved)
        return self._stopped(sample, sample.t - self._half_started_s)

    def _stopped(self, sample: Sample, waited_s: float) -> Verdict:
        """Refuse a PV that no longer crosses; one that drifted at rest is followed along a line that it has left."""
        if self._rested.drift is not None:
            return refusals.drifting(self._rested.drift, self._rested.settings)
        switches, at_limit = len(self.detector.switch_times_s), self._rested.levels.one_sided
        return refusals.no_oscillation(self.relay, switches, sample.pv, waited_s, at_limit=at_limit)

    def _change_to(self, relay: Relay, t: float, pv: float) -> None:
        """Continue with another relay, which has also seen this reading; a replay of the new relay begins there."""
        self._use(relay, t)
        self._switch_filter.step(pv)

    def _use(self, relay: Relay, t: float) -> None:
        """Begin with a relay."""
        quiet = self._rested.quiet
        self.relay, self._moved_s, self._began_high = relay, t, self._is_high
        self._switch_filter = SwitchFilter(relay.hysteresis, quiet.disturbance_sigma, from_rest=self._from_rest)
        self._stall = SteadyStateDetector(quiet.pv, quiet.noise_sigma, quiet.pv_error)

    def _no_oscillation(self, sample: Sample) -> Verdict | None:
        settings, switches = self._rested.settings, len(self.detector.switch_times_s)
        patience_s = PATIENCE * self.longest_half_s or settings.longest_response_s
        if not self.longest_half_s and settings.response_limit_s is None:
            patience_s = max(patience_s, PATIENCE * self._first_half_s)
        if sample.t - self._half_started_s > patience_s:
            return self._stopped(sample, patience_s)
        if switches or not self._from_rest:
            return None
        return self._action_check.step(sample, is_high=self._is_high)


def usual_duty(cycles: list[Cycle]) -> float:
    """Return the median duty of the latest three cycles: a single wild reading can switch the relay out of turn."""
    return float(np.median([cycle.duty for cycle in cycles[-3:]]))


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
