"""Starting and ending a process that drives one loop.

Rules of this file: starting one takes milliseconds, so no event loop waits for that; whoever has ended one knows that
it is gone, and with it all that it had open.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import signal
import socket
from typing import TYPE_CHECKING, Protocol

from autotuner.application import compute_pool as arithmetic  # noqa: F401 - teaches pickle the frozen values of an order
from autotuner.control.messages import wire_over

if TYPE_CHECKING:
    from multiprocessing.context import SpawnProcess

    from autotuner.application.tuning_run import Tuning
    from autotuner.control.messages import Order, Wire

LEAVING_S = 10.0
"""Longest time from the last message of a process to its end, s."""


class LoopProcess(Protocol):
    """A process that drives a loop, and the wire to it."""

    @property
    def wire(self) -> Wire:
        """To it."""

    async def end(self, *, at_once: bool) -> str:
        """Wait until it has ended, killed where it must be `at_once`; return how."""


class SpawnedLoopProcess:
    """A process of the operating system."""

    def __init__(self, process: SpawnProcess, wire: Wire) -> None:
        self.wire = wire
        self._process = process

    async def end(self, *, at_once: bool) -> str:
        """Wait until it has ended, killed where it must be `at_once` or does not end by itself; return how."""
        if at_once:
            self._process.kill()
        await asyncio.to_thread(self._leave)
        await self.wire.close()
        code = self._process.exitcode or 0
        self._process.close()
        return signal.Signals(-code).name if code < 0 else f"exit code {code}"

    def _leave(self) -> None:
        self._process.join(LEAVING_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


async def begin(order: Order, tuning: Tuning) -> SpawnedLoopProcess:
    """Start a process for an order; raise `OSError` where the system has no room for one."""
    from autotuner.control.loop_process import live  # noqa: PLC0415 - what it imports is needed over there

    ours, theirs = socket.socketpair()
    try:
        handed = tuning.journal.handed() if tuning.journal is not None else None
        context = multiprocessing.get_context("spawn")
        process = context.Process(target=live, args=(order, theirs, handed), name=f"loop-{order.loop}")
        await asyncio.to_thread(process.start)
    except BaseException:
        ours.close()
        raise
    finally:
        theirs.close()
    return SpawnedLoopProcess(process, await wire_over(ours))
