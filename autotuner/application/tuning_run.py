"""One tuning from start to gains, with its state at any time.

    experiment -> identification -> gains -> verdict

Invariants: a tuning always ends, with a verdict; a recording is kept whatever happens; every
reader sees the same events in the same order, from the first one.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import AsyncIterator  # noqa: TC003 - the service reads this annotation
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from autotuner.application.analysis.analysed import Context
from autotuner.application.analysis.displacement import displacement_warning
from autotuner.application.computing.computations import analyse
from autotuner.application.computing.estimator import estimate_while_running
from autotuner.control.clock.ticker import utc_now
from autotuner.control.devices.device_gains import device_form
from autotuner.control.devices.retrying import uncancelled
from autotuner.control.driving.controller import Controller
from autotuner.control.gains.apply import gains_in_device
from autotuner.control.reporting.event_log import EventLog
from autotuner.control.reporting.events import Ended, Event, ModelUpdated, PhaseChanged, SampleTaken
from autotuner.core.design import DesignSpec
from autotuner.core.model.structures import searched
from autotuner.core.notes import notes_among, warnings_among
from autotuner.core.recording import Recording
from autotuner.core.recording.lateness import Lateness
from autotuner.core.verdict import Outcome, Verdict, aborted, failed
from autotuner.errors import ComputationError, InputError, ShuttingDownError, TuningStateError

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.application.analysis.analysed import Analysis
    from autotuner.application.operations import Operating
    from autotuner.configuration import LoopTable
    from autotuner.control.compute_port import ComputePool
    from autotuner.control.devices.device_gains import DeviceForm
    from autotuner.control.driving.controller_port import Conductor
    from autotuner.control.gains.apply import Applied
    from autotuner.control.records.lease_record import Before, LeaseRecord
    from autotuner.control.records.open_journal import OpenJournal
    from autotuner.control.verification.verification_run import VerificationRun
    from autotuner.core.design import PidGains
    from autotuner.core.experiment.settings import ExperimentSettings
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Sample
    from autotuner.ports import Backend

    MakeConductor = Callable[["TuningRun", LoopTable, Backend], Conductor]

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class TuningRequest:
    """The request of a tuning.

    Attributes
    ----------
    settings : ExperimentSettings
        How the experiment is run.
    structure : str
        Process structure to identify, or ``auto``.
    spec : DesignSpec
        The requested design.
    actor : str
        Who requested it: the name of a token, or `local`.
    budget_ms : float or None
        Processor time of the analysis, ms; None without a limit.

    Raises
    ------
    InputError
        An unknown structure, or a budget that is none.
    """

    settings: ExperimentSettings
    structure: str = "auto"
    spec: DesignSpec = field(default_factory=DesignSpec)
    actor: str = "local"
    budget_ms: float | None = None

    def __post_init__(self) -> None:
        searched(self.structure)  # refuses an unknown one before anything moves
        budget: object = self.budget_ms
        known = isinstance(budget, int | float) and not isinstance(budget, bool) and 0.0 < budget < math.inf
        if budget is not None and not known:
            raise InputError(
                "must be a positive number",
                field="budget_ms",
                value=budget,
                remedy="Give processor time in ms, such as 200, or leave it out for none.",
            )

    def analysed_by(self) -> dict[str, object]:
        """Return the inputs of the analysis besides the recording, JSON-ready."""
        return {"structure": self.structure, "budget_ms": self.budget_ms, **self.spec.to_dict()}

    def to_dict(self) -> dict[str, object]:
        """Return everything, JSON-ready."""
        return {"settings": self.settings.to_dict(), **self.analysed_by(), "actor": self.actor}


def here(tuning: TuningRun, loop: LoopTable, backend: Backend) -> Conductor:
    """Return a controller on this event loop."""
    return Controller(backend, tuning.request.settings, loop, tuning.publish, tuning.journal)


@dataclass(slots=True)
class TuningRun:
    """A tuning of one loop.

    Attributes
    ----------
    id, loop : str
        Whose it is.
    request : TuningRequest
        The request.
    journal : OpenJournal or None
        Records disturbed loops for later programs; None where nothing is recorded.
    kept : Kept or None
        The journal's content on a tuning that an earlier run of the program began.
    context : Context or None
        Properties of the loop for the analysis; None before the loop is driven.
    device_gains : dict of str to float or None
        Numbers of the device's own gains before the experiment; None where they are not mapped, or could not be read.
    applied : Applied or None
        Gains of this tuning that the device holds.
    verification : VerificationRun or None
        The latest step under these gains.
    verifier : Operating or None
        Its operation while it runs.
    trouble : str or None
        Why the gains are not in the device although the request included that.
    settled : bool
        Whether an earlier program has reported its end.
    phase : str
        The phase entered last.
    """

    id: str
    loop: str
    request: TuningRequest
    journal: OpenJournal | None = None
    kept: LeaseRecord | None = None
    started_at: str = field(default_factory=utc_now)
    verdict: Verdict | None = None
    analysis: Analysis | None = None
    context: Context | None = None
    device_gains: dict[str, float] | None = None
    applied: Applied | None = None
    verification: VerificationRun | None = None
    verifier: Operating | None = None
    trouble: str | None = None
    settled: bool = False
    phase: str = "arm"
    events: list[Event] = field(default_factory=list)
    controller: Conductor | None = None
    _abort: Verdict | None = None
    _news: asyncio.Event = field(default_factory=asyncio.Event, repr=False)
    _rare_news: asyncio.Event = field(default_factory=asyncio.Event, repr=False)
    _lateness: Lateness = field(default_factory=Lateness, repr=False)
    _lines: EventLog = field(default_factory=EventLog, repr=False)
    _settings_published: dict[str, Any] | None = field(default=None, repr=False)
    _early: ModelUpdated | None = field(default=None, repr=False)

    def head(self, device: str) -> dict[str, object]:
        """Return the first line of the tuning's journal; `device` is its loop's `device_key`."""
        return {
            "tuning": self.id,
            "loop": self.loop,
            "device": device,
            "started_at": self.started_at,
            "request": self.request.to_dict(),
        }

    @property
    def ended(self) -> bool:
        """Whether the result is final."""
        return self.verdict is not None

    @property
    def ended_before(self) -> bool:
        """Whether the tuning had ended earlier: at most its verification or recovery is left to this program."""
        if self.kept is None:
            return False
        return self.verification is not None or self.kept.left is not None or self.settled

    @property
    def end_published(self) -> bool:
        """Whether the events include that of its end."""
        return bool(self.events) and isinstance(self.events[-1], Ended)

    @property
    def warnings(self) -> list[str]:
        """Warnings of the experiment and of the analysis: findings that require action."""
        return warnings_among(self._messages)

    @property
    def notes(self) -> list[str]:
        """Notes of the experiment and of the analysis: findings for information."""
        return notes_among(self._messages)

    @property
    def _messages(self) -> list[str]:
        """Warnings and notes."""
        experiment = self.controller.experiment if self.controller else None
        journal = self.journal.trouble if self.journal else None
        auto = bool(self.before is not None and self.before.auto)
        displaced = displacement_warning(self.samples, self.model, auto=auto)
        return [
            *([displaced] if displaced else ()),
            *(experiment.warnings if experiment else ()),
            *(self.analysis.messages if self.analysis else ()),
            *([journal] if journal else ()),
            *([f"the gains were not applied: {self.trouble}"] if self.trouble else ()),
        ]

    @property
    def model(self) -> ProcessModel | None:
        """The identified process."""
        return None if self.analysis is None else self.analysis.identification.model

    @property
    def spec(self) -> DesignSpec:
        """The requested design."""
        return self.request.spec

    @property
    def samples(self) -> list[Sample]:
        """The recording so far."""
        if self.controller is not None:
            return self.controller.samples
        return self.kept.samples if self.kept is not None else []

    @property
    def before(self) -> Before | None:
        """State in which the loop was found."""
        source = self.controller or self.kept
        return None if source is None else source.before

    def publish(self, event: Event) -> None:
        """Take an event and wake the readers."""
        self.events.append(event)
        if isinstance(event, PhaseChanged):
            self.phase = event.phase
        elif isinstance(event, ModelUpdated) and event.gains is not None:
            self._early = event
        self._lines.take(self.id, self.loop, event)
        if self.journal is not None:
            self.journal.note(event)
        if not isinstance(event, SampleTaken):
            self._rare_news.set()
            self._rare_news = asyncio.Event()
        self._news.set()
        self._news = asyncio.Event()

    async def follow(self, *, samples: bool = True) -> AsyncIterator[Event]:
        """Yield every event from the first, then each new one as it happens, until the tuning has ended.

        Without `samples`, sample events are skipped, and the reader is not woken for them.
        """
        count = 0
        while True:
            for event in self.events[count:]:
                if samples or not isinstance(event, SampleTaken):
                    yield event
                count += 1
                if isinstance(event, Ended):
                    return
            await self.more(count, samples=samples)

    async def more(self, count: int, *, samples: bool = True) -> None:
        """Return when there are more than `count` events.

        Without `samples`, it may return only with the next event that is not a sample.
        """
        if len(self.events) <= count:
            await (self._news if samples else self._rare_news).wait()

    def abort(self, verdict: Verdict) -> None:
        """Ask for the end, of a running verification too; raise `TuningStateError` when all has ended."""
        if self.verifier is not None:
            self.verifier.abort(verdict)
            return
        if self.ended:
            raise TuningStateError(
                f"tuning {self.id} is not running", remedy="Start a new one.", field="tuning", value=self.id
            )
        self._abort = verdict
        if self.controller is not None:
            self.controller.abort(verdict)

    def recording(self) -> Recording:
        """Return the recording so far; raise `RecordingError` before the second sample."""
        experiment = None if self.controller is None else self.controller.experiment
        return Recording.from_samples(list(self.samples), {} if experiment is None else experiment.settings_so_far())

    async def conduct(
        self, loop: LoopTable, backend: Backend, pool: ComputePool, conductor: MakeConductor = here
    ) -> Verdict:
        """Run the tuning to its end, with the experiment of `conductor`; the verdict is stored in the run."""
        try:
            self.context = self.context or self._context(device_form(loop, backend, f"loops.{self.loop}"))
            self.device_gains = await gains_in_device(self.loop, loop, backend)
            self.controller = conductor(self, loop, backend)
            verdict = await self._experiment_and_analysis(self.controller, pool)
        except asyncio.CancelledError:
            verdict = aborted("cancelled", "the tuning was cancelled", "Start it again when wanted.")
            await uncancelled(self._end(verdict))
            raise
        except ShuttingDownError:
            verdict = aborted(
                "shutdown",
                "the service was stopped while the recording was analysed",
                "The loop was released before. Download the recording, and let `autotuner identify` analyse it.",
            )
        except Exception as error:  # noqa: BLE001 - a tuning always ends with a verdict; the log has the trace
            _log.exception("tuning %s of loop %s failed", self.id, self.loop)
            verdict = failed("internal_error", f"{type(error).__name__}: {error}", "Please report this with the log.")
        return await self._end(verdict)

    def _context(self, form: DeviceForm | None) -> Context:
        settings = self.request.settings
        slew_per_s = settings.limits.output_slew_per_s or math.inf
        device = None if form is None else form.controller
        return Context(device, settings.sample_time_s, settings.limits.output, slew_per_s)

    def _if_restored(self, verdict: Verdict) -> Verdict:
        """Return the verdict, or the more pressing one that the loop was not released."""
        if self.controller is None or self.controller.restored is not False:
            return verdict
        before = self.controller.before
        return failed(
            "output_unknown",
            f"{verdict.message}; and the output could not be confirmed at its previous value: its value is unknown",
            f"Set output {before.output:g} on the device by hand." if before else "Check the device.",
        )

    async def _experiment_and_analysis(self, controller: Conductor, pool: ComputePool) -> Verdict:
        estimator = asyncio.create_task(estimate_while_running(self, pool), name=f"estimator-{self.id}")
        try:
            verdict = self._abort or await controller.run()
        finally:
            estimator.cancel()
            await asyncio.gather(estimator, return_exceptions=True)
        if verdict is not None:
            return verdict
        request = self.request
        try:
            self.analysis = await pool.run(
                analyse,
                await pool.aside(self.recording),
                request.structure,
                request.spec,
                self.context,
                request.budget_ms,
            )
        except (InputError, ComputationError) as error:
            return failed("no_result", error.finding, error.remedy)
        return self._abort or self.analysis.verdict

    async def _end(self, verdict: Verdict) -> Verdict:
        final = self._if_restored(verdict)
        if self.journal is not None:  # without a released loop it has no end: the next start tries again
            await self.journal.end(verdict, released=final is verdict)
        return self.end(final)

    def end(self, verdict: Verdict) -> Verdict:
        """Make the verdict known: the tuning is over."""
        self.verdict = verdict
        self.publish(self._end_of(verdict))
        return verdict

    def settle(self, verdict: Verdict) -> None:
        """Take over its end from an earlier program, which has logged it: nothing is logged again."""
        self.verdict, self.settled = verdict, True
        self.events.append(self._end_of(verdict))

    def _end_of(self, verdict: Verdict) -> Ended:
        final = (verdict.outcome.value, verdict.code, verdict.message, verdict.remedy)
        return Ended(self.events[-1].t if self.events else 0.0, *final)

    def to_dict(self) -> dict[str, object]:
        """Return the complete state, JSON-ready."""
        return {
            "id": self.id,
            "loop": self.loop,
            "state": "ended" if self.ended else "running",
            "actor": self.request.actor,
            "phase": self.phase,
            "started_at": self.started_at,
            "samples": len(self.samples),
            "settings": self._settings(),
            "before": {"output": self.before.output, "auto": self.before.auto} if self.before else None,
            "restored": self.restored,
            "lateness": self._lateness.of(self.samples, ended=self.ended),
            **(self.analysis.to_dict() if self.analysis else {}),
            "warnings": self.warnings,
            "notes": self.notes,
            "early_gains": self._early_gains(),
            "device_gains": self.device_gains,
            "applied": self.applied.to_dict() if self.applied else None,
            "verification": self.verification.to_dict() if self.verification else None,
            "verdict": self.verdict.to_dict() if self.verdict else None,
        }

    def _early_gains(self) -> dict[str, object] | None:
        """Return the latest gains of the running relay phase; None when those of the whole record exist."""
        early, final = self._early, self.analysis is not None and self.analysis.gains is not None
        if early is None or final:
            return None
        return {
            "t": early.t,
            "method": early.method,
            "structure": early.structure,
            "relative_error": early.relative_error,
            **(early.gains or {}),
        }

    def _settings(self) -> dict[str, Any]:
        self._settings_published = self._settings_published or self.request.settings.to_dict()
        return self._settings_published

    @property
    def restored(self) -> bool | None:
        """Whether the loop was released; None before that is decided."""
        if self.controller is not None:
            return self.controller.restored
        return None if self.kept is None or self.verdict is None else self.verdict.code != "output_unknown"

    @property
    def succeeded(self) -> bool:
        """Whether there are gains to use."""
        return self.verdict is not None and self.verdict.outcome is Outcome.DONE


def gains_of(tuning: TuningRun) -> PidGains:
    """Return the gains of a tuning that ended well.

    Raises
    ------
    TuningStateError
        It runs, or has no gains.
    """
    if not tuning.succeeded or tuning.analysis is None or tuning.analysis.gains is None:
        raise TuningStateError(
            "has no gains to apply", field="tuning", value=tuning.id, remedy="Take a tuning that ended as done."
        )
    return tuning.analysis.gains.gains
