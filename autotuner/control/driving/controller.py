"""The relay controller: one experiment on one device, under a lease.

    find -> observe (from automatic) -> hold -> take over -> drive -> release

Invariants:

1. No formula and no decision: the experiment decides, `autotuner.control.driving.drive` moves it on.
2. From the first write on, every way out leads through `Lease.release`.
"""

from __future__ import annotations

import asyncio
import logging
import math
from dataclasses import asdict, replace
from typing import TYPE_CHECKING

from autotuner.control.clock.timestamped_call import repeated_by
from autotuner.control.devices.confirmed_read import read_surely
from autotuner.control.devices.ranges import unholdable
from autotuner.control.devices.retrying import uncancelled
from autotuner.control.driving.drive import drive
from autotuner.control.driving.lease import Lease, ticker_of
from autotuner.control.driving.lease_state import LeaseState
from autotuner.control.driving.release_watch import bump_at_release, noise_of
from autotuner.control.forced_shutdown import forced_shutdown
from autotuner.control.records.lease_record import Before
from autotuner.control.reporting.events import EstimateUpdated, LoopObserved, PhaseChanged, SampleTaken
from autotuner.core.experiment.experiment import Experiment
from autotuner.core.experiment.phases import Phase
from autotuner.core.recording.line_quality import line_warnings
from autotuner.core.safety.supervisor import Supervisor
from autotuner.core.verdict import aborted, failed, refused
from autotuner.errors import DriverError, StorageError
from autotuner.ports import AUTO, OUTPUT, PV, SET_POINT

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from autotuner.configuration import LoopTable
    from autotuner.control.records.open_journal import OpenJournal
    from autotuner.control.reporting.events import Event
    from autotuner.core.experiment.experiment import Command
    from autotuner.core.experiment.settings import ExperimentSettings
    from autotuner.core.recording import Sample
    from autotuner.core.verdict import Verdict
    from autotuner.ports import Backend

OBSERVED = 25
"""Readings of the output before take-over from the device's own controller; their mean is held."""

_log = logging.getLogger(__name__)


class ExperimentStage:
    """An experiment as a stage of `autotuner.control.driving.drive`.

    Parameters
    ----------
    experiment : Experiment
        Decides.
    samples : list of Sample
        Takes the recording.
    publish : callable
        Takes events.
    """

    def __init__(self, experiment: Experiment, samples: list[Sample], publish: Callable[[Event], None]) -> None:
        self._experiment, self._samples, self._publish = experiment, samples, publish
        self._command: Command | None = None
        self._published_phase = experiment.phase

    @property
    def phase(self) -> str:
        """Name of the present phase."""
        return self._experiment.phase.value

    @property
    def complete(self) -> bool:
        """Whether the output is to be restored."""
        return self._experiment.phase is Phase.RESTORE

    def step(self, sample: Sample) -> Mapping[str, float]:
        """Take a sample; return the output that the experiment commands."""
        command = self._command = self._experiment.step(sample)
        return {} if command.phase is Phase.RESTORE else {OUTPUT: command.output}

    def record(self, sample: Sample) -> None:
        """Record a sample, and publish its events."""
        self._samples.append(sample)
        self._publish(SampleTaken.of(sample))
        command, self._command = self._command, None
        if command is not None and command.estimate is not None:
            self._publish(EstimateUpdated(sample.t, **asdict(command.estimate)))
        if command is not None and command.phase is not self._published_phase:
            self._published_phase = command.phase
            self._publish(PhaseChanged(sample.t, command.phase))

    def correct(self, output: float) -> None:
        """Correct the record with the output that the device really held after the last sample."""
        if self._samples and output != self._samples[-1].output:
            self._samples[-1] = replace(self._samples[-1], output=output)

    def tolerates(self, _verdict: Verdict) -> bool:
        """Return False: the supervisor's verdict is final."""
        return False


