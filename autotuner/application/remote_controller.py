"""Proxy of an experiment in the loop process.

Invariant: where the process is lost, another one recovers the loop from its record or, without a record,
from the published values. The proxy cannot be cancelled before the loop is released.
"""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from autotuner.application.operations import CANCELLED, NoProcessError, ProcessLostError
from autotuner.control.devices.retrying import uncancelled
from autotuner.control.operations.crash_recovery import Back, Recover
from autotuner.control.operations.experiment_operation import Experiment
from autotuner.control.operations.messages import Inform
from autotuner.control.records.lease_record import DamagedRecordError, LeaseRecord, read_record
from autotuner.control.reporting.events import PhaseChanged, SampleTaken
from autotuner.core.experiment.phases import Phase
from autotuner.core.verdict import failed
from autotuner.errors import AutotunerError
from autotuner.ports import Carried

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.application.loop_processes import LoopProcesses
    from autotuner.application.operations import Operations
    from autotuner.application.tuning_run import TuningRun
    from autotuner.control.compute_port import ComputePool
    from autotuner.control.operations.crash_recovery import Recovered
    from autotuner.control.operations.messages import Closing, ExperimentState, Report
    from autotuner.control.records.lease_record import Before
    from autotuner.control.reporting.events import Event
    from autotuner.core.model.process import Integrating
    from autotuner.core.recording import Sample
    from autotuner.core.verdict import Verdict

AGAIN = "Start the tuning again; if it happens again, check the log."


@dataclass(frozen=True, slots=True)
class RemoteExperiment:
    """The latest report of the experiment; see `autotuner.control.driving.controller_port.Conducted`."""

    state: ExperimentState
    post: Callable[[object], None]

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings of the experiment."""
        return self.state.warnings

    def inform(self, model_error: float, expected_loss: float = 0.0, *, integrating: Integrating | None = None) -> None:
        """Send the process the uncertainty of a model."""
        self.post(Inform(model_error, expected_loss, integrating))

    def settings_so_far(self) -> dict[str, object]:
        """Return the settings for the recording, JSON-ready."""
        return dict(self.state.settings)


class RemoteController:
    """Conducts one experiment in a loop process; see `autotuner.control.driving.controller_port.Conductor`.

    Parameters
    ----------
    tuning : TuningRun
        Whose experiment it is.
    operations : Operations
        Those of its loop.
    processes : LoopProcesses
        Has it conducted.
    pool : ComputePool
        Computes for it.
    """

    def __init__(self, tuning: TuningRun, operations: Operations, processes: LoopProcesses, pool: ComputePool) -> None:
        self.samples: list[Sample] = []
        self.experiment: RemoteExperiment | None = None
        self.before: Before | None = None
        self.restored: bool | None = None
        self._tuning, self._operations = tuning, operations
        work = Experiment(tuning.request.settings)
        self._remote = operations.remote(work, processes, tuning.journal, self._take, pool)
        self._received_at_s = 0.0

    def abort(self, verdict: Verdict) -> None:
        """Request the end; the output is restored at once, the first verdict counts."""
        self._remote.abort(verdict)

    async def run(self) -> Verdict | None:
        """Conduct the experiment to its end; see `autotuner.control.driving.controller.Controller.run`."""
        conduct = asyncio.ensure_future(self._conduct())
        try:
            return await asyncio.shield(conduct)
        except asyncio.CancelledError:
            self.abort(CANCELLED)
            await uncancelled(conduct)
            raise

    async def _conduct(self) -> Verdict | None:
        try:
            closing: Closing = await self._remote.run()
        except NoProcessError as error:
            return failed("no_process", error.message, AGAIN)
        except ProcessLostError as lost:
            return await self._made_good(lost.how)
        except AutotunerError as error:
            return failed("device_error", error.finding, error.remedy)
        if isinstance(self._operations.backend, Carried):
            self._operations.backend.take_over(closing.carried)
        self.restored = closing.restored
        return closing.verdict

    def _take(self, report: Report) -> None:
        self._received_at_s = asyncio.get_running_loop().time()
        self.before = report.before
        if report.state is not None:
            self.experiment = RemoteExperiment(report.state, self._remote.send)
        for event in report.events:
            if isinstance(event, SampleTaken):
                self.samples.append(event.sample)
            self._tuning.publish(event)
        for place, sample in report.corrected:
            self.samples[place] = sample

    async def _made_good(self, reason: str) -> Verdict:
        """Let another process recover the loop of a lost process, and return the verdict."""
        self._publish_now(PhaseChanged(0.0, Phase.RESTORE))
        work, journal = Recover(await self._known()), self._tuning.journal
        try:
            recovered: Recovered = await self._operations.begin(work, journal, self._publish_now).run()
            back = recovered.loop
        except (NoProcessError, ProcessLostError) as error:
            back = Back(f"the loop is still disturbed: {error}", done=False)
        self.restored = back.done
        if back.done:
            self._publish_now(PhaseChanged(0.0, Phase.ENDED))
        return failed("process_lost", f"the process that drove the loop was lost ({reason}); {back.what}", AGAIN)

    def _publish_now(self, event: Event) -> None:
        """Publish an event of here, at the time since the start of the process."""
        silent_s = asyncio.get_running_loop().time() - self._received_at_s
        self._tuning.publish(replace(event, t=self.samples[-1].t + silent_s if self.samples else 0.0))

    async def _known(self) -> LeaseRecord:
        """Return the last known state of the loop."""
        tuning = self._tuning
        if tuning.journal is not None:
            with contextlib.suppress(OSError, DamagedRecordError):
                return await asyncio.to_thread(read_record, tuning.journal.store, tuning.journal.name)
        kept = LeaseRecord(tuning.id, tuning.id, tuning.loop, "", tuning.started_at, {}, before=self.before)
        kept.commanded, kept.wide = {sample.output for sample in self.samples}, True
        if self.before is not None:
            kept.take({"target": self.before.output})
        return kept
