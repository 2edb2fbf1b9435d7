"""Where the arithmetic runs: never on the control loop's time.

Identification and tuning are pure functions of a recording. Live they run in worker processes, so that no sample is
late because of them; in virtual time, where waiting for a real process has no meaning, they run in place.

Frozen values hold read-only mappings, which pickle does not know by itself; this module teaches it, on both sides.
"""

from __future__ import annotations

import asyncio
import copyreg
import multiprocessing
import os
import signal
import threading
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ParamSpec, Protocol, TypeVar

from autotuner.errors import ShuttingDownError
from autotuner.runtime.real_time import leave

if TYPE_CHECKING:
    from collections.abc import Callable
    from concurrent.futures import Future
    from multiprocessing.connection import Connection

POLITENESS = 10
"""Steps by which the workers give way: where there is less time than work, the loops have theirs first."""

P = ParamSpec("P")
R = TypeVar("R")


def _read_only(entries: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(entries)


copyreg.pickle(MappingProxyType, lambda mapping: (_read_only, (dict(mapping),)))


def _start_worker(owner: Connection) -> None:
    """Leave Ctrl-C and a service manager's SIGTERM, which reach all at once, to the owner; end when it says so."""
    leave()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    if hasattr(os, "nice"):
        os.nice(POLITENESS)
    threading.Thread(target=_end_with, args=(owner,), name="owner", daemon=True).start()


def _end_with(owner: Connection) -> None:
    """End this worker, whatever it computes, when the other end of the line is closed: by its owner, or with it."""
    with suppress(EOFError, OSError):
        owner.recv_bytes()
    os._exit(1)


class Arithmetic(Protocol):
    """Runs a pure function somewhere."""

    async def run(self, function: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> R:
        """Return the function's value, or raise what it raised."""

    async def aside(self, function: Callable[[], R]) -> R:
        """Return the function's value, called beside the event loop: what takes milliseconds makes samples late."""

    def interrupt(self) -> None:
        """End all work at once, without waiting; who waits for it gets `ShuttingDownError`."""

    def close(self) -> None:
        """Give the workers back."""


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
        """Do nothing: what has begun has ended."""

    def close(self) -> None:
        """Do nothing: there are no workers."""


@dataclass(slots=True)
class Workers:
    """Runs in fresh worker processes, started when first needed; may be asked from several threads.

    Starting a process and handing it a long recording takes milliseconds, so no event loop waits for that either.
    """

    count: int = 1
    _pool: _Pool | None = field(default=None)
    _closed: bool = False
    _one: threading.Lock = field(default_factory=threading.Lock)

    async def run(self, function: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> R:
        """Call the function in a worker process.

        Raises
        ------
        BrokenProcessPool
            That process died of it.
        ShuttingDownError
            The workers have been given back.
        """
        try:
            return await asyncio.wrap_future(await asyncio.to_thread(self._begin, partial(function, *args, **kwargs)))
        except (asyncio.CancelledError, BrokenProcessPool):
            if self._closed:
                raise ShuttingDownError from None
            raise

    async def aside(self, function: Callable[[], R]) -> R:
        """Call the function in a thread: it looks at what is here."""
        return await asyncio.to_thread(function)

    def _begin(self, work: Callable[[], R]) -> Future[R]:
        with self._one:
            if self._closed:
                raise ShuttingDownError
            self._pool = self._pool or _Pool(self.count)
            try:
                return self._pool.executor.submit(work)
            except BrokenProcessPool:
                self._pool.end()
                self._pool = _Pool(self.count)
                return self._pool.executor.submit(work)

    def interrupt(self) -> None:
        """End the worker processes, whatever they compute; none is started any more."""
        with self._one:
            self._closed = True
            if self._pool is not None:
                self._pool.end()

    def close(self) -> None:
        """End the worker processes, and wait until they are gone: some milliseconds."""
        self.interrupt()
        with self._one:
            pool, self._pool = self._pool, None
        if pool is not None:
            pool.executor.shutdown(wait=True, cancel_futures=True)


class _Pool:
    """Worker processes, and the line whose end is theirs."""

    def __init__(self, count: int) -> None:
        context = multiprocessing.get_context("spawn")
        theirs, self._ours = context.Pipe(duplex=False)
        self.executor = ProcessPoolExecutor(count, context, initializer=_start_worker, initargs=(theirs,))

    def end(self) -> None:
        """End them now; may be repeated."""
        self._ours.close()
