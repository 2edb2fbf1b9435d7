"""Loops and their tunings: which operation may start, and how each one ends.

Invariants: one tuning a loop at a time; a tuning that was started is found under its identifier as long as the
manager lives; a loop that a killed program left disturbed is released before anything new is started on it; closing the
manager ends every running tuning and waits until its output is restored; from then on nothing is started; the result of
a tuning is handed to the archive before its gains are written.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import secrets
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar, cast

from autotuner.application.computing.compute_pool import InPlace
from autotuner.application.gain_service import GainService
from autotuner.application.interrupted_runs import InterruptedRuns
from autotuner.application.loop_processes import LoopProcesses, loop_processes
from autotuner.application.monitor import Monitors
from autotuner.application.reload import Reloaded, differences, merged
from autotuner.application.remote_controller import RemoteController
from autotuner.application.schedule_run import Schedules
from autotuner.application.tuning_run import TuningRequest, TuningRun, here
from autotuner.control.clock.ticker import utc_now
from autotuner.control.devices.device_gains import device_form
from autotuner.control.devices.device_polling import Reading, Visits
from autotuner.control.devices.plugins import is_simulated, make_backend
from autotuner.control.devices.ranges import check_ranges
from autotuner.control.records.journal import Journal
from autotuner.control.reporting.event_log import log_gains
from autotuner.core.verdict import aborted
from autotuner.errors import AutotunerError, LoopBusyError, ShuttingDownError, UnknownTuningError

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from autotuner.application.interrupted_runs import RecoveredLoop
    from autotuner.application.operations import Operations
    from autotuner.application.tuning_run import MakeConductor
    from autotuner.configuration import Configuration, LoopTable
    from autotuner.control.compute_port import ComputePool
    from autotuner.control.gains.apply import Applied
    from autotuner.control.records.open_journal import OpenJournal
    from autotuner.core.design import PidGains
    from autotuner.ports import Backend

T = TypeVar("T")

KEPT = 200
"""Ended tunings that are remembered; the oldest go first."""
STORED_WITHIN_S = 5.0
"""Longest wait for the archive before gains are written, s: a write takes some milliseconds."""


async def store_nothing() -> None:
    """Do nothing: a program without an archive."""


def random_id() -> str:
    """Return a new identifier that cannot be guessed."""
    return secrets.token_hex(6)


@dataclass(slots=True)
class Manager:
    """All loops of one service.

    Attributes
    ----------
    configuration : Configuration
        The loops.
    pool : ComputePool
        Where identification runs.
    new_id : callable
        Makes identifiers of tunings.
    tunings : dict of str to Tuning
        The tunings by identifier, oldest first.
    journal : Journal
        Records disturbed loops on disk; simulated loops are not recorded.
    schedules : Schedules
        Runs over several operating points.
    monitors : Monitors
        The loops that are watched in their normal running.
    left : InterruptedRuns
        Interrupted runs of killed programs.
    closing : bool
        Whether the manager is being closed.
    store : callable
        Stores the results so far, as far as that is possible; does not raise. Awaited before gains of a tuning are
        written, for `STORED_WITHIN_S` at most: after a kill between two registers, the result to which these belong is
        known. A rollback does not wait for it.
    """

    configuration: Configuration
    pool: ComputePool
    new_id: Callable[[], str] = random_id
    tunings: dict[str, TuningRun] = field(default_factory=dict)
    journal: Journal = field(init=False)
    schedules: Schedules = field(init=False)
    monitors: Monitors = field(init=False)
    left: InterruptedRuns = field(init=False)
    closing: bool = False
    store: Callable[[], Coroutine[object, object, None]] = store_nothing
    _backends: dict[str, Backend] = field(default_factory=dict)
    _gain_services: dict[str, GainService] = field(default_factory=dict)
    _visits: dict[str, Visits] = field(default_factory=dict)
    _again: set[str] = field(default_factory=set)
    _tasks: dict[str, asyncio.Task[object]] = field(default_factory=dict)
    _processes: LoopProcesses | None = None

    def __post_init__(self) -> None:
        self.schedules = Schedules(self)
        self.monitors = Monitors(self)
        self.left = InterruptedRuns(self, self.schedules)
        if not isinstance(self.pool, InPlace):  # in virtual time there are no processes
            self._processes = loop_processes(self.configuration.service.real_time)
        folder = Path(self.configuration.service.data_directory)
        self.journal = Journal(folder, in_place=isinstance(self.pool, InPlace))
        for name, loop in self.configuration.loops.items():
            self._furnish(name, loop, self._backend(name, loop))

    def _backend(self, name: str, loop: LoopTable) -> Backend:
        """Return the device of a loop; raise `ConfigurationError` for a table that cannot work."""
        backend = make_backend(loop.driver, loop.device, f"loops.{name}")
        check_ranges(loop.experiment_settings().limits, backend, f"loops.{name}")
        device_form(loop, backend, f"loops.{name}")
        return backend

    def _furnish(self, name: str, loop: LoopTable, backend: Backend) -> None:
        self._backends[name] = backend
        self._visits[name] = Visits(backend, loop.sample_time_s)
        self._gain_services[name] = GainService(
            name, loop, backend, self.journal, self._processes, own=self._has_its_own(loop)
        )

    def open(self) -> None:
        """Release the loops that a killed program left disturbed; each is held until that is done."""
        self.left.open()

    async def reload(self, configuration: Configuration) -> Reloaded:
        """Take over the loops of another configuration; one that a tuning holds keeps its table.

        Raises
        ------
        ConfigurationError
            A table of it cannot work: nothing has changed.
        ShuttingDownError
            The manager is being closed.
        """
        if self.closing:
            raise ShuttingDownError
        old = self.configuration
        backends = {
            name: self._backend(name, loop) for name, loop in configuration.loops.items() if old.loops.get(name) != loop
        }
        await asyncio.gather(*(self._visits[name].clear() for name in old.loops if name not in self._held()))
        change = differences(old, configuration, self._held())  # from here on it is one step
        for name in change.removed:
            self.monitors.forget(name)
            del self._backends[name], self._visits[name], self._gain_services[name]
        for name in change.new:
            self._furnish(name, configuration.loops[name], backends[name])
        self.configuration = merged(old, configuration, change)
        return change

    def _held(self) -> set[str]:
        """Return the loops that a tuning, a run over operating points, or a recovery holds."""
        return {*self.holders(), *self.schedules.held, *self.left.held}

    def holders(self) -> dict[str, TuningRun]:
        """Return the loops that are held, with the tunings that hold them."""
        return {tuning.loop: tuning for tuning in self.tunings.values() if tuning.id in self._tasks}

    @property
    def busy(self) -> bool:
        """Whether any tuning holds its loop, or a loop that a killed program left disturbed is being released."""
        return bool(self._tasks) or self.left.busy

    @property
    def recovered_loops(self) -> list[RecoveredLoop]:
        """The loops that killed programs left disturbed."""
        return self.left.reported

    def running(self, loop: str) -> TuningRun | None:
        """Return the tuning that holds the loop, or None."""
        self.configuration.loop(loop)
        return self.holders().get(loop)

    def start(
        self,
        loop: str,
        request: TuningRequest,
        *,
        apply: bool = False,
        verify: bool = False,
        within: OpenJournal | None = None,
        tuning_id: str | None = None,
    ) -> TuningRun:
        """Start a tuning; `apply` writes its gains into the device at the end, `verify` verifies them there too.

        `within` is the journal of the run over operating points that it belongs to, `tuning_id` its identifier where
        that is already known.

        Raises
        ------
        UnknownLoopError
            No such loop.
        LoopBusyError
            Another tuning holds the loop; its identifier is in the error.
        ShuttingDownError
            The manager is being closed.
        StorageError
            What is about to be disturbed could not be kept on disk.
        """
        table = self.configuration.loop(loop)
        if self.closing:
            raise ShuttingDownError
        self.must_be_free(loop)
        if apply or verify:
            self._gain_services[loop].writer()
        backend, tuning = self._backends[loop], TuningRun(tuning_id or self.new_id(), loop, request)
        if not is_simulated(backend):
            self.must_be_given_back(loop)
            tuning.journal = self.journal.begin(tuning.head(table.device_key), within)
        work = tuning.conduct(table, backend, self.pool, self._conductor(loop))
        self.hold(tuning, self._with_gains(tuning, work, verify=verify) if apply or verify else work)
        return tuning

    async def _with_gains(self, tuning: TuningRun, work: Coroutine[object, object, object], *, verify: bool) -> None:
        """Conduct a tuning, then write its gains, and verify them; errors are reported by the tuning."""
        await work
        self._again.add(tuning.id)
        try:
            if tuning.succeeded:
                await self._results_stored()
                await self._gain_services[tuning.loop].use(tuning, self.pool if verify else None)
        except AutotunerError as error:
            tuning.trouble = str(error)
            log_gains(tuning.id, tuning.loop, f"the gains were not applied: {error}")
        finally:
            self._again.discard(tuning.id)

    def tuning(self, tuning_id: str) -> TuningRun:
        """Return a tuning; raise `UnknownTuningError` when there is none."""
        if (tuning := self.tunings.get(tuning_id)) is None:
            raise UnknownTuningError(
                "is not a known tuning", field="tuning", value=tuning_id, remedy="List the tunings of the loop."
            )
        return tuning

    def newest_first(self) -> list[TuningRun]:
        """Return all tunings."""
        return list(self.tunings.values())[::-1]

    def gain_service(self, loop: str) -> GainService:
        """Return the gain service of a loop; raise `UnknownLoopError` when there is no such loop."""
        self.configuration.loop(loop)
        return self._gain_services[loop]

    def operations(self, loop: str) -> Operations:
        """Return the operations of a loop."""
        return self.gain_service(loop).operations

    def device(self, loop: str) -> tuple[LoopTable, Backend]:
        """Return a loop's table and device; raise `UnknownLoopError` when there is no such loop."""
        return self.configuration.loop(loop), self._backends[loop]

    def must_be_free(self, loop: str) -> None:
        """Raise `LoopBusyError` when a tuning or its recovery holds the loop."""
        if (holder := self.running(loop)) is not None:
            raise LoopBusyError(loop, holder.id)
        if (held_by := self.left.held.get(loop)) is not None:
            raise LoopBusyError(loop, held_by)

    def must_be_given_back(self, loop: str) -> None:
        """Raise `LoopBusyError` as `must_be_free` does; first repeat a recovery that has failed."""
        if not is_simulated(self._backends[loop]):
            self.left.take_up(loop)
        self.must_be_free(loop)

    async def until_free(self, tuning: TuningRun) -> None:
        """Wait until a tuning has ended and holds its loop no more."""
        if (task := self._tasks.get(tuning.id)) is not None:
            await asyncio.wait([task])

    async def visit(self, loop: str, work: Callable[[], Coroutine[object, object, T]], *, restores: bool = False) -> T:
        """Do short work on the device of an idle loop; a tuning that is started ends it, or waits for it.

        Work that `restores` is waited for.

        Raises
        ------
        UnknownLoopError
            No such loop.
        LoopBusyError
            A tuning holds the loop, or has taken it meanwhile.
        """
        self.must_be_free(loop)
        try:
            return await self._visits[loop].visit(work, restores=restores)
        except asyncio.CancelledError:
            try:
                self.must_be_free(loop)
            except LoopBusyError as error:
                raise error from None
            raise

    def reading(self, loop: str) -> Reading:
        """Return the present values of the loop: the last sample of a tuning, else the last poll."""
        holder = self.running(loop)
        if holder is None and not self.closing:
            self._visits[loop].look()
        if holder is None or not holder.samples:
            return self._visits[loop].reading
        last = holder.samples[-1]
        set_point = last.set_point if math.isfinite(last.set_point) else None
        return Reading(utc_now(), last.pv, last.output, set_point, link="up")

    async def with_loop(self, tuning: TuningRun, work: Callable[[], Coroutine[object, object, T]]) -> T:
        """Let an ended tuning hold its loop again during `work`, which continues when the caller is cancelled.

        Raises
        ------
        LoopBusyError
            A tuning holds the loop.
        ShuttingDownError
            The manager is being closed.
        """
        if self.closing:
            raise ShuttingDownError
        while (holder := self.running(tuning.loop)) is not None:
            if not holder.ended or holder.id in self._again:
                raise LoopBusyError(tuning.loop, holder.id)
            await asyncio.wait([self._tasks[holder.id]])  # its verdict is known, and it is about to end
        self.must_be_given_back(tuning.loop)
        self._again.add(tuning.id)
        task = self.hold(tuning, work())
        task.add_done_callback(lambda _: self._again.discard(tuning.id))
        task.add_done_callback(lambda done: done.cancelled() or done.exception())  # retrieved even without a caller
        return cast("T", await asyncio.shield(task))

    async def apply(self, tuning: TuningRun, gains: PidGains) -> Applied:
        """Write gains of a tuning that holds its loop, once its result is stored; see `GainService.apply`."""
        await self._results_stored()
        return await self._gain_services[tuning.loop].apply(tuning, gains)

    async def _results_stored(self) -> None:
        with contextlib.suppress(TimeoutError):  # a database that hangs keeps no gains back
            async with asyncio.timeout(STORED_WITHIN_S):
                await self.store()

    async def close(self) -> None:
        """End every running tuning, wait until its output is restored, and give the workers back; may be repeated.

        A recovery that has failed so far is left to the next start.
        """
        self.closing = True
        await self.left.close()
        await self.schedules.close()
        await self.monitors.close()
        for tuning in self.tunings.values():
            if not tuning.ended or tuning.verifier is not None:
                tuning.abort(aborted("shutdown", "the service was stopped", "Start the tuning again."))
        self.pool.interrupt()  # a tuning whose output is restored waits for nothing else
        await asyncio.gather(*(visits.clear() for visits in self._visits.values()))
        await asyncio.gather(*self._tasks.values(), return_exceptions=True)
        if self._processes is not None:
            await self._processes.close()
        self.pool.close()

    def hold(self, tuning: TuningRun, work: Coroutine[object, object, object]) -> asyncio.Task[object]:
        """Let a tuning hold its loop until `work` is done."""
        self.tunings[tuning.id] = tuning
        self._forget_oldest()
        task = self._tasks[tuning.id] = asyncio.create_task(self._alone(tuning.loop, work), name=f"tuning-{tuning.id}")
        task.add_done_callback(lambda _: work.close())  # for a task that was cancelled before its first step
        task.add_done_callback(lambda _: self._tasks.pop(tuning.id, None))
        task.add_done_callback(lambda _: None if self.closing else self.left.go_on(tuning.loop))
        return task

    async def _alone(self, loop: str, work: Coroutine[object, object, object]) -> object:
        """Do `work` on a loop once the visits to its device have ended."""
        await self.leave(loop)
        return await work

    async def leave(self, loop: str) -> None:
        """End the visits to a device."""
        if loop in self._visits:
            await self._visits[loop].clear()

    def _conductor(self, loop: str) -> MakeConductor:
        """Return the conductor of a tuning's experiment: a loop process, where requests do not delay samples."""
        processes, operations = self._processes, self.operations(loop)
        if processes is None or operations.stays:
            return here
        return lambda tuning, _loop, _backend: RemoteController(tuning, operations, processes, self.pool)

    def _has_its_own(self, loop: LoopTable) -> bool:
        """Return the loop's `own_process`; where it is unset, whether a millisecond counts."""
        return self.configuration.is_urgent(loop) if loop.own_process is None else loop.own_process

    def _forget_oldest(self) -> None:
        surplus = max(len(self.tunings) - KEPT, 0)
        for tuning_id in [key for key, tuning in self.tunings.items() if tuning.ended][:surplus]:
            del self.tunings[tuning_id]
