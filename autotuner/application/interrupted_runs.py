"""Interrupted runs of killed programs on the loops of a manager: each loop is held until it is released.

Invariants:

1. On one loop, one after the other: a tuning before the run that it belongs to.
2. A release that fails is tried again before anything new is done with the loop.
3. A loop whose process has outlived its service, or that another program moves, is polled until it is free.
4. A failed restore is repeated for as long as the program lives.
5. A loop without a readable record of its found values is held and reported; nothing is written to it.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING

from autotuner.application.recovery import EarlierVerification, earlier, recover, unreachable
from autotuner.application.schedule_run import ScheduleRun
from autotuner.application.tuning_run import TuningRun
from autotuner.control.clock.ticker import utc_now
from autotuner.control.devices.plugins import is_simulated
from autotuner.control.records.atomic_file import clear_unfinished
from autotuner.control.records.lease_record import Kind
from autotuner.errors import LoopBusyError, OutputUnknownError, StorageError

if TYPE_CHECKING:
    from collections.abc import Coroutine

    from autotuner.application.loops import Loops
    from autotuner.application.recovery import Earlier
    from autotuner.application.schedule_run import Schedules
    from autotuner.control.records.lease_record import LeaseRecord

_log = logging.getLogger(__name__)

SHOWN = (Kind.TUNING, Kind.SCHEDULE)
"""The kinds that are listed after recovery; the tuning lists its verification, the ledger a change of gains."""
RESTORE_AGAIN_S = 10.0
"""Time from a try to restore a loop that failed to the next one, s."""
RETRY_S = 2.0
"""Poll period for a device that another program holds, s."""


@dataclass(frozen=True, slots=True)
class RecoveredLoop:
    """The outcome of a recovery: whether the loop was released, and after what kind of run."""

    at: str
    kind: Kind
    loop: str
    id: str
    done: bool
    after: str


class InterruptedRuns:
    """Interrupted runs of killed programs.

    Parameters
    ----------
    manager : Loops
        Has the loops.
    schedules : Schedules
        Shows the runs over operating points.

    Attributes
    ----------
    held : dict of str to str
        Loops that are being released, each with the interrupted run.
    reported : list of GivenBack
        The outcomes; only appended to.
    unknown : dict of str to str
        Loops whose output is unknown because their record is damaged or missing, each with the reason.
    """

    def __init__(self, manager: Loops, schedules: Schedules) -> None:
        self.held: dict[str, str] = {}
        self.reported: list[RecoveredLoop] = []
        self.unknown: dict[str, str] = {}
        self._retried: set[str] = set()
        self._manager, self._schedules = manager, schedules
        self._tasks: set[asyncio.Task[object]] = set()

    @property
    def busy(self) -> bool:
        """Whether any loop is being released, or will be once another program unlocks it."""
        return bool(self._tasks)

    def open(self) -> None:
        """List earlier recoveries, and release the other loops."""
        journal = self._manager.journal
        clear_unfinished(journal.folder)
        for loop in self._manager.configuration.loops:
            with contextlib.suppress(OutputUnknownError):
                self.must_be_known(loop)
        for record in journal.made_good():
            if record.kind in SHOWN and record.verdict is not None:
                earlier_run = self._show(record)
                settle = earlier_run.settle if isinstance(earlier_run, TuningRun) else earlier_run.end
                settle(record.verdict)
        by_loop: dict[str, list[LeaseRecord]] = {}
        for record in journal.left():
            if self._is_known(record):
                by_loop.setdefault(record.loop, []).append(record)
            else:
                self._show(record).end(unreachable(record))
        for loop, left in by_loop.items():
            try:
                self._take_up(loop, left)
            except LoopBusyError:
                self._begin(self._later(loop, left))

    def take_up(self, loop: str) -> None:
        """Begin to give a loop back, where that is still to be done; raise `LoopBusyError` where another moves it."""
        self.must_be_known(loop)
        left = [record for record in self._manager.journal.left(loop) if self._is_known(record)]
        if left and loop not in self.held:
            self._take_up(loop, left)

    def must_be_known(self, loop: str) -> None:
        """Raise `OutputUnknownError` where a loop was disturbed and no record holds its found values."""
        table, backend = self._manager.device(loop)
        if is_simulated(backend):
            return
        found = self._manager.journal.unresolved(loop, table.device_key)
        if found is None:
            if self.unknown.pop(loop, None) is not None:
                _log.info("loop %s: a person has confirmed its output", loop)
            return
        error = OutputUnknownError(loop, found.name, found.why)
        if self.unknown.get(loop) != str(error):
            _log.error("%s", error)
            self.reported.append(
                RecoveredLoop(utc_now(), Kind.TUNING, loop, found.name, done=False, after="after a kill")
            )
        self.unknown[loop] = str(error)
        raise error

    def go_on(self, loop: str) -> None:
        """Go on restoring a loop, where that is still to be done."""
        if is_simulated(self._manager.device(loop)[1]):
            return
        tunings = [self._manager.tunings.get(record.tuning) for record in self._manager.journal.left(loop)]
        if tunings and all(one is None or one.analysis is None for one in tunings):  # a result stays as it is shown
            self._begin(self._again(loop))

    async def _again(self, loop: str) -> None:
        await asyncio.sleep(RESTORE_AGAIN_S)
        self._retried.add(loop)
        with contextlib.suppress(LoopBusyError):
            self.take_up(loop)

    def _take_up(self, loop: str, left: list[LeaseRecord]) -> None:
        first = self._resumed(left[0])
        self.held[loop] = left[0].tuning
        work = self._give_back(loop, first, left)
        tuning = first.tuning if isinstance(first, EarlierVerification) else first
        if isinstance(tuning, TuningRun):
            self._keep(self._manager.hold(tuning, work))
        else:
            self._begin(work)

    async def close(self) -> None:
        """Stop: the remaining loops wait for the next start."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def _begin(self, work: Coroutine[object, object, object]) -> None:
        self._keep(asyncio.create_task(work, name="left-behind"))

    def _keep(self, task: asyncio.Task[object]) -> None:
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _later(self, loop: str, left: list[LeaseRecord]) -> None:
        """Give a loop back once no other program holds its device."""
        while any(map(self._manager.journal.is_held, left)):  # noqa: ASYNC110 - another program sets no event
            await asyncio.sleep(RETRY_S)
        with contextlib.suppress(LoopBusyError):  # another program recovers it by now
            self.take_up(loop)

    async def _give_back(self, loop: str, first: Earlier, left: list[LeaseRecord]) -> None:
        manager = self._manager
        try:
            await manager.leave(loop)
            for record in left:
                earlier_run = first if record is left[0] else self._resumed(record)
                done = await recover(earlier_run, manager.journal.again(record), manager.operations(loop))
                if done or loop not in self._retried:  # that it failed is known by then
                    self.reported.append(RecoveredLoop(utc_now(), record.kind, loop, record.tuning, done, record.after))
                if not done:
                    self._begin(self._again(loop))
                    return
        except LoopBusyError:  # another program recovers the next of them by now
            return
        finally:
            del self.held[loop]

    def _resumed(self, record: LeaseRecord) -> Earlier:
        """Present an interrupted run, with its journal where the disk allows; raise `LoopBusyError`."""
        journal = None
        with contextlib.suppress(StorageError):  # the loop is released all the same
            journal = self._manager.journal.resume(record)
        earlier_run = self._show(record)
        earlier_run.journal = journal
        return earlier_run

    def _show(self, record: LeaseRecord) -> Earlier:
        manager = self._manager
        known = manager.tunings.get(record.tuning)
        earlier_run = earlier(record, manager.configuration.loops.get(record.loop), manager.journal, known)
        if isinstance(earlier_run, ScheduleRun):
            self._schedules.show(earlier_run)
        elif isinstance(
            tuning := earlier_run.tuning if isinstance(earlier_run, EarlierVerification) else earlier_run, TuningRun
        ):
            manager.tunings[record.tuning] = tuning
        return earlier_run

    def _is_known(self, record: LeaseRecord) -> bool:
        loop = self._manager.configuration.loops.get(record.loop)
        return loop is not None and loop.device_key == record.device
