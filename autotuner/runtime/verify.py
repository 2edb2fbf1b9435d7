"""The step on the real loop that shows whether its new gains do what was predicted.

    rest -> step -> judge, sample by sample -> step back -> mode back,   and the old gains first unless it passed

Rules of this file:

1. The device's own controller stays in charge: only its set point is moved, inside the limits, and put back.
2. Every way out leads through `_finish`: gains, set point, mode and output are as they should be before it ends.
3. What is found stands in the journal before it is moved, and each move before it is made: what a killed program leaves
   behind is put back in the same order by the next one (`autotuner.runtime.recovery`).
4. No formula: the plan, the band and the judge are the core's (`autotuner.core.tuning`), limits are the supervisor's.
"""

from __future__ import annotations

import asyncio
import logging
import math
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from autotuner.core.phases import Phase
from autotuner.core.recording import Sample
from autotuner.core.safety import Supervisor
from autotuner.core.signals.quiet import largest_noise, measure_quiet
from autotuner.core.tuning.verification import SMOOTHED, Decision, Verification
from autotuner.core.tuning.verification_plan import Rest
from autotuner.core.verdict import Outcome, Verdict, aborted, failed, refused
from autotuner.errors import AutotunerError, DriverError, GainsChangedError, ShuttingDownError, StorageError
from autotuner.ports import AUTO, OUTPUT, PV, SET_POINT
from autotuner.runtime.controller_restore import ControllerRestorer
from autotuner.runtime.events import PhaseChanged
from autotuner.runtime.foretold import REST_SAMPLES, foretold
from autotuner.runtime.patient import Patient
from autotuner.runtime.restore import Before, Restorer, quietly, tolerance_of, uncancelled
from autotuner.runtime.settling import AT_REST, rests_at
from autotuner.runtime.ticker import Stop, Ticker

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine

    from autotuner.configuration import LoopTable
    from autotuner.core.settings import Limits
    from autotuner.ports import Backend
    from autotuner.runtime.arithmetic import Arithmetic
    from autotuner.runtime.open_journal import OpenJournal
    from autotuner.runtime.verification_run import Claim, VerificationRun

T = TypeVar("T")
REST_TRIES = 30
"""How often so many samples are watched until the loop rests."""
SIGNALS = (PV, OUTPUT, SET_POINT, AUTO)

