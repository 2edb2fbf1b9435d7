"""The clock: the only module that reads it.

    deadline_k = origin + k period

The origin is the first tick, or one that the loops on a line have in common, so that they are read at the same time.

Deadlines are absolute, so lateness never accumulates. A tick that was missed is skipped: the next deadline is the
first one still ahead (`next_index`), and the sample carries how late it was.

`time` here is the event loop's own, so the same code runs on the wall clock and in virtual time.
"""

from __future__ import annotations

import asyncio
import math
import time
from datetime import UTC, datetime
from typing import TYPE_CHECKING, NamedTuple

from autotuner.control.clock.real_time import woken_at

if TYPE_CHECKING:
    from collections.abc import Callable

clock = time.monotonic
"""The clock of the usual event loop, s."""
SHORTEST_SLEEP_S = 0.1
"""Shortest sleep of the machine that is detected, s: this program may be preempted between reads of two clocks."""
ROUNDING = 1e-9
"""Share of a period by which a deadline may lie ahead through rounding alone and still count as reached."""


def processor_time_spent(budget_ms: float) -> Callable[[], bool]:
    """Return a function that reports whether this process has used so much more processor time, ms, since this call."""
    end_s = time.process_time() + budget_ms / 1000.0
    return lambda: time.process_time() > end_s


def time_spent(limit_s: float) -> Callable[[], bool]:
    """Return a function that reports whether a duration has passed since this call."""
    end_s = time.monotonic() + limit_s
    return lambda: time.monotonic() > end_s


def next_index(elapsed_s: float, period_s: float) -> int:
    """Return the index of the first deadline strictly ahead of `elapsed_s` since the origin; at least 1."""
    return max(math.floor(elapsed_s / period_s + ROUNDING) + 1, 1)


class Tick(NamedTuple):
    """A deadline that was reached.

    Attributes
    ----------
    t : float
        Time now, s, since the ticker was made.
    lateness_s : float
        How long after its deadline, s.
    missed : int
        Deadlines skipped since the tick before.
    slept_s : float
        For how long the computer slept since the tick before, s: time that the event loop's clock does not count.
    waited_s : float
        For how long deadlines were waited for as planned since the ticker was made, s.
    """

    t: float
    lateness_s: float
    missed: int
    slept_s: float = 0.0
    waited_s: float = 0.0


class Stop:
    """A request to end, made once: it wakes whatever waits for a deadline."""

    __slots__ = ("_is_set", "_waiting")

    def __init__(self) -> None:
        self._is_set = False
        self._waiting: set[asyncio.Future[None]] = set()

    def is_set(self) -> bool:
        """Return whether the end was requested."""
        return self._is_set

    def set(self) -> None:
        """Ask for it; may be repeated."""
        self._is_set = True
        for waiter in self._waiting:
            _wake(waiter)

    async def wait(self, delay_s: float) -> bool:
        """Wait for `delay_s`; return True at once when the end is requested."""
        if self._is_set:
            return True
        loop = asyncio.get_running_loop()
        waiter = loop.create_future()  # a plain timer costs half of `asyncio.timeout`
        timer = loop.call_later(max(delay_s, 0.0), _wake, waiter)
        self._waiting.add(waiter)
        try:
            await waiter
        finally:
            self._waiting.discard(waiter)
            timer.cancel()
        return self._is_set


def _wake(waiter: asyncio.Future[None]) -> None:
    if not waiter.done():
        waiter.set_result(None)


class Ticker:
    """Ticks every `period_s`: the first time at once, or on the time grid of the other loops on a line.

    Parameters
    ----------
    period_s : float
        Time from one deadline to the next, s.
    counted_from : callable, optional
        Returns the origin of that grid on the event loop's clock, s, at the first tick (`autotuner.ports.LineSharing`).
    """

    def __init__(self, period_s: float, counted_from: Callable[[float], float] | None = None) -> None:
        self.period_s, self._counted_from = period_s, counted_from
        loop = asyncio.get_running_loop()
        self._time = loop.time
        self._origin = loop.time()
        self._first: float | None = None
        self._index = 0
        self._slept_s = asleep_s()
        self._due_s = math.inf
        self._waited_s = 0.0

    @property
    def overdue_s(self) -> float:
        """Time since the awaited deadline, s; 0 before it or without one."""
        return max(self.now_s - self._due_s, 0.0)

    @property
    def now_s(self) -> float:
        """Time since the ticker was made, s."""
        return self._time() - self._origin

    def since(self, moment_s: float) -> float:
        """Return the time of a moment on the event loop's clock since the ticker was made, s."""
        return moment_s - self._origin

    async def tick(self, stop: Stop) -> Tick | None:
        """Wait for the next deadline and return it; None at once when `stop` is set."""
        now_s = self._time() - self._origin
        if self._first is None:
            ahead_s = self._ahead_s()
            self._first = now_s if ahead_s == 0.0 else now_s + ahead_s - self.period_s
            if ahead_s == 0.0:
                return None if stop.is_set() else Tick(now_s, 0.0, 0)
        # a timer may go off early by the resolution of the clock: its deadline is over all the same
        following = max(next_index(now_s - self._first, self.period_s), self._index + 1)
        missed, self._index = following - self._index - 1, following
        deadline_s = self._due_s = self._first + following * self.period_s
        due_s = self._origin + deadline_s
        woken_s = woken_at(due_s, self.period_s)
        if await stop.wait(woken_s - self._time()):
            return None
        while woken_s < due_s and self._time() < due_s:
            pass
        self._waited_s += deadline_s - now_s
        now_s = self._time() - self._origin
        slept_s, self._slept_s, self._due_s = self._slept_s, asleep_s(), math.inf
        return Tick(now_s, max(now_s - deadline_s, 0.0), missed, _noted(self._slept_s - slept_s), self._waited_s)

    def _ahead_s(self) -> float:
        """Return the time to the first tick, s."""
        if self._counted_from is None:
            return 0.0
        now_s = self._time()
        ahead_s = (self._counted_from(now_s) - now_s) % self.period_s
        return ahead_s if ROUNDING < ahead_s / self.period_s < 1.0 - ROUNDING else 0.0


def asleep_s() -> float:
    """Return for how long this computer has slept since it was started, s; 0 where it does not report it."""
    return time.clock_gettime(time.CLOCK_BOOTTIME) - clock() if hasattr(time, "CLOCK_BOOTTIME") else 0.0


def _noted(slept_s: float) -> float:
    """Return the duration of a sleep of the machine; 0 below the uncertainty of two clock reads."""
    return slept_s if slept_s > SHORTEST_SLEEP_S else 0.0


def seconds_since(stamp_s: float) -> float:
    """Return the wall-clock time since a file system's stamp, s; for long intervals only, never for measuring."""
    return datetime.now(UTC).timestamp() - stamp_s


def utc_now() -> str:
    """Return the wall-clock time as an ISO 8601 stamp in UTC, for labels; never for measuring."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")
