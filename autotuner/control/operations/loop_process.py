"""The loop process: the only process that drives hardware, with one event loop and nothing else on it.

    a byte with files -> wire -> Order -> operation -> Published, .. -> Done

No other work contends for its interpreter's lock: requests, log, database and computations are in other processes.
Each operation has its own wire; its socket, and the files of its lock, are passed over the socket of the process.

Invariants:

1. An operation is the same as in place; this process only receives orders and sends reports.
2. An operation whose front is gone, or is stopped for longer than `front_timeout_s`, continues only to release its
   loop, and leaves its record for the next start to report. The process ends after its last operation. The front
   handles Ctrl-C, which reaches the whole process group.
3. A heartbeat is sent every `BEAT_S`, with or without news.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import socket
import threading
from contextvars import ContextVar
from dataclasses import dataclass
from functools import partial
from itertools import count
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

from autotuner.control.clock.real_time import PERIOD_S, Upkeep, claim, fine_timers
from autotuner.control.devices.plugins import make_backend
from autotuner.control.forced_shutdown import wait_no_more
from autotuner.control.operations.crash_recovery import RESTORED
from autotuner.control.operations.experiment_operation import Conducting
from autotuner.control.operations.messages import (
    ALONE,
    Abort,
    Alive,
    Answered,
    Compute,
    Done,
    Inform,
    Logged,
    MethodCall,
    Order,
    Published,
    WaitNoMore,
    wire_over,
)
from autotuner.control.operations.operation import Answering, Station
from autotuner.control.records.gains_ledger import GainsLedger
from autotuner.control.records.lease_record import DamagedRecordError, read_record
from autotuner.control.reporting.line_writer import LineWriter
from autotuner.core.verdict import aborted
from autotuner.errors import AutotunerError, ComputationError
from autotuner.ports import Carried

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.control.operations.messages import Wire
    from autotuner.control.operations.operation import Operation
    from autotuner.control.records.open_journal import OpenJournal
    from autotuner.ports import Backend

BEAT_S = 1.0
"""Longest time without a message, s."""
MOST_FILES = 3
"""Files passed with a byte: a wire, and the files of a lock."""
FRONT_GRACE_S = 0.5
"""Grace period after `front_timeout_s` in which pending messages are still read, s."""
STOPPED = aborted("shutdown", "the process of this loop was requested to end", "Start the tuning again.")

_log = logging.getLogger(__name__)
_wire_here: ContextVar[Wire | None] = ContextVar("wire", default=None)

P = ParamSpec("P")
R = TypeVar("R")


class FrontPool:
    """The compute pool of the front; see `autotuner.control.compute_port.ComputePool`."""

    def __init__(self, send: Callable[[object], None]) -> None:
        self._send, self._numbers = send, count()
        self._awaited: dict[int, asyncio.Future[Any]] = {}

    async def run(self, function: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> R:
        """Return the function's value, or raise its exception."""
        number = next(self._numbers)
        answer = self._awaited[number] = asyncio.get_running_loop().create_future()
        self._send(Compute(number, partial(function, *args, **kwargs)))
        try:
            value: R = await answer
        finally:
            del self._awaited[number]
        return value

    async def aside(self, function: Callable[[], R]) -> R:
        """Call the function in a thread."""
        return await asyncio.to_thread(function)

    def take(self, answered: Answered) -> None:
        """Take an answer of the front."""
        answer = self._awaited.get(answered.number)
        if answer is None or answer.done():
            return
        if answered.error is not None:
            answer.set_exception(answered.error)
        else:
            answer.set_result(answered.value)

    def interrupt(self) -> None:
        """End all waiting: the front is gone."""
        for answer in self._awaited.values():
            if not answer.done():
                answer.set_exception(ComputationError("the front is gone", remedy="Start it again."))

    def close(self) -> None:
        """Do nothing: the workers are the front's."""


@dataclass(slots=True)
class Served:
    """A running operation, with its station."""

    operation: Operation
    station: Station
    pool: FrontPool

    def lose_front(self) -> None:
        """Have the loop released without a front."""
        self.station.alone = True
        self.pool.interrupt()
        self.operation.abort(ALONE)