_log = logging.getLogger(__name__)


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
    arithmetic : Arithmetic
        Where predictions run.
    undo : callable
        Puts the old gains back; called at most once, before anything else is given back.
    run : VerificationRun
        Where everything is told.
    journal : OpenJournal or None
        Takes note of what is about to be moved; None where nothing outlives this program.
    """

    def __init__(
        self,
        loop: LoopTable,
        backend: Backend,
        claim: Claim,
        arithmetic: Arithmetic,
        undo: Callable[[], Awaitable[object]],
        run: VerificationRun,
        journal: OpenJournal | None = None,
    ) -> None:
        self._loop, self._claim, self._arithmetic, self._undo, self._run = loop, claim, arithmetic, undo, run
        self._journal = journal
        settings = loop.experiment_settings()
        self._limits: Limits = settings.limits
        self._supervisor = Supervisor(self._limits, loop.safety_settings())
        self._device = backend
        self._backend = Patient(backend)
        self._driven = Patient(backend, self._supervisor.blind_s)
        self._ticker = Ticker(loop.sample_time_s)
        self._stop = Stop()
        self._stop_verdict: Verdict | None = None
        self._moved = self._tripped = False

    def abort(self, verdict: Verdict) -> None:
        """Ask for the end: gains, set point and mode go back."""
        self._stop_verdict = self._stop_verdict or verdict
        self._stop.set()
        self._driven.interrupt()

    async def conduct(self) -> Verdict:
        """Make the step and judge it; the verdict is also kept in the run."""
        verdict: Verdict | None = None
        found: Before | None = None
        try:
            await self._backend.open()
            found = await self._look()
            verdict = self._unfit(found) or await self._step_and_judge(found)
        except StorageError as error:
            verdict = failed("storage_error", error.finding, error.remedy)
        except AutotunerError as error:
            told = self._stop_verdict if isinstance(error, ShuttingDownError) else None
            verdict = told or failed("device_error", error.finding, error.remedy)
        except asyncio.CancelledError:
            verdict = aborted("cancelled", "the verification was cancelled", "Start it again when wanted.")
            raise
        except Exception as error:  # noqa: BLE001 - whatever it was, the loop must be given back
            _log.exception("the verification failed")
            verdict = failed("internal_error", f"{type(error).__name__}: {error}", "Please report this with the log.")
        finally:
            await uncancelled(self._finish(verdict, found))
        assert self._run.verdict is not None  # noqa: S101 - `_finish` has set it
        return self._run.verdict

    async def _look(self) -> Before:
        missing = [name for name in SIGNALS if name not in self._device.readable]
        if missing or SET_POINT not in self._device.writable:
            raise DriverError(
                f"the loop cannot be verified without {', '.join(missing) or 'writing its set_point'}",
                remedy="Map output, set_point and auto of the device's own controller.",
            )
        seen = await self._backend.read(SIGNALS)
        return Before(seen[OUTPUT], seen[AUTO], seen[SET_POINT])

    def _unfit(self, found: Before) -> Verdict | None:
        if found.auto or AUTO in self._device.writable:
            return None
        return refused(
            "device_in_manual",
            "the device is in manual, and its mode cannot be written",
            "Put the device to auto, or map auto for writing.",
        )

    async def _step_and_judge(self, found: Before) -> Verdict:
        if self._journal is not None:
            await self._journal.disturb(found)
        if not found.auto:
            await self._to_auto()
        early = None if found.auto else await self._settled()
        rest = early or await self._rest()
        if isinstance(rest, Verdict):
            return rest
        self._run.rest = rest
        predicted = await self._watching(foretold(self._claim, rest, self._loop, self._arithmetic))
        if isinstance(predicted, Verdict):
            return predicted
        scenario, band = self._run.scenario, self._run.band = predicted
        present = (await self._driven.read([SET_POINT]))[SET_POINT]
        await self._move_set_point(present + scenario.set_point_step)
        return await self._judge(Verification(band), rest)

    async def _watching(self, work: Coroutine[object, object, T | Verdict]) -> T | Verdict:
        """Return what work comes to; the loop is watched meanwhile, for a prediction may take seconds."""
        task = asyncio.ensure_future(work)
        try:
            while not task.done():
                sample = await self._sample()
                if isinstance(sample, Verdict):
                    return sample
            return task.result()
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    async def _to_auto(self) -> None:
        """Let the device's controller take over without a bump: from the present PV as its set point."""
        seen: list[Sample] = []
        while len(seen) < SMOOTHED and not self._stop.is_set():
            tick = await self._ticker.tick(self._stop)
            if tick is not None:
                read = await self._driven.read([PV, OUTPUT])
                seen.append(Sample(tick.t, read[PV], read[OUTPUT]))
        await self._move_set_point(float(np.mean([sample.pv for sample in seen])))
        if self._journal is not None:
            await self._journal.mode(1.0)
        await self._driven.write({AUTO: 1.0})

    async def _move_set_point(self, value: float) -> None:
        if self._journal is not None:
            await self._journal.set_point(value)
        self._moved = True
        await self._driven.write({SET_POINT: value})

    async def _settled(self) -> Verdict | None:
        """Let the first move of the controller die away: its derivative made much of the noise that it took over from.

        Returns a verdict when the verification must end.
        """
        end_s = self._ticker.now_s + self._claim.settling_s
        while self._ticker.now_s < end_s:
            sample = await self._sample()
            if isinstance(sample, Verdict):
                return sample
        return None

    async def _rest(self) -> Rest | Verdict:
        """Watch the loop until it rests; return how, or why not."""
        measured, noise = None, math.nan
        for _ in range(REST_TRIES):
            window: list[Sample] = []
            while len(window) < REST_SAMPLES:
                sample = await self._sample()
                if isinstance(sample, Verdict):
                    return sample
                window += [] if sample is None else [sample]
            t, pv, output = (np.array([getattr(s, name) for s in window]) for name in ("t", "pv", "output"))
            measured = measure_quiet(t, pv)
            noise, set_point = measured.unsure, window[-1].set_point
            if rests_at(set_point, pv, AT_REST * noise):
                return Rest(set_point, float(np.mean(output)), max(noise, largest_noise(pv)))
        drift = measured.drift_per_s if measured else math.nan
        return refused(
            "not_at_rest",
            f"the PV does not rest at its set point: it drifts by {drift:.3g} per s, noise {noise:.3g}",
            "Wait until the loop has settled, then verify again.",
        )

    async def _judge(self, judge: Verification, rest: Rest) -> Verdict:
        start_s = self._ticker.now_s
        while True:
            sample = await self._sample()
            if isinstance(sample, Verdict):
                return sample
            if sample is None:
                continue
            t = sample.t - start_s
            self._run.samples.append(Sample(t, sample.pv, sample.output, sample.set_point, sample.lateness_s))
            decision = judge.step(t, sample.pv - rest.pv, sample.output - rest.output)
            if decision is Decision.PASS:
                return Verdict(Outcome.DONE, "verified", f"PV and output did for {t:.4g} s what was predicted")
            if decision is Decision.ROLL_BACK:
                return refused(
                    "not_as_predicted", judge.evidence, "Look for what the model lacks, then tune again or more calmly."
                )

    async def _sample(self) -> Sample | Verdict | None:
        """Return the next sample; None when it was lost, a verdict when the verification must end."""
        tick = await self._ticker.tick(self._stop)
        if tick is None:
            return self._stop_verdict or aborted("stopped", "the verification was stopped", "Start it again.")
        try:
            seen = await self._driven.read(SIGNALS)
        except DriverError as error:
            lost = self._supervisor.check_failure(tick.t, self._driven.stood_still_s(tick), error)
            return self._tripped_by(lost) if lost else None
        sample = Sample(tick.t, seen[PV], seen[OUTPUT], seen[SET_POINT], tick.lateness_s)
        if not seen[AUTO]:
            return aborted("mode_changed", "the device went to manual", "Somebody took the loop over.")
        # the device moves its output, we its set point: neither is for the supervisor to judge
        watched = Sample(tick.t, seen[PV], self._limits.output[0], math.nan, tick.lateness_s)
        verdict = self._supervisor.check(watched, phase="verify", still_s=self._driven.stood_still_s(tick))
        return self._tripped_by(verdict) if verdict else sample if math.isfinite(sample.pv) else None

    def _tripped_by(self, verdict: Verdict) -> Verdict:
        self._tripped = True
        return verdict

    async def _finish(self, verdict: Verdict | None, found: Before | None) -> None:
        verdict = verdict or failed("internal_error", "the verification broke off", "Please report this with the log.")
        target = self._target(verdict, found) if found is not None and self._moved else None
        await self._note_decision(verdict, target)
        self._run.reason, self._run.settled = verdict, True
        if verdict.outcome is not Outcome.DONE:
            verdict = await self._with_old_gains(verdict)
        if found is not None and self._moved and not await self._restorer().restore(found, target):
            self._run.settled = False
            verdict = failed(
                "output_unknown",
                f"{verdict.message}; and set point and mode could not be put back, what they are now is unknown",
                f"Set the set point to {found.set_point:g} and the output to {found.output:g} by hand.",
            )
        if self._journal is not None and self._run.settled:
            self._journal.note(PhaseChanged(self._ticker.now_s, Phase.ENDED))
        await quietly(self._backend.close())
        self._run.verdict = verdict

    def _target(self, verdict: Verdict, found: Before) -> float | None:
        """Return the output at which the loop ends by way of manual; None leaves output and mode to the device."""
        if verdict.code == "mode_changed" or (found.auto and not (self._tripped and AUTO in self._device.writable)):
            return None
        safe = self._limits.safe_output if self._tripped else None
        return found.output if safe is None else safe

    async def _note_decision(self, verdict: Verdict, target: float | None) -> None:
        """Have the next program decide as this one, should it not get to the end."""
        if self._journal is None:
            return
        if verdict.outcome is Outcome.DONE:
            await self._journal.proved()
        if target is not None:
            await self._journal.aim(target)

    async def _with_old_gains(self, verdict: Verdict) -> Verdict:
        try:
            await self._undo()
        except AutotunerError as error:
            self._run.settled = isinstance(error, GainsChangedError)  # they are somebody else's by now
            return failed(
                "gains_unknown", f"{verdict.message}; and the old gains are not back: {error}", "Roll back by hand."
            )
        self._run.rolled_back = True
        return verdict

    def _restorer(self) -> ControllerRestorer:
        tolerance, limit_s = tolerance_of(self._limits), self._loop.restore_limit_s
        output = Restorer(self._backend, self._supervisor, self._ticker, lambda _: None, limit_s, tolerance)
        return ControllerRestorer(output, self._journal)
