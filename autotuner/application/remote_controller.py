"""An experiment in a process of its own, seen from the service.

    Order -> process -> Report, Report, .. -> Closing
             lost, or silent for LOST_S + GRACE_S -> killed -> the loop is given back from here

Rules of this file:

1. What the process tells is told on at once, in its order: whoever looks at a tuning sees no difference.
2. A process that ends without saying how the loop stands, or says nothing for so long, is ended for good; then the
   loop is given back from here, by what its journal tells, or where there is none, by what was seen of it.
3. It cannot be cancelled before the loop is given back.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from autotuner.control.crash_recovery import CrashRecovery
from autotuner.control.events import PhaseChanged, SampleTaken
from autotuner.control.forced_shutdown import wait_no_more
from autotuner.control.lease_record import DamagedRecordError, Kept, read_record
from autotuner.control.messages import Abort, Alive, Closing, Inform, Logged, Order, Report, WaitNoMore
from autotuner.control.retrying import uncancelled
from autotuner.core.experiment.phases import Phase
from autotuner.core.recording import Sample
from autotuner.core.verdict import aborted, failed
from autotuner.ports import Carried

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from autotuner.application.loop_process_start import LoopProcess
    from autotuner.application.tuning_run import Tuning
    from autotuner.configuration import LoopTable
    from autotuner.control.events import Event
    from autotuner.control.lease_record import Before
    from autotuner.control.messages import Seen, Wire
    from autotuner.core.verdict import Verdict
    from autotuner.ports import Backend

    Begin = Callable[[Order, Tuning], Coroutine[object, object, LoopProcess]]

STARTED_S = 60.0
"""Longest time to the first message of a process, s."""
ALIVE_S = 1.0
"""Longest time between two messages to a process, s."""
LOST_S = 4.0
"""Longest time without a message, s; it sends one every second."""
GRACE_S = 1.0
"""Time after that, s: when the machine has slept, that is over before what has come can be read."""
AGAIN = "Start the tuning again; if it happens again, look at the log."

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class SeenExperiment:
    """What was told last of the experiment; see `autotuner.control.controller_port.Conducted`."""

    seen: Seen
    tell: Callable[[object], None]

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was noticed and did not end it."""
        return self.seen.warnings

    def inform(self, model_error: float) -> None:
        """Tell the process how sure a model is."""
        self.tell(Inform(model_error))

    def settings_seen(self) -> dict[str, object]:
        """Return what the recording should carry beside the samples, JSON-ready."""
        return dict(self.seen.settings)