async def serve(
    order: Order,
    backend: Backend,
    wire: Wire,
    journal: OpenJournal | None,
    begun: Callable[[Served], None] = lambda _: None,
) -> Station:
    """Carry out an order to its end, and report to the front."""
    pool = FrontPool(wire.send)
    ledger = GainsLedger(None if journal is None else journal.store, order.loop)
    station = Station(order.loop, order.table, backend, ledger, pool, lambda what: wire.send(Published(what)), journal)
    operation = order.work.begin(station)
    served = Served(operation, station, pool)
    begun(served)
    beside = [asyncio.create_task(work) for work in (_obey(served, wire), _beat(operation, wire))]
    done = Done(None, ComputationError("the operation broke off", remedy="Check the log."))
    try:
        done = Done(await operation.run())
    except AutotunerError as error:
        done = Done(None, error)
    finally:
        for task in beside:
            task.cancel()
        await asyncio.gather(*beside, return_exceptions=True)
        if journal is not None:
            await journal.end(None)  # the front reports its end, unless the operation has done so
        wire.send(done._replace(journal_trouble=journal.trouble if journal else None))
    return station


async def _obey(served: Served, wire: Wire) -> None:
    """Execute the front's requests; release the loop when the front is gone or stopped."""
    answers = set[asyncio.Task[None]]()
    try:
        while (message := await _heard(wire, served.station.loop.front_timeout_s)) is not None:
            _obey_one(served, message, wire, answers)
        served.lose_front()
        await asyncio.gather(*answers)
    finally:
        for task in answers:
            task.cancel()
        await asyncio.gather(*answers, return_exceptions=True)


def _obey_one(served: Served, message: object, wire: Wire, answers: set[asyncio.Task[None]]) -> None:
    operation = served.operation
    match message:
        case Abort():
            operation.abort(message.verdict)
        case WaitNoMore():
            wait_no_more()
        case Inform() if isinstance(operation, Conducting):
            operation.inform(message)
        case Answered():
            served.pool.take(message)
        case MethodCall() if isinstance(operation, Answering):
            task = asyncio.create_task(_answer(operation, message, wire))
            answers.add(task)
            task.add_done_callback(answers.discard)


async def _answer(operation: Answering, message: MethodCall, wire: Wire) -> None:
    try:
        wire.send(Answered(0, await operation.ask(message.name, *message.values)))
    except AutotunerError as error:
        wire.send(Answered(0, None, error))
    except Exception as error:  # noqa: BLE001 - the front decides, the log has the trace
        _log.exception("the operation failed")
        wire.send(Answered(0, None, ComputationError(f"{type(error).__name__}: {error}", remedy="See the log.")))


async def _heard(wire: Wire, limit_s: float) -> object | None:
    """Return the next message; None when the front is gone, or silent for longer than the limit.

    After the limit there is a grace period: a stopped loop process first reads pending messages.
    """
    for wait_s in (limit_s, FRONT_GRACE_S):
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(wait_s):
                return await wire.receive()
    return None


async def _beat(operation: Operation, wire: Wire) -> None:
    while True:
        if isinstance(operation, Conducting):
            operation.flush()
        else:
            wire.send(Alive())
        await asyncio.sleep(BEAT_S)


def live(end: socket.socket, priority: int) -> None:
    """Be the process, at one end of a pair of sockets; `priority` is in the real-time class, 0 for the usual one."""
    for name in ("SIGINT", "SIGTSTP"):  # they reach all processes of a terminal: the front passes them on to this one
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    upkeep = Upkeep(awake=claim(priority))
    with asyncio.Runner() as runner:
        runner.run(_Host(end, upkeep).live())


