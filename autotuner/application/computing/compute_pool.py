"""The compute pool: worker processes for identification, diagnosis and design, outside of the control loop.

Identification and tuning are pure functions of a recording. In real time they run in worker processes, so that no
sample is late because of them; in virtual time, where waiting for a real process has no meaning, they run in place.

Frozen values hold read-only mappings, which pickle does not support; this module registers them on both sides.
"""

from __future__ import annotations

import asyncio
import copyreg
import logging
import os
import signal
import sys
import threading
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.context import SpawnContext, SpawnProcess
from types import MappingProxyType, ModuleType
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

from autotuner.errors import ComputationError, ShuttingDownError

if TYPE_CHECKING:
    from collections.abc import Callable
    from concurrent.futures import Future
    from multiprocessing.connection import Connection

NICENESS, NICENESS_OF_VIEWS = 10, 15
"""Niceness of workers, below loops, verdicts and views: control has priority when processor time is short."""

ATTEMPTS = 2
"""Number of starts of a computation whose worker process is killed."""
ENDED_WITHIN_S = 5.0
"""Longest wait for a process that was killed, s."""

_log = logging.getLogger(__name__)

P = ParamSpec("P")
R = TypeVar("R")


def _read_only(entries: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(entries)


copyreg.pickle(MappingProxyType, lambda mapping: (_read_only, (dict(mapping),)))


def _start_worker(owner: Connection, niceness: int) -> None:
    """Leave Ctrl-C and a service manager's SIGTERM, which reach all at once, to the owner; end on its request."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    if hasattr(os, "nice"):
        os.nice(niceness)
    threading.Thread(target=_end_with, args=(owner,), name="owner", daemon=True).start()


def _end_with(owner: Connection) -> None:
    """End this worker, whatever it computes, when the other end of the line is closed: by its owner, or with it."""
    with suppress(EOFError, OSError):
        owner.recv_bytes()
    os._exit(1)


@dataclass(frozen=True, slots=True)
class InPlace:
    """Runs in the caller's own process: for virtual time and for tests."""

    async def run(self, function: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> R:
        """Call the function."""
        return function(*args, **kwargs)

    async def aside(self, function: Callable[[], R]) -> R:
        """Call the function."""
        return function()

    def interrupt(self) -> None:
        """Do nothing: every computation has ended when its call returns."""

    def close(self) -> None:
        """Do nothing: there are no workers."""


class Workers:
    """Runs computations in worker processes, started when first needed.

    A thread for each worker hands over one computation at a time. A computation that waits can be cancelled, because it
    waits for a thread: the pool of processes never holds a cancelled future, on which CPython 3.11 fails when a worker
    is killed.

    Parameters
    ----------
    count : int
        Most worker processes.
    niceness : int
        Their niceness.
    """

    def __init__(self, count: int = 1, niceness: int = NICENESS) -> None:
        self._count, self._niceness = count, niceness
        self._threads = ThreadPoolExecutor(count, "compute")
        self._pool: _Pool | None = None
        self._closed = False
        self._lock = threading.Lock()

    async def run(self, function: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> R:
        """Call the function in a worker process; it is repeated when that process is killed.

        Raises
        ------
        ComputationError
            The process died each time.
        ShuttingDownError
            The workers were closed.
        """
        try:
            return await asyncio.wrap_future(self._submit(partial(function, *args, **kwargs)))
        except asyncio.CancelledError:
            caller = asyncio.current_task()
            if self._closed and (caller is None or not caller.cancelling()):
                raise ShuttingDownError from None
            raise

    async def aside(self, function: Callable[[], R]) -> R:
        """Call the function in a thread of this process, whose state it reads."""
        return await asyncio.to_thread(function)

    def _submit(self, work: Callable[[], R]) -> Future[R]:
        with self._lock:
            if self._closed:
                raise ShuttingDownError
            return self._threads.submit(self._compute, work)

    def _compute(self, work: Callable[[], R]) -> R:
        """Return the value of a computation, from a thread that waits for it."""
        for _ in range(ATTEMPTS):
            pool = self._open_pool()
            try:
                return pool.executor.submit(work).result()
            except BrokenProcessPool:
                self._discard(pool)
        raise ComputationError(
            f"its process was ended {ATTEMPTS} times", remedy="Check the memory of the machine, and try again."
        )

    def _open_pool(self) -> _Pool:
        with self._lock:
            if self._closed:
                raise ShuttingDownError
            self._pool = self._pool or _Pool(self._count, self._niceness)
            return self._pool

    def _discard(self, pool: _Pool) -> None:
        """End a pool that lost a worker, unless another thread has done so."""
        with self._lock:
            if self._closed or self._pool is not pool:
                return
            self._pool = None
        pool.end()
        pool.join()
        _log.warning("a worker process ended unexpectedly; its computation is repeated")

    def interrupt(self) -> None:
        """End the worker processes, whatever they compute; none is started any more."""
        with self._lock:
            self._closed = True
        self._threads.shutdown(wait=False, cancel_futures=True)
        if self._pool is not None:
            self._pool.end()

    def close(self) -> None:
        """End the worker processes, and wait until they are gone: some milliseconds."""
        self.interrupt()
        self._threads.shutdown(wait=True)
        if self._pool is not None:
            self._pool.join()


class _Worker(SpawnProcess):
    """A process that does not import the program that starts it: a script without a guard would run once more."""

    def start(self) -> None:
        """Start it while an empty module replaces the program, which is what a new process imports."""
        main = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            super().start()
        finally:
            sys.modules["__main__"] = main


class _RecordingContext(SpawnContext):
    """Starts and records processes, because a pool cannot end workers that compute."""

    def __init__(self) -> None:
        super().__init__()
        self.started: list[SpawnProcess] = []

    def Process(self, *args: Any, **kwargs: Any) -> SpawnProcess:  # type: ignore[override]
        process = _Worker(*args, **kwargs)
        self.started.append(process)
        return process


class _Pool:
    """Worker processes, and the pipe that ends them when it closes."""

    def __init__(self, count: int, niceness: int) -> None:
        self._context = _RecordingContext()
        theirs, self._ours = self._context.Pipe(duplex=False)
        self.executor = ProcessPoolExecutor(
            count, self._context, initializer=_start_worker, initargs=(theirs, niceness)
        )

    def end(self) -> None:
        """End the processes now."""
        self._ours.close()
        for process in self._context.started:
            if process.pid is not None:
                process.kill()

    def join(self) -> None:
        """Wait until they are gone.

        The executor's own thread waits for the same processes. Two threads that wait for one process at once may both
        miss its end, so this one begins when that one has ended.
        """
        waiting = threading.Thread(target=self.executor.shutdown, name="compute-end", daemon=True)
        waiting.start()
        waiting.join(ENDED_WITHIN_S)
        for process in self._context.started:
            if process.pid is not None:
                process.join(ENDED_WITHIN_S)
