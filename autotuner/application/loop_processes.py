"""The loop processes of a front: one for all hardware loops, one for all simulated ones, own ones on request.

Invariants:

1. A process is started with the first operation that needs it, and ends with its front. One that has ended is replaced.
2. Starting one takes milliseconds, so no event loop waits for that.
3. An operation that is lost has its process killed, so that nothing it had open stays open.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import signal
import socket
import sys
import threading
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from autotuner.application.computing import compute_pool as pool  # noqa: F401 - teaches pickle the frozen values of an order
from autotuner.control.operations.messages import wire_over

if TYPE_CHECKING:
    from multiprocessing.context import SpawnProcess

    from autotuner.control.operations.messages import Order, Wire

LEAVING_S = 10.0
"""Longest time from the end of the last operation of a process to its own, s."""
HARDWARE = "hardware"
"""The process of all hardware loops that have none of their own."""
SIMULATED = "simulated"
"""The process of all simulated ones: whatever a simulated plant costs, no hardware loop waits for it."""


@dataclass(frozen=True, slots=True)
class _Process:
    """A loop process, and the socket to it."""

    process: SpawnProcess
    socket: socket.socket
    gate: threading.Lock = field(default_factory=threading.Lock)

    def end(self, *, at_once: bool) -> str:
        """Wait for the end of the process; kill it `at_once` or after the time limit; return how it ended."""
        with self.gate:  # of one that was lost all operations are
            self.socket.close()
            if at_once:
                self.process.kill()
            self.process.join(LEAVING_S)
            if self.process.is_alive():
                self.process.kill()
                self.process.join()
        code = self.process.exitcode or 0
        return signal.Signals(-code).name if code < 0 else f"exit code {code}"


@dataclass(frozen=True, slots=True)
class Lane:
    """A wire to an operation, with its process."""

    wire: Wire
    process: _Process

    async def end(self, *, at_once: bool) -> str:
        """End the wire; `at_once` ends the process too, and returns how it ended."""
        how = await asyncio.to_thread(self.process.end, at_once=True) if at_once else ""
        await self.wire.close()
        return how


@dataclass(slots=True)
class LoopProcesses:
    """The loop processes of one front.

    Attributes
    ----------
    priority : int
        Theirs in the real-time class; 0 for the usual class.
    """

    priority: int = 0
    _processes: dict[str, _Process] = field(default_factory=dict)
    _one: asyncio.Lock = field(default_factory=asyncio.Lock)

    async def lane(self, order: Order, files: tuple[int, ...], process_name: str) -> Lane:
        """Send an order, with the files of its lock; raise `OSError` where the system has no room for a process."""
        async with self._one:
            process = await self._running(process_name)
        ours, theirs = socket.socketpair()
        try:
            socket.send_fds(process.socket, [b"o"], [theirs.fileno(), *files])
        except OSError:
            ours.close()
            raise
        finally:
            theirs.close()
        wire = await wire_over(ours)
        wire.send(order)
        return Lane(wire, process)

    async def _running(self, name: str) -> _Process:
        found = self._processes.get(name)
        if found is not None and found.process.is_alive():
            return found
        if found is not None:
            await asyncio.to_thread(found.end, at_once=True)
        self._processes[name] = await asyncio.to_thread(_started, name, self.priority)
        return self._processes[name]

    async def close(self) -> None:
        """End the processes once their operations have ended."""
        processes, self._processes = self._processes, {}
        await asyncio.gather(*(asyncio.to_thread(one.end, at_once=False) for one in processes.values()))


def loop_processes(priority: int = 0) -> LoopProcesses | None:
    """Return the loop processes of a front; None where a process can be given no socket."""
    return None if sys.platform == "win32" else LoopProcesses(priority)


def _started(name: str, priority: int) -> _Process:
    from autotuner.control.operations.loop_process import live  # noqa: PLC0415 - what it imports is needed over there

    ours, theirs = socket.socketpair()
    try:
        process = multiprocessing.get_context("spawn").Process(
            target=live, args=(theirs, priority), name=f"loops-{name}"
        )
        process.start()
    except BaseException:
        ours.close()
        raise
    finally:
        theirs.close()
    return _Process(process, ours)