class _Host:
    """The operations of the process."""

    def __init__(self, end: socket.socket, upkeep: Upkeep) -> None:
        self._end, self._upkeep = end, upkeep
        self._arrived: asyncio.Queue[list[int] | None] = asyncio.Queue()
        self._served: dict[asyncio.Task[None], Served | None] = {}
        self._end_requests = 0

    async def live(self) -> None:
        """Serve until the front is gone or the end is requested, and no operation is running."""
        with fine_timers():
            await self._live()

    async def _live(self) -> None:
        loop, records = asyncio.get_running_loop(), SimpleQueue[logging.LogRecord]()
        taker, writer = _Taker(loop, records), LineWriter(records, logging.Formatter())
        writer.start()
        self._end.settimeout(0.0)
        loop.add_reader(self._end, self._take)
        loop.add_signal_handler(signal.SIGTERM, self._stop)
        logging.getLogger().addHandler(taker)
        logging.getLogger().setLevel(logging.INFO)
        care = asyncio.create_task(self._take_care())
        while (files := await self._arrived.get()) is not None:
            task = asyncio.create_task(self._serve(files))
            self._served[task] = None
            task.add_done_callback(self._forget)
        loop.remove_reader(self._end)
        while self._served:
            await asyncio.wait(self._served)
        care.cancel()
        await asyncio.gather(care, return_exceptions=True)
        logging.getLogger().removeHandler(taker)
        writer.stop()

    def _take(self) -> None:
        try:
            data, files, _, _ = socket.recv_fds(self._end, 1, MOST_FILES)
        except BlockingIOError:
            return
        except OSError:
            data, files = b"", []
        self._arrived.put_nowait(files if data else None)
        if not data:
            asyncio.get_running_loop().remove_reader(self._end)

    def _stop(self) -> None:
        """Have all loops released, then end; on a second request, wait for no silent device."""
        if self._end_requests:
            wait_no_more()
        self._end_requests += 1
        for served in filter(None, self._served.values()):
            served.operation.abort(STOPPED)
        if self._end_requests == 1:
            self._arrived.put_nowait(None)

    def _forget(self, task: asyncio.Task[None]) -> None:
        del self._served[task]
        if not task.cancelled() and (error := task.exception()) is not None:
            _log.error("an operation failed", exc_info=error)

    async def _take_care(self) -> None:
        while True:
            self._upkeep.look(busy=bool(self._served))
            await asyncio.sleep(PERIOD_S)

    async def _serve(self, files: list[int]) -> None:
        wire = await wire_over(socket.socket(fileno=files[0]))
        _wire_here.set(wire)
        try:
            order = await wire.receive()
            if isinstance(order, Order):
                await self._do(order, wire, files[1:])
        except Exception as error:  # noqa: BLE001 - the front decides; the log has the trace
            _log.exception("an operation failed")
            wire.send(Done(None, ComputationError(f"{type(error).__name__}: {error}", remedy="See the log.")))
        finally:
            await wire.close()

    async def _do(self, order: Order, wire: Wire, files: list[int]) -> None:
        try:
            backend = make_backend(order.table.driver, order.table.device, f"loops.{order.loop}")
            if isinstance(backend, Carried):
                backend.take_over(order.carried)
            journal = order.journal.taken(*files) if order.journal is not None else None
        except BaseException:
            for file in files:
                os.close(file)
            raise
        this = asyncio.current_task()
        assert this is not None  # noqa: S101 - this runs in it

        def begun(served: Served) -> None:
            served.station.others = lambda: self._others(order.loop, this)
            self._served[this] = served
            if self._end_requests:
                served.operation.abort(STOPPED)

        station = await serve(order, backend, wire, journal, begun)
        if station.alone:
            _wire_here.set(None)  # the log has no other reader than standard error any more
            _report_end(order)

    async def _others(self, loop: str, this: asyncio.Task[None]) -> None:
        """Wait until nothing else is done with a loop."""
        while others := [t for t, one in self._served.items() if one and one.station.name == loop and t is not this]:
            await asyncio.wait(others)


def _report_end(order: Order) -> None:
    """Log how the loop of a lost front was released."""
    if order.journal is None:
        return
    with contextlib.suppress(OSError, DamagedRecordError):
        kept = read_record(order.journal.store(), order.journal.name)
        if kept.restored and kept.verdict is None:
            what = kept.released or RESTORED
            _log.warning("%s of loop %s: %s; %s", kept.kind, order.loop, kept.why, what)


class _Taker(logging.Handler):
    """Gives lines of the log to the front of the operation that they are of, from any thread; others are written here.

    Parameters
    ----------
    loop : AbstractEventLoop
        That of the process.
    records : SimpleQueue
        What is written here.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, records: SimpleQueue[logging.LogRecord]) -> None:
        super().__init__()
        self._loop, self._records = loop, records

    def emit(self, record: logging.LogRecord) -> None:
        if (wire := _wire_here.get()) is None:
            self._records.put(record)
            return
        logged = Logged(record.name, record.levelno, self.format(record))
        if threading.current_thread() is threading.main_thread():
            wire.send(logged)
        else:
            with contextlib.suppress(RuntimeError):  # the event loop has ended
                self._loop.call_soon_threadsafe(wire.send, logged)
