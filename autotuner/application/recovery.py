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
    """What an earlier program began, as it is shown."""

    journal: OpenJournal | None

    @property
    def verdict(self) -> Verdict | None:
        """How it ended."""

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
        """How it ended."""
        return self.run.verdict

    def publish(self, event: Event) -> None:
        """Take an event of its recovery."""
        if self.tuning.ended:  # no reader is left
            log_event(self.tuning.id, self.tuning.loop, event)
        else:
            self.tuning.publish(event)

    def take_back(self, back: RolledBack) -> None:
        """Take note that the old gains are in the device again."""
        self.run.rolled_back, self.run.back = True, back
        self.tuning.applied, self.tuning.device_gains = None, dict(back.now)

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


def earlier_tuning(kept: LeaseRecord, loop: LoopTable | None) -> TuningRun:
    """Return a tuning that an earlier program began, with everything from its journal."""
    request = _request(kept, loop)
    events: list[Event] = [SampleTaken.of(sample) for sample in kept.samples]
    return TuningRun(kept.tuning, kept.loop, request, kept=kept, started_at=kept.started_at, events=events)


def earlier_verification(
    kept: LeaseRecord, loop: LoopTable | None, journal: Journal, known: TuningRun | None = None
) -> EarlierVerification:
    """Return a verification that an earlier program began; `known` is its tuning where this program has it."""
    own = journal.of_tuning(kept.tuning)
    tuning = known or earlier_tuning(own or kept, loop)
    tuning.verification = VerificationRun(started_at=kept.started_at)
    return EarlierVerification(tuning, own.verdict if own else None, tuning.verification)


def earlier_schedule(kept: LeaseRecord, loop: LoopTable | None) -> ScheduleRun:
    """Return a run over operating points that an earlier program began."""
    points, request = tuple(kept.request.get("set_points", ())), _request(kept, loop)
    plan = SchedulePlan(points, request, kept.request.get("variable", "set_point"), kept.request.get("hysteresis"))
    return ScheduleRun(kept.tuning, kept.loop, plan, kept.started_at, earlier=tuple(kept.points))


def earlier(kept: LeaseRecord, loop: LoopTable | None, journal: Journal, known: TuningRun | None = None) -> Earlier:
    """Return what an earlier program began; `known` is its tuning where this program has it."""
    match kept.kind:
        case Kind.TUNING:
            return earlier_tuning(kept, loop)
        case Kind.VERIFICATION:
            return earlier_verification(kept, loop, journal, known)
        case Kind.SCHEDULE:
            return earlier_schedule(kept, loop)
        case Kind.GAINS:
            return EarlierGains(kept.loop)


def _request(kept: LeaseRecord, loop: LoopTable | None) -> TuningRequest:
    try:
        requested = kept.request
        spec, budget_ms = design_spec_from(requested), requested.get("budget_ms")
        return TuningRequest(kept.settings, requested["structure"], spec, requested["actor"], budget_ms)
    except (InputError, KeyError, TypeError):  # of another version: its request is lost, its record is not
        return TuningRequest(loop.experiment_settings() if loop else ExperimentSettings())


async def recover(shown: Earlier, kept: LeaseRecord, operations: Operations) -> bool:
    """Have the loop of what was interrupted released, and end it and its record; return whether that was done."""
    back = Back(_left(kept) or (NOTHING if kept.before is None else RESTORED), done=_left(kept) is None)
    try:
        recovered: Recovered = await operations.begin(Recover(kept), shown.journal, shown.publish).run()
        if recovered.undone is not None and isinstance(shown, EarlierVerification):
            shown.take_back(recovered.undone)
        parts = (recovered.gains,) if kept.kind is Kind.GAINS else (recovered.gains, recovered.loop)
        done = recovered.gains.done and recovered.loop.done
        back = Back("; ".join(part.what for part in parts if part.what), done)
        back = Back(kept.released) if kept.released else back
    except Exception:  # noqa: BLE001 - whatever it was, it ends with a verdict and the next start tries again
        _log.exception("the loop %s could not be released", kept.loop)
    finally:
        verdict = _given_back(kept, back.what) if back.done else _unknown(kept, back.what)
        if shown.journal is not None:
            await shown.journal.end(verdict if back.done else None)
        shown.end(verdict)
    return back.done


async def recover_first(
    name: str, loop: LoopTable, backend: Backend, journal: Journal, processes: LoopProcesses | None = None
) -> list[tuple[LeaseRecord, Earlier]]:
    """Have a loop released before anything new is done with it; return what was interrupted, each with its verdict.

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
    for kept in journal.left(name):
        shown = earlier(kept, loop, journal)
        found.append((kept, shown))
        if kept.device != loop.device_key:
            shown.end(unreachable(kept))
            continue
        shown.journal = journal.resume(kept)
        if not await recover(shown, journal.again(kept), operations) and shown.verdict is not None:
            raise LinkError(shown.verdict.message, remedy=shown.verdict.remedy)
    return found


def unreachable(kept: LeaseRecord) -> Verdict:
    """Return the verdict of what was interrupted, and whose device the configuration does not know any more."""
    left = _left(kept)
    if left is None:
        return _given_back(kept, NOTHING)
    return failed(
        _code_of_unknown(kept),
        f"{kept.why}, and the device of loop {kept.loop} is not configured any more: {left}",
        f"Put the device's table back as it was, or set {_by_hand(kept)} by hand.",
    )


def _left(kept: LeaseRecord) -> str | None:
    """Return what is unknown of a loop that has not been released; None where nothing is."""
    before = kept.before
    if kept.restored or (before is None and kept.proved is not False):
        return None
    if before is None:
        return "the old gains are not back"
    if before.set_point is not None:
        return SET_POINT_UNKNOWN.format(before.set_point)
    return UNKNOWN.format(before.output if kept.target is None else kept.target)


def _code_of_unknown(kept: LeaseRecord) -> str:
    return "gains_unknown" if kept.kind is Kind.GAINS else "output_unknown"


def _by_hand(kept: LeaseRecord) -> str:
    before = kept.before
    if before is None:
        return ", ".join(f"{name} {value:g}" for name, value in kept.found.items()) or "the old gains"
    if before.set_point is None:
        return f"output {kept.target:g}"
    return f"set point {before.set_point:g}" + (" and the old gains" if kept.proved is False else "")


def _given_back(kept: LeaseRecord, what: str) -> Verdict:
    if kept.left is not None:
        text = f"{kept.left.message}; the loop could not be released at that end, later {what}"
        return replace(kept.left, message=text)
    if kept.proved and kept.kind is Kind.VERIFICATION:
        text = f"PV and output did what was predicted; the program was killed while the loop was being released: {what}"
        return Verdict(Outcome.DONE, "verified", text)
    return aborted(INTERRUPTED, f"{kept.why}; {what}", START_AGAIN)


def _unknown(kept: LeaseRecord, what: str) -> Verdict:
    return failed(
        _code_of_unknown(kept),
        f"{kept.why}, and {what}",
        f"Check the link: it is tried again with the next start. Or set {_by_hand(kept)} on the device by hand.",
    )
