"""Crash recovery: a loop that a killed program left disturbed is restored before anything new is done with it.

    a tuning: output, mode      a verification: gains, set point, mode, output      a run over set points: set point
    a change of gains: the old ones

Invariants:

1. A record is marked as ended only when the loop has been released.
2. The loop is released by an operation (`autotuner.control.operations.crash_recovery.Recover`), as anything else is
   done with it.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

from autotuner.application.operations import Operations
from autotuner.application.schedule_run import SchedulePlan, ScheduleRun
from autotuner.application.tuning_run import TuningRequest, TuningRun
from autotuner.control.devices.retrying import uncancelled
from autotuner.control.operations.crash_recovery import NOTHING, RESTORED, SET_POINT_UNKNOWN, UNKNOWN, Back, Recover
from autotuner.control.records.gains_ledger import GainsLedger
from autotuner.control.records.lease_record import INTERRUPTED, Kind
from autotuner.control.reporting.event_log import log_event
from autotuner.control.reporting.events import SampleTaken
from autotuner.control.verification.verification_run import VerificationRun
from autotuner.core.design import design_spec_from
from autotuner.core.experiment.settings import ExperimentSettings
from autotuner.core.verdict import Outcome, Verdict, aborted, failed
from autotuner.errors import InputError, LinkError, OutputUnknownError

if TYPE_CHECKING:
    from autotuner.application.loop_processes import LoopProcesses
    from autotuner.configuration import LoopTable
    from autotuner.control.gains.apply import RolledBack
    from autotuner.control.operations.crash_recovery import Recovered
    from autotuner.control.records.journal import Journal
    from autotuner.control.records.lease_record import LeaseRecord
    from autotuner.control.records.open_journal import OpenJournal
    from autotuner.control.reporting.events import Event
    from autotuner.ports import Backend

START_AGAIN = "Start it again when wanted."
_log = logging.getLogger(__name__)


class Earlier(Protocol):
    """An interrupted run of an earlier program, as presented to users."""

    journal: OpenJournal | None

    @property
    def verdict(self) -> Verdict | None:
        """Verdict."""

    def publish(self, event: Event) -> None:
        """Take an event of its recovery."""

    def end(self, verdict: Verdict) -> object:
        """Make the verdict known."""


@dataclass(slots=True)
class EarlierVerification:
    """A verification that an earlier program began, with its tuning.

    Attributes
    ----------
    tuning : TuningRun
        Its tuning.
    ended_as : Verdict or None
        How the tuning had ended, as far as its journal states.
    run : VerificationRun
        What is reported of it.
    journal : OpenJournal or None
        Its journal.
    """

    tuning: TuningRun
    ended_as: Verdict | None
    run: VerificationRun
    journal: OpenJournal | None = None

    @property
    def verdict(self) -> Verdict | None:
        """Verdict."""
        return self.run.verdict

    def publish(self, event: Event) -> None:
        """Take an event of its recovery."""
        if self.tuning.ended:  # no reader is left
            log_event(self.tuning.id, self.tuning.loop, event)
        else:
            self.tuning.publish(event)

    def take_back(self, rolled_back: RolledBack) -> None:
        """Record that the previous gains are in the device again."""
        self.run.rolled_back, self.run.back = True, rolled_back
        self.tuning.applied, self.tuning.device_gains = None, dict(rolled_back.now)

    def end(self, verdict: Verdict) -> None:
        """Make the verdict known, and that of the tuning with it."""
        self.run.end(verdict, 0.0)
        _log.info("verification of tuning %s of loop %s: %s", self.tuning.id, self.tuning.loop, verdict.message)
        if not self.tuning.ended:
            self.tuning.end(self.ended_as or verdict)


@dataclass(slots=True)
class EarlierGains:
    """A change of gains that an earlier program began; see `Earlier`."""

    loop: str
    journal: OpenJournal | None = None
    verdict: Verdict | None = None

    def publish(self, _event: Event) -> None:
        """Do nothing: no output is moved."""

    def end(self, verdict: Verdict) -> None:
        """Make the verdict known."""
        self.verdict = verdict
        _log.info("gains of loop %s: %s", self.loop, verdict.message)


def earlier_tuning(record: LeaseRecord, loop: LoopTable | None) -> TuningRun:
    """Return a tuning that an earlier program began, with everything from its journal."""
    request = _request(record, loop)
    events: list[Event] = [SampleTaken.of(sample) for sample in record.samples]
    return TuningRun(record.tuning, record.loop, request, kept=record, started_at=record.started_at, events=events)


def earlier_verification(
    record: LeaseRecord, loop: LoopTable | None, journal: Journal, known: TuningRun | None = None
) -> EarlierVerification:
    """Return a verification that an earlier program began; `known` is its tuning where this program has it."""
    own = journal.of_tuning(record.tuning)
    tuning = known or earlier_tuning(own or record, loop)
    tuning.verification = VerificationRun(started_at=record.started_at)
    return EarlierVerification(tuning, own.verdict if own else None, tuning.verification)


def earlier_schedule(record: LeaseRecord, loop: LoopTable | None) -> ScheduleRun:
    """Return a run over operating points that an earlier program began."""
    points, request = tuple(record.request.get("set_points", ())), _request(record, loop)
    plan = SchedulePlan(points, request, record.request.get("variable", "set_point"), record.request.get("hysteresis"))
    return ScheduleRun(record.tuning, record.loop, plan, record.started_at, earlier=tuple(record.points))


def earlier(record: LeaseRecord, loop: LoopTable | None, journal: Journal, known: TuningRun | None = None) -> Earlier:
    """Return the interrupted run of an earlier program; `known` is its tuning where this program has it."""
    match record.kind:
        case Kind.TUNING:
            return earlier_tuning(record, loop)
        case Kind.VERIFICATION:
            return earlier_verification(record, loop, journal, known)
        case Kind.SCHEDULE:
            return earlier_schedule(record, loop)
        case Kind.GAINS:
            return EarlierGains(record.loop)


def _request(record: LeaseRecord, loop: LoopTable | None) -> TuningRequest:
    try:
        requested = record.request
        spec, budget_ms = design_spec_from(requested), requested.get("budget_ms")
        return TuningRequest(record.settings, requested["structure"], spec, requested["actor"], budget_ms)
    except (InputError, KeyError, TypeError):  # of another version: its request is lost, its record is not
        return TuningRequest(loop.experiment_settings() if loop else ExperimentSettings())


async def recover(earlier_run: Earlier, record: LeaseRecord, operations: Operations) -> bool:
    """Release the loop of an interrupted run, end the run and its record; return whether the release succeeded."""
    back = Back(_left(record) or (NOTHING if record.before is None else RESTORED), done=_left(record) is None)
    try:
        recovered: Recovered = await operations.begin(Recover(record), earlier_run.journal, earlier_run.publish).run()
        if recovered.undone is not None and isinstance(earlier_run, EarlierVerification):
            earlier_run.take_back(recovered.undone)
        parts = (recovered.gains,) if record.kind is Kind.GAINS else (recovered.gains, recovered.loop)
        done = recovered.gains.done and recovered.loop.done
        back = Back("; ".join(part.what for part in parts if part.what), done)
        back = Back(record.released) if record.released else back
    except Exception:  # noqa: BLE001 - whatever it was, it ends with a verdict and the next start tries again
        _log.exception("the loop %s could not be released", record.loop)
    finally:
        verdict = _given_back(record, back.what) if back.done else _unknown(record, back.what)
        try:
            if earlier_run.journal is not None:
                await uncancelled(earlier_run.journal.end(verdict if back.done else None))
        finally:  # a start that is stopped here reports it: the next one finds a record that has ended
            earlier_run.end(verdict)
    return back.done


async def recover_first(
    name: str, loop: LoopTable, backend: Backend, journal: Journal, processes: LoopProcesses | None = None
) -> list[tuple[LeaseRecord, Earlier]]:
    """Release a loop before any new operation; return the interrupted runs, each with its verdict.

    Raises
    ------
    LoopBusyError
        It was not interrupted: another program moves the loop.
    LinkError
        The loop could not be released, so nothing new may be done with it.
    OutputUnknownError
        No record holds the found values of the loop.
    """
    if (unresolved := journal.unresolved(name, loop.device_key)) is not None:
        raise OutputUnknownError(name, unresolved.name, unresolved.why)
    operations = Operations(name, loop, backend, GainsLedger(journal.store, name, journal.in_place), processes)
    found = []
    for record in journal.left(name):
        earlier_run = earlier(record, loop, journal)
        found.append((record, earlier_run))
        if record.device != loop.device_key:
            earlier_run.end(unreachable(record))
            continue
        earlier_run.journal = journal.resume(record)
        if not await recover(earlier_run, journal.again(record), operations) and earlier_run.verdict is not None:
            raise LinkError(earlier_run.verdict.message, remedy=earlier_run.verdict.remedy)
    return found


def unreachable(record: LeaseRecord) -> Verdict:
    """Return the verdict of an interrupted run whose device is no longer configured."""
    left = _left(record)
    if left is None:
        return _given_back(record, NOTHING)
    return failed(
        _code_of_unknown(record),
        f"{record.why}, and the device of loop {record.loop} is not configured any more: {left}",
        f"Put the device's table back as it was, or set {_by_hand(record)} by hand.",
    )


def _left(record: LeaseRecord) -> str | None:
    """Return the unknown values of a loop that has not been released; None where all are known."""
    before = record.before
    if record.restored or (before is None and record.proved is not False):
        return None
    if before is None:
        return "the old gains are not back"
    if before.set_point is not None:
        return SET_POINT_UNKNOWN.format(before.set_point)
    return UNKNOWN.format(before.output if record.target is None else record.target)


def _code_of_unknown(record: LeaseRecord) -> str:
    return "gains_unknown" if record.kind is Kind.GAINS else "output_unknown"


def _by_hand(record: LeaseRecord) -> str:
    before = record.before
    if before is None:
        return ", ".join(f"{name} {value:g}" for name, value in record.found.items()) or "the old gains"
    if before.set_point is None:
        return f"output {record.target:g}"
    return f"set point {before.set_point:g}" + (" and the old gains" if record.proved is False else "")


def _given_back(record: LeaseRecord, what: str) -> Verdict:
    if record.left is not None:
        text = f"{record.left.message}; the loop could not be released at that end, later {what}"
        return replace(record.left, message=text)
    if record.proved and record.kind is Kind.VERIFICATION:
        text = f"PV and output did what was predicted; the program was killed while the loop was being released: {what}"
        return Verdict(Outcome.DONE, "verified", text)
    return aborted(INTERRUPTED, f"{record.why}; {what}", START_AGAIN)


def _unknown(record: LeaseRecord, what: str) -> Verdict:
    return failed(
        _code_of_unknown(record),
        f"{record.why}, and {what}",
        f"Check the link: it is tried again with the next start. Or set {_by_hand(record)} on the device by hand.",
    )