class RemoteController:
    """Conducts one experiment in a loop process; see `autotuner.control.controller_port.Conductor`.

    Parameters
    ----------
    tuning : Tuning
        Whose experiment it is.
    loop : LoopTable
        Its loop.
    backend : Backend
        The device as this process knows it: closed, and not used unless the other process is lost.
    order : Order
        What the process is to do.
    begin : callable
        Starts a process.
    """

    def __init__(self, tuning: Tuning, loop: LoopTable, backend: Backend, order: Order, begin: Begin) -> None:
        self.samples: list[Sample] = []
        self.experiment: SeenExperiment | None = None
        self.before: Before | None = None
        self.restored: bool | None = None
        self.elsewhere = True
        self._tuning, self._loop, self._backend = tuning, loop, backend
        self._order, self._begin = order, begin
        self._process: LoopProcess | None = None
        self._stop_verdict: Verdict | None = None
        self._heard_s = 0.0

    def abort(self, verdict: Verdict) -> None:
        """Ask for the end; the output is restored at once, the first verdict stands."""
        self._stop_verdict = self._stop_verdict or verdict
        self._tell(Abort(verdict))

    def wait_no_more(self) -> None:
        """End the waiting for a device that does not answer while the output is given back."""
        wait_no_more()
        self._tell(WaitNoMore())

    async def run(self) -> Verdict | None:
        """Conduct the experiment to its end; see `autotuner.control.controller.Controller.run`."""
        conduct = asyncio.ensure_future(self._conduct())
        try:
            return await asyncio.shield(conduct)
        except asyncio.CancelledError:
            self.abort(aborted("cancelled", "the tuning was cancelled", "Start it again when wanted."))
            await uncancelled(conduct)
            raise

    async def _conduct(self) -> Verdict | None:
        try:
            process = self._process = await self._begin(self._order, self._tuning)
        except OSError as error:
            self._is_over(None)
            return failed("no_process", f"no process could be started for the loop: {error}", AGAIN)
        if self._stop_verdict is not None:
            self._tell(Abort(self._stop_verdict))
        alive = asyncio.create_task(self._stay(), name="front-alive")
        try:
            closing = await self._followed(process)
        finally:
            alive.cancel()
            await asyncio.gather(alive, return_exceptions=True)
        how = await process.end(at_once=closing is None)
        self._is_over(closing and closing.journal_trouble)
        if closing is None:
            return await self._made_good(how)
        if isinstance(self._backend, Carried):
            self._backend.take_over(closing.carried)
        self.restored = closing.restored
        return closing.verdict

    async def _stay(self) -> None:
        """Tell the process that the front is there."""
        while True:
            self._tell(Alive())
            await asyncio.sleep(min(ALIVE_S, self._order.front_timeout_s / 4.0))

    async def _followed(self, process: LoopProcess) -> Closing | None:
        """Take what the process tells, until it says that it has ended; None when it will not say that any more."""
        patience_s = STARTED_S
        while True:
            message = await _within(patience_s, process.wire)
            match message:
                case Report():
                    self._take(message)
                case Logged():
                    logging.getLogger(message.logger).log(message.level, "loop %s: %s", self._order.loop, message.text)
                case Closing() | None:
                    return message
            patience_s = LOST_S

    def _take(self, report: Report) -> None:
        self._heard_s = asyncio.get_running_loop().time()
        self.before = report.before
        if report.seen is not None:
            self.experiment = SeenExperiment(report.seen, self._tell)
        for told in report.events:
            if isinstance(told, tuple):
                self.samples.append(Sample(*told))
            self._tuning.publish(SampleTaken(*told) if isinstance(told, tuple) else told)
        for place, numbers in report.corrected:
            self.samples[place] = Sample(*numbers)

    def _is_over(self, trouble: str | None) -> None:
        """Take deadlines and journal back from a process that is gone."""
        self.elsewhere = False
        if self._tuning.journal is not None:
            self._tuning.journal.taken_back(trouble)

    def _tell(self, message: object) -> None:
        if self._process is not None:
            self._process.wire.send(message)

    async def _made_good(self, how: str) -> Verdict:
        """Give back the loop of a process that is lost, and return what there is to say."""
        _log.error("the process of loop %s was lost (%s); its output is being restored", self._order.loop, how)
        limit_s = self._loop.restore_limit_s
        self._publish_now(PhaseChanged(0.0, Phase.RESTORE))
        back = await CrashRecovery(await self._known(), self._loop, self._backend, self._publish_now, limit_s).go()
        self.restored = back.done
        if back.done:
            self._publish_now(PhaseChanged(0.0, Phase.ENDED))
        return failed("process_lost", f"the process that drove the loop was lost ({how}); {back.what}", AGAIN)

    def _publish_now(self, event: Event) -> None:
        """Publish an event of here, at the time since the start of the process."""
        silent_s = asyncio.get_running_loop().time() - self._heard_s
        self._tuning.publish(replace(event, t=self.samples[-1].t + silent_s if self.samples else 0.0))

    async def _known(self) -> Kept:
        """Return what is known of how the loop stands."""
        tuning = self._tuning
        if tuning.journal is not None:
            with contextlib.suppress(OSError, DamagedRecordError):
                return await asyncio.to_thread(read_record, tuning.journal.store, tuning.journal.name)
        kept = Kept(tuning.id, tuning.id, tuning.loop, "", tuning.started_at, {}, before=self.before)
        kept.commanded, kept.wide = {sample.output for sample in self.samples}, True
        if self.before is not None:
            kept.take({"target": self.before.output})
        return kept


async def _within(patience_s: float, wire: Wire) -> object | None:
    """Return the next message; None when there is none any more."""
    for limit_s in (patience_s, GRACE_S):
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(limit_s):
                return await wire.receive()
    return None


def remote_controller(
    tuning: Tuning, loop: LoopTable, backend: Backend, *, priority: int, begin: Begin
) -> RemoteController:
    """Return what conducts the experiment of a tuning in a process of its own.

    `priority` is that of the process in the real-time class, 0 for the usual class.
    """
    settings = tuning.request.settings
    order = Order(
        loop=tuning.loop,
        driver=loop.driver,
        device=loop.device,
        carried=backend.carried() if isinstance(backend, Carried) else None,
        settings=settings,
        safety=loop.safety_settings(settings.time_limit_s),
        restore_limit_s=loop.restore_limit_s,
        scan_s=loop.device_scan_s,
        front_timeout_s=loop.front_timeout_s,
        priority=priority,
    )
    return RemoteController(tuning, loop, backend, order, begin)