class Controller:
    """Conducts one experiment on one device.

    Parameters
    ----------
    backend : Backend
        The device; opened and closed here.
    settings : ExperimentSettings
        How the experiment is run.
    loop : LoopTable
        The loop.
    publish : callable
        Takes events as they happen.
    journal : OpenJournal or None
        Records disturbed loops; None where nothing outlives this program.
    """

    def __init__(
        self,
        backend: Backend,
        settings: ExperimentSettings,
        loop: LoopTable,
        publish: Callable[[Event], None],
        journal: OpenJournal | None = None,
    ) -> None:
        self.samples: list[Sample] = []
        self.experiment: Experiment | None = None
        self.before: Before | None = None
        self.restored: bool | None = None
        self.lease = Lease(
            backend,
            settings.limits,
            Supervisor(settings.limits, loop.safety_settings(settings.time_limit_s)),
            ticker_of(backend, settings.sample_time_s),
            loop.restore_limit_s,
            journal=journal,
            publish=publish,
            scan_s=loop.device_scan_s,
        )
        self._device = backend
        self._settings = settings
        self._publish = publish
        self._scan_s = loop.device_scan_s
        self._output_noise = self.lease.read_back.tolerance
        self._repeated_before = repeated_by(backend)

    def abort(self, verdict: Verdict) -> None:
        """Request the end; the output is restored at once, the first verdict counts."""
        self.lease.abort(verdict)

    async def run(self) -> Verdict | None:
        """Conduct the experiment to its end.

        Returns
        -------
        Verdict or None
            The reason for a missing result, or None when the oscillation converged.
        """
        if (found := unholdable(self._settings.limits, self._device)) is not None:
            return refused("limits_not_held", f"{found.key} {found.value:g} {found.message}", found.remedy)
        try:
            try:
                await self.lease.open()
                self.before = await self._look()
            except DriverError as error:
                return failed("device_unreachable", error.finding, error.remedy)
            if self.before.auto and AUTO not in self._device.writable:
                return refused(
                    "device_in_auto",
                    "the device's own controller drives the output, and its mode cannot be written",
                    "Put the device to manual, or map auto for writing.",
                )
            if self.before.auto:
                verdict = await self._observe(self.before)
                if verdict is not None:
                    self.restored = True  # nothing was written yet
                    return verdict
            return await self._conduct(self.before)
        finally:
            await uncancelled(self._close())

    async def _close(self) -> None:
        try:
            await self.lease.close()
        except DriverError:
            _log.exception("the device could not be disconnected")

    async def _look(self) -> Before:
        """Read the state of the loop before anything is written."""
        names = [name for name in (OUTPUT, AUTO) if name in self._device.readable]
        readings = await read_surely(self.lease.device, names) if names else {}
        output = readings.get(OUTPUT, self._settings.limits.safe_output)
        if output is None or not math.isfinite(output):
            raise DriverError(
                "the device does not report its present output, so it could not be restored",
                remedy="Map the output for reading, or declare limits.safe_output.",
            )
        return Before(output, readings.get(AUTO))

    async def _observe(self, found: Before) -> Verdict | None:
        """Take the mean of the output while the device's own controller drives it: one reading has its noise.

        Returns why there is nothing to conduct, or None.
        """
        lease, outputs = self.lease, list[float]()
        while len(outputs) < OBSERVED and OUTPUT in self._device.readable:
            if (tick := await lease.ticker.tick(lease.stop)) is None:
                return lease.verdict
            try:
                readings = await lease.read(lease.signals)
            except DriverError as error:
                return lease.verdict or failed("device_unreachable", error.finding, error.remedy)
            if not readings[AUTO]:
                return aborted(
                    "mode_changed", "the device went to manual", "An operator or another program took the loop over."
                )
            if math.isfinite(readings[OUTPUT]):
                outputs.append(readings[OUTPUT])
            self._publish(LoopObserved(tick.t, readings[PV], readings[OUTPUT], readings.get(SET_POINT, math.nan)))
        self._output_noise = noise_of(outputs, lease.read_back.tolerance)
        self.before = replace(found, output=math.fsum(outputs) / len(outputs)) if outputs else found
        return None

    async def _conduct(self, before: Before) -> Verdict | None:
        lease = self.lease
        experiment = self.experiment = Experiment(self._settings, before.output)
        self._publish(PhaseChanged(lease.ticker.now_s, experiment.phase))
        try:
            await lease.hold(before)
            await lease.take_over(self._output_noise)
            await drive(lease, ExperimentStage(experiment, self.samples, self._publish))
        except DriverError as error:
            stall = lease.supervisor.check_still(lease.ticker.now_s, lease.stalled_s())
            lease.abort(stall or failed("device_error", error.finding, error.remedy))
        except StorageError as error:
            lease.abort(failed("storage_error", error.finding, error.remedy))
        except asyncio.CancelledError:
            lease.abort(aborted("cancelled", "the tuning was cancelled", "Start it again when wanted."))
            raise
        except Exception as error:  # noqa: BLE001 - whatever it was, the loop must be released
            _log.exception("the experiment failed; the output is being restored")
            reason = f"{type(error).__name__}: {error}"
            lease.abort(failed("internal_error", reason, "Please report this with the log."))
        finally:
            await uncancelled(self._release(experiment))
        if experiment.verdict is None:  # the record is used
            repeated = repeated_by(self._device) - self._repeated_before
            damaged = [*lease.supervisor.damaged, *lease.read_back.damaged]
            experiment.warnings += line_warnings(self.samples, self._settings.sample_time_s, repeated, damaged)
        return experiment.verdict

    async def _release(self, experiment: Experiment) -> None:
        """Release the loop, and end the experiment's phases."""
        lease = self.lease
        if lease.verdict is not None and experiment.phase is not Phase.RESTORE:
            experiment.stop(lease.verdict)
            self._publish(PhaseChanged(lease.ticker.now_s, experiment.phase))
        was_disturbed = lease.state is LeaseState.DISTURBED
        self.restored = await lease.release()
        if self.restored and was_disturbed and not forced_shutdown().is_set():
            await self._watch_release(experiment)
        if self.restored:
            experiment.restored()
            self._publish(PhaseChanged(lease.ticker.now_s, experiment.phase))

    async def _watch_release(self, experiment: Experiment) -> None:
        """Report a jump of the output where the device's own controller drives it again."""
        lease = self.lease
        if lease.found is None or not lease.found.auto or lease.target is None or lease.was_taken:
            return
        bump = await bump_at_release(lease.device, lease.target, self._output_noise, lease.ticker, self._scan_s)
        if bump is not None:
            self._publish(bump)
            experiment.warnings.append(str(bump))
