"""Verification: a step on the real loop that compares its new gains with the prediction.

    take over -> settle -> rest -> predict -> step -> judge,   then gains unless it passed, set point, mode

Invariants:

1. The device's own controller stays in charge: only its set point is moved, inside the limits, and restored.
2. Every way out leads through `_finish`: gains, set point, mode and output are as they should be before it ends.
3. No formula: the plan, the band and the judge are the core's (`autotuner.core.design`), limits are the supervisor's.
"""

from __future__ import annotations

import asyncio
import logging
import math
from typing import TYPE_CHECKING

import numpy as np

from autotuner.control.devices.retrying import quietly, uncancelled
from autotuner.control.driving.drive import drive
from autotuner.control.driving.lease import lease_of
from autotuner.control.driving.own_controller import find_loop, missing_signals
from autotuner.control.driving.settling import AT_REST, SHARP, rests_at
from autotuner.control.records.lease_record import Kind
from autotuner.control.reporting.events import PhaseChanged, SampleTaken
from autotuner.control.verification.verification_events import VerificationPhase
from autotuner.core.design.simulation.verification import (
    Bounds,
    Decision,
    Rest,
    Verification,
    planned_step,
    predicted_band,
)
from autotuner.core.experiment.phases import Phase
from autotuner.core.recording import Sample
from autotuner.core.safety.watches import PROCESS_STALLED
from autotuner.core.signals.quiet import largest_noise, measure_quiet, without_wild
from autotuner.core.verdict import Outcome, Verdict, aborted, failed, refused
from autotuner.errors import AutotunerError, GainsChangedError, ShuttingDownError, StorageError
from autotuner.ports import AUTO, SET_POINT

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine, Mapping

    from autotuner.configuration import LoopTable
    from autotuner.control.compute_port import ComputePool
    from autotuner.control.records.lease_record import Before
    from autotuner.control.records.open_journal import OpenJournal
    from autotuner.control.verification.verification_run import Claim, VerificationRun
    from autotuner.core.design import Scenario
    from autotuner.core.design.simulation.verification import Band
    from autotuner.ports import Backend

    Predicted = tuple[Scenario, Band] | Verdict

REST_SAMPLES = 60
"""Samples of the loop at rest before the step."""
REST_TRIES = 30
"""Number of windows after which the wait for rest ends."""
TAKEN_OVER_FROM = 20
"""Readings of the PV of which the mean is the set point with which the device's controller takes over."""

_log = logging.getLogger(__name__)


def can_verify(backend: Backend) -> bool:
    """Return whether the signals that a verification needs are mapped."""
    return not missing_signals(backend, (SET_POINT,))


