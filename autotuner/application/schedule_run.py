"""Tunings at several operating points in one request, and the resulting gain schedule.

    set point 1 -> rest -> tuning -> set point 2 -> rest -> tuning -> ... -> the first set point again

Invariants:

1. The device's own controller moves the loop from point to point; a tuning begins only at rest.
2. Every end leads through `_back`: a running tuning ends and releases its output, then the set point is restored.
   The journal has the original set point, and each point before the loop moves there: after a killed program, the
   next one restores it (`autotuner.application.recovery`). The device is locked from the first point to the last.
3. A point whose tuning ends without gains ends the run: a partial schedule is not returned.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, cast

from autotuner.application.tuning_run import gains_of
from autotuner.control.clock.ticker import utc_now
from autotuner.control.devices.plugins import is_simulated
from autotuner.control.devices.retrying import uncancelled
from autotuner.control.operations.crash_recovery import Recover
from autotuner.control.operations.operating_points import VisitPoints
from autotuner.control.records.lease_record import DamagedRecordError, Kind, read_record
from autotuner.control.reporting.event_log import log_event
from autotuner.core.design import gain_schedule
from autotuner.core.verdict import Outcome, Verdict, aborted, failed
from autotuner.errors import (
    AutotunerError,
    InputError,
    LinkError,
    ShuttingDownError,
    StorageError,
    TuningStateError,
    UnknownScheduleError,
)
from autotuner.ports import AUTO, OUTPUT, SET_POINT

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.application.loops import Loops
    from autotuner.application.operations import Operating
    from autotuner.application.tuning_run import TuningRequest, TuningRun
    from autotuner.control.operations.crash_recovery import Recovered
    from autotuner.control.records.lease_record import Before
    from autotuner.control.records.open_journal import OpenJournal
    from autotuner.control.reporting.events import Event
    from autotuner.core.design import GainSchedule, PidGains

Variable = Literal["set_point", "output"]
KEPT = 50
"""Ended runs that are remembered; the oldest go first."""

ABORTED = aborted("requested", "the run over the operating points was aborted", "Start it again when wanted.")

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class SchedulePlan:
    """Request of a run.

    Attributes
    ----------
    set_points : tuple of float
        Operating points in the order in which they are visited, PV units.
    request : TuningRequest
        How to tune at each.
    variable : str
        What the gains are scheduled by: the set point, or the output at rest there.
    hysteresis : float or None
        Of the schedule, units of the variable; a tenth of the smallest distance by default.
    """

    set_points: tuple[float, ...]
    request: TuningRequest
    variable: Variable = "set_point"
    hysteresis: float | None = None

    def to_dict(self) -> dict[str, object]:
        """Return everything, JSON-ready."""
        points = {"set_points": list(self.set_points), "variable": self.variable, "hysteresis": self.hysteresis}
        return {**self.request.to_dict(), **points}


@dataclass(slots=True)
class ScheduleRun:
    """State of a run.

    Attributes
    ----------
    id, loop, started_at : str
        Its identifier, its loop, when it began.
    plan : SchedulePlan
        What is to be done.
    tunings : list of Tuning
        Those that were begun, one a point.
    schedule : GainSchedule or None
        The outcome.
    verdict : Verdict or None
        How it ended.
    earlier : tuple of str
        Tunings that were begun by an earlier program.
    journal : OpenJournal or None
        Keeps on disk where the set point was found, and where it is taken; None where nothing outlives this program.
    """

    id: str
    loop: str
    plan: SchedulePlan
    started_at: str = field(default_factory=utc_now)
    tunings: list[TuningRun] = field(default_factory=list)
    schedule: GainSchedule | None = None
    verdict: Verdict | None = None
    earlier: tuple[str, ...] = ()
    journal: OpenJournal | None = None
    _found: Before | None = None

    def head(self, device: str) -> dict[str, object]:
        """Return the first line of the run's journal; `device` is its loop's `device_key`."""
        whose = {"tuning": self.id, "loop": self.loop, "device": device, "started_at": self.started_at}
        return {**whose, "kind": Kind.SCHEDULE, "request": self.plan.to_dict()}

    async def conduct(self, manager: Loops) -> None:
        """Visit the points; the verdict reports errors."""
        points, verdict = manager.operations(self.loop).begin(VisitPoints(), self.journal), None
        try:
            self._found = await manager.visit(self.loop, lambda: points.ask("find"))
            verdict = await self._visit_all(manager, points)
        except asyncio.CancelledError:
            verdict = ABORTED
        except AutotunerError as error:
            code = "storage_error" if isinstance(error, StorageError) else "device_error"
            verdict = failed(code, error.finding, error.remedy)
        except Exception as error:  # noqa: BLE001 - whatever it was, the set point must go back
            _log.exception("the run over the operating points failed")
            verdict = failed("internal_error", f"{type(error).__name__}: {error}", "Please report this with the log.")
        finally:
            await uncancelled(self._back(manager, points, verdict))

    def end(self, verdict: Verdict = ABORTED) -> None:
        """Mark the run as complete."""
        self.verdict = self.verdict or verdict

    def publish(self, event: Event) -> None:
        """Write an event of its recovery to the log."""
        log_event(self.id, self.loop, event)

    async def _visit_all(self, manager: Loops, points: Operating) -> Verdict:
        rows: list[tuple[float, PidGains]] = []
        for set_point in self.plan.set_points:
            trouble = await manager.visit(self.loop, lambda at=set_point: points.ask("settle", at))  # type: ignore[misc]
            if trouble is not None:
                return cast("Verdict", trouble)
            tuning = manager.start(self.loop, self.plan.request, within=self.journal)
            self.tunings.append(tuning)
            await points.ask("note", tuning.id)
            await manager.until_free(tuning)
            if not tuning.succeeded or tuning.analysis is None or tuning.analysis.gains is None:
                assert tuning.verdict is not None  # noqa: S101 - it has ended
                return Verdict(Outcome.FAILED, "point_failed", f"at {set_point:g}: {tuning.verdict.message}",
                               tuning.verdict.remedy)  # fmt: skip
            rows.append((_value(tuning, self.plan.variable, set_point), tuning.analysis.gains.gains))
        self.schedule = gain_schedule(rows, self.plan.hysteresis)
        return Verdict(Outcome.DONE, "scheduled", f"gains at {len(rows)} operating points")

    async def _back(self, manager: Loops, points: Operating, verdict: Verdict | None) -> None:
        for tuning in self.tunings[-1:]:
            if not tuning.ended:
                tuning.abort(ABORTED)
            await manager.until_free(tuning)
        assert verdict is not None  # noqa: S101 - every way sets it
        unrestored = await self._released(manager, points, verdict)
        if self.journal is not None:
            await self.journal.end(verdict, released=unrestored is None)
        self.verdict = unrestored or verdict

    async def _released(self, manager: Loops, points: Operating, verdict: Verdict) -> Verdict | None:
        """Have the set point restored, unless another one drives the loop; return why it is unknown, or None."""

        async def release() -> bool:
            done = bool(await points.ask("release", verdict))
            await points.run()
            return done

        async def recovered() -> bool:
            if self.journal is None:
                return False
            record = await asyncio.to_thread(read_record, self.journal.store, self.journal.name)
            back: Recovered = await manager.operations(self.loop).begin(Recover(record), self.journal).run()
            return back.loop.done

        why = "the device does not answer"
        try:
            if await manager.visit(self.loop, release, restores=True):
                return None
        except LinkError as error:  # the process was lost, or has ended without a front: the rest is in its record
            why = str(error)
            with contextlib.suppress(AutotunerError, OSError, DamagedRecordError):
                if await manager.visit(self.loop, recovered, restores=True):
                    return None
        except AutotunerError as error:
            why = str(error)
        found = self._found.set_point if self._found is not None else math.nan
        unrestored = f"the set point could not be restored: {why}"
        return failed("set_point_unknown", unrestored, f"Set it to {found:g} by hand.")

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return {
            "id": self.id,
            "loop": self.loop,
            "started_at": self.started_at,
            "state": "running" if self.verdict is None else "ended",
            "set_points": list(self.plan.set_points),
            "variable": self.plan.variable,
            "tuning_ids": [*self.earlier, *(tuning.id for tuning in self.tunings)],
            "schedule": self.schedule.to_dict() if self.schedule else None,
            "verdict": self.verdict.to_dict() if self.verdict else None,
        }


class Schedules:
    """The runs of one service.

    Parameters
    ----------
    manager : Loops
        Starts the tunings.
    """

    def __init__(self, manager: Loops) -> None:
        self._manager = manager
        self._runs: dict[str, ScheduleRun] = {}
        self._tasks: dict[str, asyncio.Task[None]] = {}

    def start(self, loop: str, plan: SchedulePlan) -> ScheduleRun:
        """Start a run.

        Raises
        ------
        InputError
            Fewer than two points, one twice, or outside the limits of the PV; a loop whose set point cannot be moved.
        LoopBusyError, UnknownLoopError, ShuttingDownError
            As for a tuning.
        TuningStateError
            Another run holds the loop.
        StorageError
            The set point that is about to be moved could not be kept on disk.
        """
        table, backend = self._manager.device(loop)
        if self._manager.closing:
            raise ShuttingDownError
        _check(plan, table.experiment_settings().limits.pv)
        if SET_POINT not in backend.writable or not {SET_POINT, AUTO, OUTPUT} <= backend.readable:
            raise InputError(
                "cannot be taken from point to point: its set point, its mode or its output is not mapped",
                field="loop",
                value=loop,
                remedy="Map set_point (for writing too), auto and output of the device's own controller.",
            )
        self._manager.must_be_given_back(loop)
        if any(run.loop == loop and run.verdict is None for run in self._runs.values()):
            raise TuningStateError(
                "is being taken over its operating points", field="loop", value=loop, remedy="Wait, or abort that run."
            )
        run = ScheduleRun(self._manager.new_id(), loop, plan)
        if not is_simulated(backend):
            run.journal = self._manager.journal.begin(run.head(table.device_key))
        self.show(run)
        task = self._tasks[run.id] = asyncio.create_task(run.conduct(self._manager), name=f"schedule-{run.id}")
        task.add_done_callback(lambda _: self._tasks.pop(run.id, None))
        task.add_done_callback(lambda _: run.end())  # one that was cancelled before its first step has no verdict
        return run

    @property
    def held(self) -> set[str]:
        """Loops whose set point is moved, or being restored."""
        return {run.loop for run in self._runs.values() if run.verdict is None and run.id in self._tasks}

    def show(self, run: ScheduleRun) -> None:
        """Keep a run for later requests, and drop the oldest ended ones."""
        self._runs[run.id] = run
        for old in [r.id for r in self._runs.values() if r.verdict is not None][:-KEPT]:
            del self._runs[old]

    def loop_of(self, run_id: str | None) -> str | None:
        """Return the loop of a run; None when there is no such run."""
        found = self._runs.get(run_id or "")
        return found.loop if found else None

    def run(self, run_id: str) -> ScheduleRun:
        """Return a run; raise `UnknownScheduleError` when there is none."""
        if (run := self._runs.get(run_id)) is None:
            raise UnknownScheduleError("is not a known run", field="schedule", value=run_id, remedy="Start one.")
        return run

    def abort(self, run_id: str) -> ScheduleRun:
        """End a run: its tuning gives its output back, then the set point goes back."""
        run = self.run(run_id)
        if run_id in self._tasks:
            self._tasks[run_id].cancel()
        return run

    async def close(self) -> None:
        """End every run, and wait until its set point is restored."""
        for task in self._tasks.values():
            task.cancel()
        await asyncio.gather(*self._tasks.values(), return_exceptions=True)


def combined(tunings: Sequence[TuningRun], variable: Variable, hysteresis: float | None) -> GainSchedule:
    """Return the schedule of tunings that were made at several operating points.

    Raises
    ------
    TuningStateError
        One has no gains.
    InputError
        They are of several loops, or no schedule can be made of them.
    """
    if len(loops := {tuning.loop for tuning in tunings}) > 1:
        raise InputError(
            "are of several loops", field="tuning_ids", value=sorted(loops), remedy="Give tunings of one loop."
        )
    rows = [(_value(tuning, variable, None), gains_of(tuning)) for tuning in tunings]
    return gain_schedule(rows, hysteresis)


def _value(tuning: TuningRun, variable: Variable, set_point: float | None) -> float:
    """Return the variable where the loop was found."""
    if variable == "set_point" and set_point is not None:
        return set_point
    if variable == "output" and tuning.before is not None:
        return tuning.before.output
    raise InputError(
        "is not known for a tuning outside of a run over operating points",
        field="variable",
        value=variable,
        remedy="Use output.",
    )


def _check(plan: SchedulePlan, pv: tuple[float, float]) -> None:
    problems = {
        "needs two operating points at least": len(plan.set_points) < 2,
        "has the same operating point twice": len(set(plan.set_points)) < len(plan.set_points),
        f"has a point outside the limits of the PV, {pv[0]:g} to {pv[1]:g}": not all(
            pv[0] < point < pv[1] for point in plan.set_points
        ),
    }
    for what, holds in problems.items():
        if holds:
            raise InputError(
                what, field="set_points", value=list(plan.set_points), remedy="Give the points in PV units."
            )
