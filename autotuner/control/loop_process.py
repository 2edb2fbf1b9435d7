"""A process that drives one loop: an event loop with nothing else on it.

    Order -> backend, controller -> Report, Report, .. -> Closing

Nobody else wants its interpreter's lock: requests, the log, the database and the other loops are in the service's
process. What there is to tell gathers, and is sent right after a sample, when the next deadline is farthest.

Rules of this file:

1. The loop is driven by the same `Controller` as in a thread of the service; here it is only ordered and reported.
2. Without its owner it goes on only to give the loop back: a service that was killed, or is stopped, leaves no relay
   behind. Ctrl-C, which reaches the whole process group, is left to the owner.
3. It tells within `BEAT_S` that it is alive, whether there is news or not.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
import threading
from typing import TYPE_CHECKING

from autotuner.control.collector import PERIOD_S, Collector
from autotuner.control.controller import Controller
from autotuner.control.event_loop import fine_event_loop
from autotuner.control.events import SampleTaken
from autotuner.control.messages import Abort, Closing, Inform, Logged, Report, Seen, WaitNoMore, numbers_of, wire_over
from autotuner.control.plugins import make_backend
from autotuner.control.real_time import Lender, claim, guard
from autotuner.control.ticker import Ticker
from autotuner.core.safety.supervisor import Supervisor
from autotuner.core.verdict import aborted
from autotuner.ports import Carried

if TYPE_CHECKING:
    import socket

    from autotuner.control.events import Event
    from autotuner.control.messages import Numbers, Order, Wire
    from autotuner.control.open_journal import HandedJournal, OpenJournal
    from autotuner.core.recording import Sample
    from autotuner.ports import Backend

GATHERED_S = 0.05
"""Longest time for which samples gather, s; anything else is told at once."""
BEAT_S = 1.0
"""Longest time without a message, s."""

_log = logging.getLogger(__name__)

FRONT_GRACE_S = 0.5
"""Time after `front_timeout_s` in which a message that has come is still read, s."""
ALONE = aborted(
    "service_lost",
    "the program that had this loop tuned has gone, or was stopped for longer than front_timeout_s",
    "Start it, and the tuning, again.",
)
STOPPED = aborted("shutdown", "the process of this loop was asked to end", "Start the tuning again.")


class Reporter:
    """Tells the owner what a controller does.

    Parameters
    ----------
    wire : Wire
        To the owner.
    looks : tuple of Collector and Lender
        Looked after right behind a sample about every `PERIOD_S`.
    """

    def __init__(self, wire: Wire, looks: tuple[Collector | Lender, ...] = ()) -> None:
        self.controller: Controller | None = None
        self._wire = wire
        self._looks = looks
        self._events: list[Event | Numbers] = []
        self._outputs: list[tuple[int, float]] = []
        self._seen: Seen | None = None
        self._told_s = self._looked_s = 0.0
        self._stopped = False

    def take(self, event: Event) -> None:
        """Take an event, and tell it now or with those that follow."""
        if not isinstance(event, SampleTaken):
            self._events.append(event)
            self.tell()
            return
        self._events.append(numbers_of(event))
        self._outputs.append((len(self._samples) - 1, event.output))
        if event.t - self._told_s >= GATHERED_S:
            self._told_s = event.t
            self._send(None)
        if event.t - self._looked_s >= PERIOD_S:
            self._looked_s = event.t
            for one in self._looks:
                one.look()

    def tell(self) -> None:
        """Tell what is new, or that there is nothing."""
        self._send(self._news())

    def _send(self, seen: Seen | None) -> None:
        events, self._events = self._events, []
        before = self.controller.before if self.controller else None
        self._wire.send(Report(events, self._corrected(), before, seen))

    def _corrected(self) -> list[tuple[int, Numbers]]:
        """Return the samples that hold another output than was told, which the read-back after them has shown."""
        samples = self._samples
        corrected = [(k, numbers_of(samples[k])) for k, output in self._outputs if samples[k].output != output]
        self._outputs = self._outputs[-1:]  # that one may still be corrected
        return corrected

    @property
    def _samples(self) -> list[Sample]:
        return self.controller.samples if self.controller else []

    def stop(self) -> None:
        """Have the loop given back; asked again, wait for no device that does not answer."""
        if self.controller is not None:
            self.controller.abort(STOPPED)
            if self._stopped:
                self.controller.wait_no_more()
        self._stopped = True

    def _news(self) -> Seen | None:
        experiment = self.controller.experiment if self.controller else None
        if experiment is None:
            return None
        seen = Seen(tuple(experiment.warnings), experiment.settings_seen())
        if seen == self._seen:
            return None
        self._seen = seen
        return seen


async def drive(order: Order, backend: Backend, wire: Wire, journal: OpenJournal | None, reporter: Reporter) -> None:
    """Conduct the experiment of an order to its end, and tell the owner."""

    def publish(event: Event) -> None:
        if journal is not None:
            journal.note(event)
        reporter.take(event)

    controller = reporter.controller = Controller(
        backend,
        order.settings,
        Supervisor(order.settings.limits, order.safety),
        Ticker(order.settings.sample_time_s),
        publish,
        order.restore_limit_s,
        journal,
        order.scan_s,
    )
    beside = [asyncio.create_task(work) for work in (_obey(controller, wire, order.front_timeout_s), _beat(reporter))]
    try:
        verdict = await controller.run()
    finally:
        for task in beside:
            task.cancel()
        await asyncio.gather(*beside, return_exceptions=True)
        if journal is not None:
            await journal.end(None)  # who began it tells how the tuning ended
    reporter.tell()
    carried = backend.carried() if isinstance(backend, Carried) else None
    wire.send(Closing(verdict, controller.restored, journal.trouble if journal else None, carried))


async def _obey(controller: Controller, wire: Wire, front_timeout_s: float) -> None:
    """Do what the front requests; release the loop when there is no front, or a stopped one."""
    while (asked := await _heard(wire, front_timeout_s)) is not None:
        if isinstance(asked, Abort):
            controller.abort(asked.verdict)
        elif isinstance(asked, WaitNoMore):
            controller.wait_no_more()
        elif isinstance(asked, Inform) and controller.experiment is not None:
            controller.experiment.inform(asked.relative_error)
    controller.abort(ALONE)


async def _heard(wire: Wire, limit_s: float) -> object | None:
    """Return the next message; None when the front is gone, or silent for so long.

    After the limit there is a grace: when this process itself was stopped, what has come meanwhile is read first.
    """
    for wait_s in (limit_s, FRONT_GRACE_S):
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(wait_s):
                return await wire.receive()
    return None


async def _beat(reporter: Reporter) -> None:
    while True:
        reporter.tell()
        await asyncio.sleep(BEAT_S)


def live(order: Order, end: socket.socket, handed: HandedJournal | None) -> None:
    """Be the process: drive the loop of an order, over one end of a pair of sockets."""
    for name in ("SIGINT", "SIGTSTP"):  # they reach all processes of a terminal: this one is told by its front
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    if order.priority:
        guard()
        claim(order.priority)
    with asyncio.Runner(loop_factory=fine_event_loop) as runner:
        runner.run(_live(order, end, handed))


async def _live(order: Order, end: socket.socket, handed: HandedJournal | None) -> None:
    wire = await wire_over(end)
    loop = asyncio.get_running_loop()
    taker = _Taker(wire, loop)
    logging.getLogger().addHandler(taker)
    logging.getLogger().setLevel(logging.INFO)
    try:
        backend = make_backend(order.driver, order.device, f"loops.{order.loop}")
        if isinstance(backend, Carried):
            backend.take_over(order.carried)
        looks = Collector(lambda: True), Lender(lambda: True)
        for one in looks:  # the first look is the longest
            one.look()
        reporter = Reporter(wire, looks)
        loop.add_signal_handler(signal.SIGTERM, reporter.stop)
        await drive(order, backend, wire, None if handed is None else handed.taken(), reporter)
    except Exception:  # noqa: BLE001 - the owner gives the loop back; the log has the trace
        _log.exception("the process of the loop failed")
        raise SystemExit(1) from None
    finally:
        logging.getLogger().removeHandler(taker)
        await wire.close()


class _Taker(logging.Handler):
    """Gives lines of the log to the owner, from any thread."""

    def __init__(self, wire: Wire, loop: asyncio.AbstractEventLoop) -> None:
        super().__init__()
        self._wire, self._loop = wire, loop

    def emit(self, record: logging.LogRecord) -> None:
        told = Logged(record.name, record.levelno, self.format(record))
        if threading.current_thread() is threading.main_thread():
            self._wire.send(told)
            return
        with contextlib.suppress(RuntimeError):  # the event loop has ended
            self._loop.call_soon_threadsafe(self._wire.send, told)
