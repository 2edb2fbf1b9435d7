"""Signals that end a command: the first requests its end, the second ends the wait for a device that does not answer.

Ctrl-Z ends it too: the loop is released first, then the command suspends itself.

Invariant: work on a device that a signal interrupts is completed; nothing is begun after it.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from typing import TYPE_CHECKING, TypeVar

from autotuner.errors import AutotunerError
from autotuner.stopped_by import stopped_by, suspended_by

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

T = TypeVar("T")


class StoppedError(AutotunerError):
    """A command was stopped before it did anything."""


async def stoppable(work: Coroutine[object, object, T], end: Callable[[signal.Signals], None]) -> T:
    """Await `work`; the first signal, also that of a closed terminal, calls `end`, and the next one ends all waiting.

    After Ctrl-Z the process suspends itself once the work has ended.
    """
    requested = suspend = False

    def ask(number: signal.Signals) -> None:
        from autotuner.control.forced_shutdown import wait_no_more  # noqa: PLC0415 - keeps `--help` quick

        nonlocal requested, suspend
        suspend = suspend or number in suspended_by()
        if requested:
            wait_no_more()
        requested = True
        end(number)

    for number in (*stopped_by(), *suspended_by()):
        with contextlib.suppress(NotImplementedError, RuntimeError):  # virtual time and Windows have no signal handlers
            asyncio.get_running_loop().add_signal_handler(number, ask, number)
    try:
        return await work
    finally:
        if suspend:
            os.kill(os.getpid(), signal.SIGSTOP)


class Stop:
    """Takes the request to end a command: its work is cancelled wherever that is allowed."""

    def __init__(self) -> None:
        self._requested: signal.Signals | None = None
        self._task: asyncio.Task[object] | None = None

    def check(self) -> None:
        """Raise `StoppedError` when the end was requested."""
        if self._requested is not None:
            raise StoppedError(
                f"stopped by {self._requested.name} before anything was written", remedy="Start it again when wanted."
            )

    async def over(self, work: Coroutine[object, object, T]) -> T:
        """Do `work`; raise `StoppedError` when a signal has cancelled it."""
        self._task = asyncio.current_task()
        try:
            return await stoppable(work, self._ask)
        except asyncio.CancelledError:
            self.check()
            raise

    def _ask(self, number: signal.Signals) -> None:
        self._requested = self._requested or number
        if self._task is not None:
            self._task.cancel()