class VerificationStage:
    """A verification, sample by sample; see `autotuner.control.driving.drive.Stage`.

    Parameters
    ----------
    found : Before
        How the loop was found.
    settling_s, period_s : float
        Time without a judgement after the take-over by the controller, and sample time, s.
    predict : callable
        Returns the work that predicts the step from how the loop rests.
    run : VerificationRun
        State of the run.

    Attributes
    ----------
    verdict : Verdict or None
        How it ended.
    """

    phase = "verify"

    def __init__(
        self,
        found: Before,
        settling_s: float,
        period_s: float,
        predict: Callable[[Rest], Coroutine[object, object, Predicted]],
        run: VerificationRun,
    ) -> None:
        self.verdict: Verdict | None = None
        self._settling_s, self._period_s, self._predict, self._run = settling_s, period_s, predict, run
        self._next = self._rest if found.auto else self._to_auto
        self._window: list[Sample] = []
        self._since_s = math.nan
        self._tries = 0
        self._prediction: asyncio.Task[Predicted] | None = None
        self._judge: Verification | None = None

    @property
    def complete(self) -> bool:
        """Whether there is a verdict."""
        return self.verdict is not None

    def step(self, sample: Sample) -> Mapping[str, float]:
        """Take a sample; return the values to write."""
        return self._next(sample)

    def record(self, sample: Sample) -> None:
        """Publish a sample; the response is recorded as it is judged."""
        self._run.publish(SampleTaken.of(sample))

    def correct(self, output: float) -> None:
        """Do nothing: the device moves its output."""

    def tolerates(self, verdict: Verdict) -> bool:
        """Return whether it is a stall of this program before the step: nothing was missed that is judged."""
        return verdict.code == PROCESS_STALLED and self._judge is None

    def _enter(self, phase: VerificationPhase, sample: Sample, expected_s: float = math.nan) -> None:
        self._run.enter(phase, sample.t, expected_s)

    async def close(self) -> None:
        """End a running prediction."""
        if self._prediction is not None:
            self._prediction.cancel()
            await asyncio.gather(self._prediction, return_exceptions=True)

    def _to_auto(self, sample: Sample) -> Mapping[str, float]:
        """Let the device's controller take over without a bump: from the present PV as its set point."""
        self._window.append(sample)
        if len(self._window) < TAKEN_OVER_FROM:
            return {}
        set_point = float(np.mean(without_wild(np.array([one.pv for one in self._window]))))
        self._enter(VerificationPhase.SETTLE, sample, self._settling_s)
        self._window, self._since_s, self._next = [], sample.t, self._settle
        return {SET_POINT: set_point, AUTO: 1.0}

    def _settle(self, sample: Sample) -> Mapping[str, float]:
        """Let the first move of the controller die away: its derivative made much of the noise that it took over."""
        if sample.t - self._since_s >= self._settling_s:
            self._next = self._rest
        return {}

    def _rest(self, sample: Sample) -> Mapping[str, float]:
        """Watch the loop until it rests, window by window; then have its step predicted."""
        if not self._tries and not self._window:
            self._enter(VerificationPhase.REST, sample, REST_SAMPLES * self._period_s)
        self._window.append(sample)
        if len(self._window) < REST_SAMPLES:
            return {}
        window, self._window = self._window, []
        self._tries += 1
        t, pv, output = (np.array([getattr(one, name) for one in window]) for name in ("t", "pv", "output"))
        measured = measure_quiet(t, pv)
        noise, set_point = measured.unsure, float(np.nanmedian([one.set_point for one in window]))
        if rests_at(set_point, pv, max(AT_REST * noise, SHARP * abs(set_point))):
            self._run.rest = Rest(set_point, float(np.mean(without_wild(output))), max(noise, largest_noise(pv)))
            self._enter(VerificationPhase.PREDICT, sample)
            self._prediction = asyncio.ensure_future(self._predict(self._run.rest))
            self._next = self._wait
        elif self._tries >= REST_TRIES:
            self.verdict = refused(
                "not_at_rest",
                f"the PV does not rest at its set point: it drifts by {measured.drift_per_s:.3g} per s, "
                f"noise {noise:.3g}",
                "Wait until the loop has settled, then verify again.",
            )
        return {}

    def _wait(self, sample: Sample) -> Mapping[str, float]:
        """Watch the loop until its step is predicted, which may take seconds; then make the step."""
        assert self._prediction is not None  # noqa: S101 - `_rest` has begun it
        if not self._prediction.done():
            return {}
        predicted = self._prediction.result()
        if isinstance(predicted, Verdict):
            self.verdict = predicted
            return {}
        assert self._run.rest is not None  # noqa: S101 - `_rest` has measured it
        scenario, band = self._run.scenario, self._run.band = predicted
        set_point = self._run.rest.pv + scenario.set_point_step
        self._judge, self._since_s, self._next = Verification(band), sample.t, self._follow
        self._enter(VerificationPhase.STEP, sample, scenario.duration_s)
        self._run.take_step(sample.t, set_point)
        return {SET_POINT: set_point}

    def _follow(self, sample: Sample) -> Mapping[str, float]:
        """Judge the response."""
        rest, judge = self._run.rest, self._judge
        assert rest is not None  # noqa: S101 - `_rest` has measured it
        assert judge is not None  # noqa: S101 - `_wait` has made it
        t = sample.t - self._since_s
        self._run.samples.append(Sample(t, sample.pv, sample.output, sample.set_point, sample.lateness_s))
        decision = judge.step(t, sample.pv - rest.pv, sample.output - rest.output)
        if decision is Decision.PASS:
            self.verdict = Verdict(Outcome.DONE, "verified", f"PV and output followed the prediction for {t:.4g} s")
        elif decision is Decision.ROLL_BACK:
            advice = "Run a diagnosis for effects that the model lacks, then tune again or with a calmer goal."
            self.verdict = refused("verification_failed", judge.evidence, advice)
        return {}


