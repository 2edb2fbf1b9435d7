"""The relay controller: experiment and device, sample by sample.

    read -> supervise -> step -> permit -> write -> record,   once a tick

Rules of this file:

1. No formula and no decision: the experiment decides, the supervisor permits, the ticker tells the time.
2. From the first write on, every way out leads through `Restorer.restore`.
3. A failed read is trouble: the supervisor decides how long the loop may go blind. A failed write is the end, because
   nobody knows what the device holds now. A device that says itself that it is gone is not waited for.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from dataclasses import asdict, replace
from typing import TYPE_CHECKING

from autotuner.core.experiment import Experiment
from autotuner.core.line_quality import line_warnings
from autotuner.core.phases import Phase
from autotuner.core.read_back import ReadBack
from autotuner.core.recording import Sample
from autotuner.core.safety import DRIVEN_BY_OTHERS
from autotuner.core.verdict import aborted, failed, refused
from autotuner.errors import DriverError, StorageError
from autotuner.ports import AUTO, OUTPUT, PV, SET_POINT, Watchful
from autotuner.runtime.enough import wait_no_more
from autotuner.runtime.events import EstimateUpdated, LinkTrouble, PhaseChanged, SampleTaken
from autotuner.runtime.patient import Patient
from autotuner.runtime.ranges import unholdable
from autotuner.runtime.read_surely import read_surely
from autotuner.runtime.restore import Before, Restorer, tolerance_of, uncancelled
from autotuner.runtime.ticker import Stop
from autotuner.runtime.timed import repeated_by, timed

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from autotuner.core.experiment import Command
    from autotuner.core.safety import Supervisor
    from autotuner.core.settings import ExperimentSettings
    from autotuner.core.verdict import Verdict
    from autotuner.ports import Backend
    from autotuner.runtime.events import Event
    from autotuner.runtime.open_journal import OpenJournal
    from autotuner.runtime.ticker import Tick, Ticker

_log = logging.getLogger(__name__)


class Controller:
    """Conducts one experiment on one device.

    Parameters
    ----------
    backend : Backend
        The device; opened and closed here.
    settings : ExperimentSettings
        How the experiment is run.
    supervisor : Supervisor
        Has the last word on every write.
    ticker : Ticker
        The clock.
    publish : callable
        Takes events as they happen.
    restore_limit_s : float
        Longest time to keep trying to restore over a dead link, s.
    journal : OpenJournal or None
        Takes note of what is about to be disturbed; None where nothing outlives this program.
    """

    elsewhere = False

    def __init__(
        self,
        backend: Backend,
        settings: ExperimentSettings,
        supervisor: Supervisor,
        ticker: Ticker,
        publish: Callable[[Event], None],
        restore_limit_s: float,
        journal: OpenJournal | None = None,
    ) -> None:
        self.samples: list[Sample] = []
        self.experiment: Experiment | None = None
        self.before: Before | None = None
        self.restored: bool | None = None
        self._device = backend
        self._backend = Patient(backend)
        self._driven = Patient(backend, supervisor.blind_s)
        self._settings = settings
        self._supervisor = supervisor
        self._ticker = ticker
        self._publish = publish
        self._journal = journal
        self._stop = Stop()
        self._stop_verdict: Verdict | None = None
        tolerance = tolerance_of(settings.limits)
        self._read_back = ReadBack(tolerance)
        self._restorer = Restorer(self._backend, supervisor, ticker, publish, restore_limit_s, tolerance)
        self._commanded = self._held = math.nan
        self._touched = self._in_touch = False
        self._tripped = False
        self._repeated_before = repeated_by(backend)
        self._signals = [name for name in (PV, OUTPUT, SET_POINT, AUTO) if name in backend.readable]

    def abort(self, verdict: Verdict) -> None:
        """Ask for the end; the output is restored at once, the first verdict stands."""
        self._stop_verdict = self._stop_verdict or verdict
        self._stop.set()
        self._driven.interrupt()

    def wait_no_more(self) -> None:
        """End the waiting for a device that does not answer while the output is given back."""
        wait_no_more()

    async def run(self) -> Verdict | None:
        """Conduct the experiment to its end.

        Returns
        -------
        Verdict or None
            Why there is no result, or None when the oscillation converged.
        """
        if (found := unholdable(self._settings.limits, self._device)) is not None:
            return refused("limits_not_held", f"{found.key} {found.value:g} {found.message}", found.remedy)
        try:
            try:
                await self._backend.open()
                self.before = await self._look()
            except DriverError as error:
                return failed("device_unreachable", error.finding, error.remedy)
            if self.before.auto and AUTO not in self._backend.writable:
                return refused(
                    "device_in_auto",
                    "the device's own controller drives the output, and its mode cannot be written",
                    "Put the device to manual, or map auto for writing.",
                )
            return await self._conduct(self.before)
        finally:
            await uncancelled(self._close())

    async def _close(self) -> None:
        try:
            await self._backend.close()
        except DriverError:
            _log.exception("the device could not be disconnected")

    async def _look(self) -> Before:
        """Read how the loop stands before anything is written."""
        names = [name for name in (OUTPUT, AUTO) if name in self._backend.readable]
        seen = await read_surely(self._backend, names) if names else {}
        output = seen.get(OUTPUT, self._settings.limits.safe_output)
        if output is None or not math.isfinite(output):
            raise DriverError(
                "the device does not tell its present output, so it could not be restored",
                remedy="Map the output for reading, or declare limits.safe_output.",
            )
        return Before(output, seen.get(AUTO))

    async def _conduct(self, before: Before) -> Verdict | None:
        experiment = self.experiment = Experiment(self._settings, before.output)
        self._commanded = self._held = before.output
        self._publish(PhaseChanged(self._ticker.now_s, experiment.phase))
        try:
            if self._journal is not None:
                await self._journal.disturb(before)
            await self._take_over(before)
            with self._watched():
                await self._drive(experiment)
        except DriverError as error:
            still = self._supervisor.check_still(self._ticker.now_s, self._driven.stood_still_s())
            self.abort(still or failed("device_error", error.finding, error.remedy))
        except StorageError as error:
            self.abort(failed("storage_error", error.finding, error.remedy))
        except asyncio.CancelledError:
            self.abort(aborted("cancelled", "the tuning was cancelled", "Start it again when wanted."))
            raise
        except Exception as error:  # noqa: BLE001 - whatever it was, the loop must be given back
            _log.exception("the experiment failed; the output is being restored")
            self.abort(failed("internal_error", f"{type(error).__name__}: {error}", "Please report this with the log."))
        finally:
            await uncancelled(self._give_back(experiment, before))
        if experiment.verdict is None:  # the record is used
            repeated = repeated_by(self._device) - self._repeated_before
            damaged = [*self._supervisor.damaged, *self._read_back.damaged]
            experiment.warnings += line_warnings(self.samples, self._settings.sample_time_s, repeated, damaged)
        return experiment.verdict

    async def _take_over(self, before: Before) -> None:
        """Take the device to manual without a bump."""
        if before.auto and AUTO in self._backend.writable:
            self._touched = True
            await self._driven.write({AUTO: 0.0})
            await self._driven.write({OUTPUT: before.output})

    async def _drive(self, experiment: Experiment) -> None:
        while (tick := await self._ticker.tick(self._stop)) is not None:
            verdict = await self._cycle(experiment, tick)
            if verdict is not None:
                self._tripped = True
                self.abort(verdict)
            if experiment.phase is Phase.RESTORE:
                return

    @contextlib.contextmanager
    def _watched(self) -> Iterator[None]:
        """Be told between two samples, too, when the device has gone."""
        if not isinstance(self._device, Watchful):
            yield
            return
        self._device.watch(self._take_loss)
        try:
            yield
        finally:
            self._device.watch(None)

    def _take_loss(self, reason: str) -> None:
        now_s, self._in_touch = self._ticker.now_s, False
        self._publish(LinkTrouble(now_s, reason))
        verdict = self._supervisor.check_still(now_s, self._ticker.overdue_s) or self._supervisor.check_gone(now_s)
        if verdict is not None:
            self._tripped = True
            self.abort(verdict)

    async def _cycle(self, experiment: Experiment, tick: Tick) -> Verdict | None:
        """Take one sample; return a verdict when the supervisor trips."""
        try:
            seen, t = await timed(self._driven.read(self._signals), self._device, self._ticker)
        except DriverError as error:
            self._in_touch = False
            if self._stop.is_set():
                return None
            self._publish(LinkTrouble(self._ticker.now_s, str(error)))
            return self._supervisor.check_failure(self._ticker.now_s, self._driven.stood_still_s(tick), error)
        self._take_read_back(seen.get(OUTPUT))
        sample = Sample(t, float(seen[PV]), self._held, float(seen.get(SET_POINT, math.nan)), tick.lateness_s)
        auto, phase_now = seen.get(AUTO), experiment.phase.value
        verdict = self._supervisor.check(sample, auto=auto, phase=phase_now, still_s=self._driven.stood_still_s(tick))
        verdict = verdict or self._read_back.check(t, self._commanded, seen.get(OUTPUT))
        doubt = self._supervisor.doubt
        self._in_touch = not doubt
        if verdict is None and doubt:
            self._publish(LinkTrouble(t, f"{doubt}: a damaged reading, unless the next one says so too"))
            return None
        if not math.isfinite(sample.pv):
            return verdict
        if verdict is not None:
            self._record(sample)
            return verdict
        phase = experiment.phase
        await self._apply(experiment.step(sample), sample, phase)
        return None

    def _take_read_back(self, seen: float | None) -> None:
        """Put what the device really holds since the last write into the record."""
        held = self._read_back.held(self._commanded, seen)
        if self.samples and held != self._held:
            self.samples[-1] = replace(self.samples[-1], output=held)
        self._held = held

    async def _apply(self, command: Command, sample: Sample, phase_before: Phase) -> None:
        """Write what is permitted of the command, then record and tell what was done."""
        written_s = math.nan
        if command.phase is not Phase.RESTORE:
            # a period, not the time since the last write: after a gap the output must not leap to catch up
            wanted = self._supervisor.permit(command.output, self._commanded, self._ticker.period_s)
            written_s = await self._write(wanted)
        set_point, lateness_s = sample.set_point, sample.lateness_s
        self._record(Sample(sample.t, sample.pv, self._held, set_point, lateness_s, written_s))
        if command.estimate is not None:
            self._publish(EstimateUpdated(sample.t, **asdict(command.estimate)))
        if command.phase is not phase_before:
            self._publish(PhaseChanged(sample.t, command.phase))

    def _record(self, sample: Sample) -> None:
        self.samples.append(sample)
        self._publish(SampleTaken.of(sample))

    async def _write(self, output: float) -> float:
        """Write the output, unless it is there already; return the time from which it acts, s, else NaN."""
        if output == self._commanded:
            return math.nan
        if self._journal is not None:
            await self._journal.command(output)
        if self._stop.is_set():  # asked for meanwhile: the next output is the one to give back
            return math.nan
        self._touched = True
        _, written_s = await timed(self._driven.write({OUTPUT: output}), self._device, self._ticker)
        self._commanded = self._held = output
        return written_s

    async def _give_back(self, experiment: Experiment, before: Before) -> None:
        """Restore output and mode, and end the experiment's phases."""
        if self._stop_verdict is not None and experiment.phase is not Phase.RESTORE:
            experiment.stop(self._stop_verdict)
            self._publish(PhaseChanged(self._ticker.now_s, experiment.phase))
        code = self._stop_verdict.code if self._stop_verdict else None
        if code in DRIVEN_BY_OTHERS or not self._touched:
            self.restored = True  # somebody else drives the loop now, or nothing was moved: there is nothing to undo
        else:
            safe = self._settings.limits.safe_output if self._tripped else None
            target = before.output if safe is None else safe
            if self._journal is not None:
                await self._journal.aim(target)
            self.restored = await self._restorer.restore(before, target, self._commanded, mode_known=self._in_touch)
        if self.restored:
            experiment.restored()
            self._publish(PhaseChanged(self._ticker.now_s, experiment.phase))
