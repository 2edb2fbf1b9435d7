"""The floor: where the loops run, and how others have something done there.

    await floor.do(lambda: manager.start(..))      a function, one step on the floor
    await floor.run(lambda: manager.visit(..))     a coroutine, beside the loops

Rules of this file:

1. What touches a device, starts or ends something is done on the floor. What has been recorded is only ever added to or
   replaced as a whole, so anybody reads it where he is: reading costs the loops nothing.
2. `OwnThread` has an event loop of its own: no sample waits for requests, their rendering or the log. `Here` is the
   caller's event loop: for virtual time, which has no threads.
3. Errors arrive with their type, a caller that gives up ends what it asked for, none waits for a floor that is gone.
4. A fault that breaks the thread down gives the loops back first; then the thread ends, and `fault` tells.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
from functools import partial
from typing import TYPE_CHECKING, Protocol, TypeVar

from autotuner.control.clock.event_loop import fine_event_loop
from autotuner.control.clock.real_time import claim
from autotuner.control.clock.turns import Turns
from autotuner.errors import ShuttingDownError

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine
    from concurrent.futures import Future

    Rescue = Callable[[], Coroutine[object, object, object]]

T = TypeVar("T")

_log = logging.getLogger(__name__)


class Floor(Protocol):
    """Where the loops run."""

    def open(self, rescue: Rescue) -> None:
        """Begin; `rescue` gives the loops back when the floor breaks down."""

    async def do(self, work: Callable[[], T]) -> T:
        """Return what the function returns, called on the floor; raise what it raises, or `ShuttingDownError`."""

    async def run(self, work: Callable[[], Coroutine[object, object, T]]) -> T:
        """Return what the coroutine returns, run on the floor; raise what it raises, or `ShuttingDownError`."""

    async def close(self) -> None:
        """End the floor; may be repeated."""


class Here:
    """The caller's own event loop."""

    def open(self, rescue: Rescue) -> None:
        """Do nothing: the caller's event loop runs already."""

    async def do(self, work: Callable[[], T]) -> T:
        """Call the function."""
        return work()

    async def run(self, work: Callable[[], Coroutine[object, object, T]]) -> T:
        """Await the coroutine."""
        return await work()

    async def close(self) -> None:
        """Do nothing: the event loop is the caller's."""


class OwnThread:
    """A thread with its own event loop.

    Parameters
    ----------
    priority : int
        In the real-time class of the system's scheduler; 0 for the usual class.

    Attributes
    ----------
    fault : BaseException or None
        What broke it down, once the loops were given back.
    turns : Turns
        When it wants the interpreter's lock.
    """

    def __init__(self, priority: int = 0) -> None:
        self.fault: BaseException | None = None
        self.turns = Turns()
        self._priority = priority
        self._loop: asyncio.AbstractEventLoop | None = None
        self._leave = asyncio.Event()
        self._begun = threading.Event()
        self._gate = threading.Lock()  # what passes it before the floor has gone is begun, and so is ended
        self._gone = False
        self._thread: threading.Thread | None = None

    def open(self, rescue: Rescue) -> None:
        """Start the thread, and return when its event loop runs."""
        self._thread = threading.Thread(target=self._live, args=(rescue,), name="loops")
        self._thread.start()
        self._begun.wait()

    async def do(self, work: Callable[[], T]) -> T:
        """Call the function in the thread."""

        async def step() -> T:
            return work()

        return await self.run(step)

    async def run(self, work: Callable[[], Coroutine[object, object, T]]) -> T:
        """Run the coroutine in the thread."""
        try:
            return await asyncio.wrap_future(self._hand_over(work))
        except asyncio.CancelledError:
            caller = asyncio.current_task()
            if caller is not None and caller.cancelling():
                raise
            raise ShuttingDownError from None
        except (SystemExit, KeyboardInterrupt) as error:  # it has broken the floor down, and shall not the caller
            raise ShuttingDownError from error

    def _hand_over(self, work: Callable[[], Coroutine[object, object, T]]) -> Future[T]:
        async def begin() -> T:  # the coroutine is made where it is run
            return await work()

        with self._gate:
            if self._loop is None or self._gone:
                raise ShuttingDownError
            return asyncio.run_coroutine_threadsafe(begin(), self._loop)

    async def close(self) -> None:
        """End the thread, while the caller's event loop goes on."""
        await asyncio.to_thread(self.end)

    def end(self) -> None:
        """End the thread and wait for it; what still runs there is cancelled. May be repeated."""
        self._shut()
        if self._thread is None or self._loop is None:
            return
        with contextlib.suppress(RuntimeError):  # it has ended
            self._loop.call_soon_threadsafe(self._leave.set)
        self._thread.join()

    def _shut(self) -> None:
        with self._gate:
            self._gone = True

    def _live(self, rescue: Rescue) -> None:
        claim(self._priority)
        try:
            with asyncio.Runner(loop_factory=partial(fine_event_loop, self.turns)) as runner:
                try:
                    self._stay_or_rescue(runner, rescue)
                finally:
                    runner.run(_end_all())
        finally:
            self._shut()
            self._begun.set()

    def _stay_or_rescue(self, runner: asyncio.Runner, rescue: Rescue) -> None:
        try:
            runner.run(self._stay())
        except BaseException as error:  # noqa: BLE001 - whatever it was, the loops must be given back
            self._shut()
            _log.critical("the thread of the loops broke down; their outputs are being restored", exc_info=error)
            try:
                runner.run(rescue())
            finally:
                self.fault = error

    async def _stay(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._begun.set()
        await self._leave.wait()


async def _end_all() -> None:
    """End what still runs in this event loop."""
    others = asyncio.all_tasks() - {asyncio.current_task()}
    for task in others:
        task.cancel()
    await asyncio.gather(*others, return_exceptions=True)