class Verifier:
    """Conducts one verification on a device with its own controller.

    Parameters
    ----------
    loop : LoopTable
        The loop.
    backend : Backend
        Its device; opened and closed here.
    claim : Claim
        What is to be verified.
    pool : ComputePool
        Where predictions run.
    undo : callable
        Restores the old gains; called at most once, before anything else is restored.
    run : VerificationRun
        Takes all events.
    journal : OpenJournal or None
        Records disturbances before they happen; None where nothing outlives this program.
    """

    def __init__(
        self,
        loop: LoopTable,
        backend: Backend,
        claim: Claim,
        pool: ComputePool,
        undo: Callable[[], Awaitable[object]],
        run: VerificationRun,
        journal: OpenJournal | None = None,
    ) -> None:
        self._loop, self._claim, self._arithmetic, self._undo, self._run = loop, claim, pool, undo, run
        self._device = backend
        self._lease = lease_of(loop, backend, Kind.VERIFICATION, journal)
        self._journal = journal

    def abort(self, verdict: Verdict) -> None:
        """Request the end: gains, set point and mode are restored."""
        self._lease.abort(verdict)

    @property
    def found(self) -> Before | None:
        """State in which the loop was found, once it is recorded."""
        return self._lease.found

    async def conduct(self) -> Verdict:
        """Make the step and judge it; the verdict is also kept in the run."""
        verdict: Verdict | None = None
        try:
            await self._lease.open()
            found = await find_loop(self._lease.device, "verified", (SET_POINT,))
            verdict = self._unfit(found) or await self._step_and_judge(found)
        except StorageError as error:
            verdict = failed("storage_error", error.finding, error.remedy)
        except AutotunerError as error:
            message = self._lease.verdict if isinstance(error, ShuttingDownError) else None
            verdict = message or failed("device_error", error.finding, error.remedy)
        except asyncio.CancelledError:
            verdict = aborted("cancelled", "the verification was cancelled", "Start it again when wanted.")
            raise
        except Exception as error:  # noqa: BLE001 - whatever it was, the loop must be released
            _log.exception("the verification failed")
            verdict = failed("internal_error", f"{type(error).__name__}: {error}", "Please report this with the log.")
        finally:
            await uncancelled(self._finish(verdict))
        assert self._run.verdict is not None  # noqa: S101 - `_finish` has set it
        return self._run.verdict

    def _unfit(self, found: Before) -> Verdict | None:
        if found.auto or AUTO in self._device.writable:
            return None
        return refused(
            "device_in_manual",
            "the device is in manual, and its mode cannot be written",
            "Put the device to auto, or map auto for writing.",
        )

    async def _step_and_judge(self, found: Before) -> Verdict:
        await self._lease.hold(found)
        stage = VerificationStage(
            found,
            self._claim.settling_s,
            self._lease.ticker.period_s,
            self._predicted,
            self._run,
        )
        try:
            ended = await drive(self._lease, stage)
        finally:
            await stage.close()
        stopped = aborted("stopped", "the verification was stopped", "Start it again.")
        return ended or stage.verdict or stopped

    async def _predicted(self, rest: Rest) -> Predicted:
        """Return the step of the set point with the predicted band, or why no step can be made."""
        claim, loop = self._claim, self._loop
        limits = loop.experiment_settings().limits
        scenario = await self._arithmetic.run(
            planned_step,
            claim.model,
            claim.settings,
            rest,
            Bounds(limits.output, limits.pv),
            sample_time_s=loop.sample_time_s,
            scan_s=claim.scan_s,
            wanted=claim.step,
        )
        if isinstance(scenario, Verdict):
            return scenario
        band = await self._arithmetic.run(
            predicted_band,
            claim.model,
            claim.settings,
            scenario,
            noise_sigma=rest.noise_sigma,
            covariance=claim.covariance,
            timing_s=claim.scan_s,
            sample_time_s=loop.sample_time_s,
            effects=claim.effects,
            rest_output=rest.output,
            rest_samples=REST_SAMPLES,
        )
        return scenario, band

    async def _finish(self, verdict: Verdict | None) -> None:
        lease = self._lease
        verdict = verdict or failed("internal_error", "the verification broke off", "Please report this with the log.")
        lease.abort(verdict)  # whatever ended it, this verdict reports how the loop is released
        goal = await lease.goal() if lease.found is not None else None
        if self._journal is not None and verdict.outcome is Outcome.DONE:
            await self._journal.proved()
        reason, unresolved = verdict, False
        self._run.enter(VerificationPhase.RESTORE, lease.ticker.now_s)
        if verdict.outcome is not Outcome.DONE:
            verdict, unresolved = await self._with_old_gains(verdict)
        if not await lease.release(goal):
            assert lease.found is not None  # noqa: S101 - only what was found is released
            unresolved = True
            verdict = failed(
                "output_unknown",
                f"{verdict.message}; and set point and mode could not be restored: their present values are unknown",
                f"Set the set point to {lease.found.set_point:g} and the output to {lease.found.output:g} by hand.",
            )
        if self._journal is not None and not unresolved:
            self._journal.note(PhaseChanged(lease.ticker.now_s, Phase.ENDED))
        await quietly(lease.close())
        self._run.unresolved = reason if unresolved else None
        self._run.end(verdict, lease.ticker.now_s)

    async def _with_old_gains(self, verdict: Verdict) -> tuple[Verdict, bool]:
        """Restore the gains; return the verdict, and whether it is unknown which gains the device holds."""
        try:
            await self._undo()
        except AutotunerError as error:
            message = f"{verdict.message}; and the old gains are not back: {error}"
            # where another program has set them since, they are its own
            return failed("gains_unknown", message, "Roll back by hand."), not isinstance(error, GainsChangedError)
        self._run.rolled_back = True
        return verdict, False
