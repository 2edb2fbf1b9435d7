"""Execution of operations: in a loop process, or in this process.

    work -> begin -> run, ask, abort
    the process lost, or silent for LOST_S + GRACE_S -> killed -> ProcessLostError: the caller has the loop recovered

Invariants:

1. What an operation publishes is passed on at once and in order: a reader sees no difference.
2. A process that ends without a report of the loop's state, or is silent for that long, is killed.
3. Following an operation cannot be cancelled before it has ended.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from autotuner.application.computing.compute_pool import InPlace
from autotuner.application.loop_processes import HARDWARE, SIMULATED
from autotuner.control.devices.plugins import is_simulated
from autotuner.control.devices.retrying import to_its_end, uncancelled
from autotuner.control.forced_shutdown import forced_shutdown
from autotuner.control.operations.messages import (
    Abort,
    Alive,
    Answered,
    Compute,
    Done,
    Logged,
    MethodCall,
    Order,
    Published,
    WaitNoMore,
)
from autotuner.control.operations.operation import Answering, Station
from autotuner.control.records.lease_record import Kind
from autotuner.core.verdict import aborted
from autotuner.errors import LinkError, ShuttingDownError
from autotuner.ports import Carried

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.application.loop_processes import Lane, LoopProcesses
    from autotuner.configuration import LoopTable
    from autotuner.control.compute_port import ComputePool
    from autotuner.control.operations.messages import Wire
    from autotuner.control.operations.operation import Operation, Work
    from autotuner.control.records.gains_ledger import GainsLedger
    from autotuner.control.records.open_journal import OpenJournal
    from autotuner.core.verdict import Verdict
    from autotuner.ports import Backend

STARTED_S = 60.0
"""Longest time to the first message of a process, s."""
ALIVE_S = 1.0
"""Longest time between two messages to a process, s."""
LOST_S = 4.0
"""Longest time without a message, s; it sends one every second."""
GRACE_S = 1.0
"""Grace period after that, s: after a sleep of the machine, pending messages are read first."""
CANCELLED = aborted("cancelled", "the tuning was cancelled", "Start it again when wanted.")

_log = logging.getLogger(__name__)


class ProcessLostError(LinkError):
    """The loop process was lost before it reported the state of the loop; `how` it ended."""

    def __init__(self, loop: str, how: str) -> None:
        super().__init__(
            f"the process that drove the loop was lost ({how})", field="loop", value=loop, remedy="Try again."
        )
        self.how = how


class NoProcessError(LinkError):
    """The system has no room for a loop process."""


class Operating(Protocol):
    """A running operation."""

    async def run(self) -> Any:
        """Return the result; raise `ProcessLostError` where the state of the loop is unknown."""

    async def ask(self, name: str, *values: object) -> Any:
        """Have it do something; return the answer."""

    def abort(self, verdict: Verdict) -> None:
        """Request the end."""


class Here:
    """An operation in place."""

    def __init__(self, operation: Operation) -> None:
        self._operation = operation
        self.abort = operation.abort

    async def run(self) -> Any:
        """Do it."""
        return await self._operation.run()

    async def ask(self, name: str, *values: object) -> Any:
        """Have it do something."""
        assert isinstance(self._operation, Answering)  # noqa: S101 - others are not asked
        return await self._operation.ask(name, *values)


class Remote:
    """An operation in a loop process.

    Parameters
    ----------
    order : Order
        What is to be done.
    processes : LoopProcesses
        Has it done.
    pool : ComputePool
        Computes for it.
    publish : callable
        Receives published messages.
    journal : OpenJournal or None
        Its record, which is handed over meanwhile.
    process_name : str
        Which of the processes does it.
    """

    def __init__(
        self,
        order: Order,
        processes: LoopProcesses,
        pool: ComputePool,
        publish: Callable[[Any], None],
        journal: OpenJournal | None = None,
        *,
        process_name: str = HARDWARE,
    ) -> None:
        self._order, self._processes, self._arithmetic, self._publish = order, processes, pool, publish
        self._journal, self._process_name = journal, process_name
        self._lane: Lane | None = None
        self._stop_verdict: Verdict | None = None
        self._answers: deque[tuple[asyncio.Future[Any], MethodCall]] = deque()
        self._beside: set[asyncio.Task[None]] = set()
        self._following: asyncio.Task[Any] | None = None

    def send(self, message: object) -> None:
        """Send a message to the process."""
        if self._lane is not None:
            self._lane.wire.send(message)

    def abort(self, verdict: Verdict) -> None:
        """Request the end; the first verdict counts."""
        self._stop_verdict = self._stop_verdict or verdict
        self.send(Abort(verdict))

    async def run(self) -> Any:
        """Follow it to its end; see `Operating.run`."""
        following = self._follow()
        try:
            return await asyncio.shield(following)
        except asyncio.CancelledError:
            self.abort(CANCELLED)
            if self._order.work.kind is Kind.GAINS:  # the result of a write of gains counts
                return await self._gains(following)
            await uncancelled(following)
            raise

    async def _gains(self, following: asyncio.Task[Any]) -> Any:
        try:
            value = await to_its_end(following)
        except ShuttingDownError:
            raise asyncio.CancelledError from None
        if (caller := asyncio.current_task()) is not None:
            caller.uncancel()
        return value

    async def ask(self, name: str, *values: object) -> Any:
        """Send a request and return its answer; a cancelled caller ends the operation, and waits for the answer."""
        following, answer = self._follow(), asyncio.get_running_loop().create_future()
        self._answers.append((answer, MethodCall(name, values)))
        if self._lane is not None:
            self.send(MethodCall(name, values))
        either = asyncio.ensure_future(asyncio.wait((answer, following), return_when=asyncio.FIRST_COMPLETED))
        try:
            await asyncio.shield(either)
        except asyncio.CancelledError:
            self.abort(CANCELLED)
            await uncancelled(either)
            raise
        if answer.done():
            return answer.result()
        await following
        raise LinkError("the operation has ended", remedy="Start it again.")

    def _follow(self) -> asyncio.Task[Any]:
        if self._following is None:
            self._following = asyncio.create_task(self._conduct(), name=f"operation-{self._order.loop}")
        return self._following

    async def _conduct(self) -> Any:
        files = self._journal.lock.files if self._journal is not None else ()
        try:
            lane = self._lane = await self._processes.lane(self._order, files, self._process_name)
        except OSError as error:
            self._is_over(None)
            raise NoProcessError(
                f"no process could be started for the loop: {error}", remedy="Check the machine's memory."
            ) from error
        if self._stop_verdict is not None:
            self.send(Abort(self._stop_verdict))
        for _, call in self._answers:
            self.send(call)
        self._beside |= {asyncio.create_task(work) for work in (self._stay(), self._pass_on())}
        try:
            done = await self._followed(lane.wire)
        finally:
            for task in self._beside:
                task.cancel()
            await asyncio.gather(*self._beside, return_exceptions=True)
        how = await lane.end(at_once=done is None)
        self._is_over(done and done.journal_trouble)
        if done is None:
            _log.error("the process of loop %s was lost (%s); its output is being restored", self._order.loop, how)
            raise ProcessLostError(self._order.loop, how)
        if done.error is not None:
            raise done.error
        return done.value

    def _is_over(self, trouble: str | None) -> None:
        """Take the record back from a process that is gone."""
        if self._journal is not None:
            self._journal.taken_back(trouble)

    async def _stay(self) -> None:
        """Send the process a sign of life."""
        while True:
            self.send(Alive())
            await asyncio.sleep(min(ALIVE_S, self._order.table.front_timeout_s / 4.0))

    async def _pass_on(self) -> None:
        """Report to the process that a silent device is not waited for any more."""
        await forced_shutdown().wait()
        self.send(WaitNoMore())

    async def _followed(self, wire: Wire) -> Done | None:
        """Process the messages up to `Done`; return None when the process is lost first."""
        patience_s = STARTED_S
        while True:
            message = await _within(patience_s, wire)
            match message:
                case Published():
                    self._publish(message.what)
                case Logged():
                    logging.getLogger(message.logger).log(message.level, "loop %s: %s", self._order.loop, message.text)
                case Compute():
                    task = asyncio.create_task(self._compute(message))
                    self._beside.add(task)
                    task.add_done_callback(self._beside.discard)
                case Answered():
                    self._take(message)
                case Done() | None:
                    return message
            patience_s = LOST_S

    def _take(self, answered: Answered) -> None:
        answer, _ = self._answers.popleft()
        if answered.error is not None:
            answer.set_exception(answered.error)
        else:
            answer.set_result(answered.value)

    async def _compute(self, call: Compute) -> None:
        try:
            self.send(Answered(call.number, await self._arithmetic.run(call.work)))
        except Exception as error:  # noqa: BLE001 - raised again over there
            self.send(Answered(call.number, None, error))


async def _within(patience_s: float, wire: Wire) -> object | None:
    """Return the next message; None at the end of the connection."""
    for limit_s in (patience_s, GRACE_S):
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(limit_s):
                return await wire.receive()
    return None


def ignore(_message: object) -> None:
    """Discard a message."""


@dataclass(slots=True)
class Operations:
    """Has operations done on one loop.

    Attributes
    ----------
    name : str
        The loop's name.
    loop : LoopTable
        The loop.
    backend : Backend
        Its device.
    ledger : GainsLedger
        Keeps the old gains.
    processes : LoopProcesses or None
        Has them done in a loop process; None where they are done in place.
    own : bool
        Whether the loop runs in its own process.
    """

    name: str
    loop: LoopTable
    backend: Backend
    ledger: GainsLedger
    processes: LoopProcesses | None = None
    own: bool = False

    def begin(
        self,
        work: Work,
        journal: OpenJournal | None = None,
        publish: Callable[[Any], None] = ignore,
        pool: ComputePool | None = None,
    ) -> Operating:
        """Begin an operation; a simulated device lives here between experiments, and so do short operations on it."""
        pool = pool or InPlace()
        if self.processes is None or is_simulated(self.backend):
            station = Station(self.name, self.loop, self.backend, self.ledger, pool, publish, journal)
            return Here(work.begin(station))
        return self.remote(work, self.processes, journal, publish, pool)

    def remote(
        self,
        work: Work,
        processes: LoopProcesses,
        journal: OpenJournal | None,
        publish: Callable[[Any], None],
        pool: ComputePool,
    ) -> Remote:
        """Return an operation in the loop process."""
        handed = journal.handed() if journal is not None else None
        order = Order(self.name, self.loop, work, self._carried(), handed)
        return Remote(order, processes, pool, publish, journal, process_name=self._process_name())

    @property
    def stays(self) -> bool:
        """Whether the device can be driven in this process only: it lives in its memory, and another loop shares it."""
        return is_simulated(self.backend) and self._carried() is None

    def _carried(self) -> object | None:
        return self.backend.carried() if isinstance(self.backend, Carried) else None

    def _process_name(self) -> str:
        if self.own:
            return f"own-{self.name}"
        return SIMULATED if is_simulated(self.backend) else HARDWARE
