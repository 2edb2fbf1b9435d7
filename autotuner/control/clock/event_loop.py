"""An event loop whose timers are due to the microsecond, for the loops' thread.

    deadline - lead    timerfd -> epoll_wait without a time limit -> the interpreter's lock
    + CALM_S           who had to give the lock away begins to wait for it anew, and now patiently
    deadline           the end is not slept, and the lock is not given away

`epoll_wait` takes its limit in whole milliseconds, and Python rounds it up, so that a usual event loop is late by half
a millisecond at the median. A timerfd is a file that becomes readable at its time, which has nanoseconds. Being woken
then takes the kernel some 50 us, and the lock of the interpreter, where another thread has it, as long as that thread
may keep it (`ASKED_S`) and until it has finished what it calls. So the thread is woken `lead` earlier.

Rules of this file:

1. Where the system has no such timer, the usual event loop is returned; nothing else differs.
2. The lead follows what waking took lately, between `SHORTEST_S` and `LONGEST_S`, and is at most `SHARE` of a wait.
3. How long a thread waits before it asks for the lock is read when its wait begins: `ASKED_S` in the thread that gave
   the lock to this one. It would have it back before the deadline, and this thread would then wait `HELD_S`. So the
   lock is let go and taken again at once, which wakes who waits, too late to get it: his wait begins anew by `HELD_S`.
4. Nothing between waking and the deadline gives the lock away: no file is read, no call lets go of it. Of this time the
   thread sleeps what it can, with the lock.
5. A thread that is alone in its process has the lock whenever it wakes. Its lead is at most `ALONE_SHARE` of a wait:
   the less it is awake, the less often it meets what stops a whole processor.
"""

from __future__ import annotations

import asyncio
import ctypes
import math
import os
import selectors
import sys
from functools import partial
from typing import TYPE_CHECKING

from autotuner.control.clock.ticker import clock
from autotuner.control.clock.turns import Turns

if TYPE_CHECKING:
    from collections.abc import Callable

MONOTONIC = 1
"""CLOCK_MONOTONIC of Linux, the clock of the event loop."""
NONBLOCK = os.O_NONBLOCK if sys.platform != "win32" else 0
CLOEXEC = 0o2000000
"""TFD_CLOEXEC of Linux: the timer is not inherited by programs that are started."""
ABSOLUTE = 1
"""TIMER_ABSTIME of Linux: the time is a moment and no duration."""
TIMER_SLACK = 29
"""PR_SET_TIMERSLACK of Linux."""
SHORTEST_S, LONGEST_S = 60e-6, 450e-6
"""Bounds of the lead."""
SHARE = 0.6
"""Most of a wait in which the lock is kept."""
ALONE_SHARE = 0.05
"""The same where nobody else wants the lock: a thread that is awake meets what stops the whole processor."""
ROOM = 1.3
"""Lead over what waking took at most lately."""
FORGOTTEN = 0.002
"""Share by which the lead shrinks towards what waking takes, a deadline."""
ASKED_S = 100e-6
"""How long a thread of this process keeps the lock when another one wants it, s."""
HELD_S = 400e-6
"""The same towards who waits for it in the end of a wait."""
CALM_S = 20e-6
"""From taking the lock to letting go of it for nothing, s: by then the one who gave it away waits for it."""
OTHERS = 2
"""How many may wait for the lock then: letting go wakes one of them. Requests, and what is stored or logged."""
HEAD_START_S = 80e-6
"""From the end of a wait to the code that waited, at most when that has not run for a while."""
HEAD_SHARE = 0.15
"""Most of the time that is spent on head starts."""
WARM_S = 40e-6
"""Last part of a wait, in which the event loop turns: its code is at hand when the time has come."""
POLLED_S = 200e-6
"""Longest time in which files are not looked at while there is other work, s."""


def fine_event_loop(turns: Turns | None = None) -> asyncio.AbstractEventLoop:
    """Return a new event loop with fine timers where the system has them, else the usual one.

    `turns` is told when its thread wants the interpreter's lock; None in a process where nobody else wants it.
    """
    if sys.platform != "linux":
        return asyncio.new_event_loop()
    try:
        selector = FineSelector(turns)
    except (OSError, AttributeError):  # not permitted here, or another C library
        return asyncio.new_event_loop()
    return FineEventLoop(selector)


class FineEventLoop(asyncio.SelectorEventLoop):
    """Wakes who keeps deadlines early enough to be there in time; see `autotuner.control.clock.ticker.Punctual`."""

    _latest_due_s = 0.0

    def head_start_s(self, due_s: float) -> float:
        """Return how much earlier than due to be woken, s: nothing where deadlines come thick and fast."""
        if abs(due_s - self._latest_due_s) < HEAD_START_S / HEAD_SHARE:
            return 0.0
        self._latest_due_s = due_s
        return HEAD_START_S

    def hold_until(self, due_s: float) -> None:
        """Wait for the rest of a head start."""
        if due_s - clock() <= HEAD_START_S:
            _hold_until(due_s)


def _hold_until(due_s: float) -> None:
    """Wait without sleeping and without giving the interpreter's lock away: in C, where no thread is asked for it."""
    any(map(due_s.__le__, iter(clock, None)))


if sys.platform == "linux":

    class FineSelector(selectors.EpollSelector):
        """Waits as long as it is told, not rounded up to milliseconds; for the most urgent thread of a process."""

        def __init__(self, turns: Turns | None) -> None:
            super().__init__()
            self._turns, self._alone = turns or Turns(), turns is None
            self._share, self._least_s = (ALONE_SHARE, SHORTEST_S) if self._alone else (SHARE, 0.0)
            try:
                self._alarm, self._set, self._sleep_until, self._let_go = _timer()
            except BaseException:
                super().close()
                raise
            self.register(self._alarm, selectors.EVENT_READ)
            self._lead_s = LONGEST_S
            self._polled_s, self._kept_before_s = 0.0, sys.getswitchinterval()
            sys.setswitchinterval(ASKED_S)

        def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
            """Return what is ready, after `timeout` s at the latest; it may return earlier with nothing."""
            if timeout is None or timeout <= 0.0:
                return self._unhurried(timeout)
            now_s = clock()
            due_s = now_s + timeout
            if timeout > SHORTEST_S:
                asked_s = due_s - min(self._lead_s, max(self._share * timeout, self._least_s))
                self._turns.wanted(asked_s, due_s)
                self._set(self._alarm, math.ceil(1e9 * (asked_s - now_s)))
                if ready := self._ready(None):
                    return ready
                self._learn(clock() - asked_s)
                if not self._alone:
                    self._calm(due_s - WARM_S)
                self._polled_s = due_s
            elif now_s - self._polled_s > POLLED_S and (ready := self._ready(0.0)):
                return ready
            sys.setswitchinterval(HELD_S)
            if 0.0 < due_s - clock() <= LONGEST_S:
                self._sleep_until(due_s - WARM_S - SHORTEST_S)
                _hold_until(due_s - WARM_S)
            return []

        def _unhurried(self, timeout: float | None) -> list[tuple[selectors.SelectorKey, int]]:
            """Return what is ready where no deadline is near: the work of one that is over, or none is to come."""
            sys.setswitchinterval(ASKED_S)
            if timeout is None:
                self._turns.free()
                self._set(self._alarm, 0)
            elif clock() - self._polled_s < POLLED_S:
                return []
            return self._ready(timeout)

        def _learn(self, took_s: float) -> None:
            """Take note of how long it took to be woken."""
            wanted = min(max(ROOM * took_s, SHORTEST_S), LONGEST_S)
            self._lead_s = max(wanted, self._lead_s + FORGOTTEN * (wanted - self._lead_s))

        def _calm(self, until_s: float) -> None:
            """Have those who wait for the lock begin anew to wait for it; see rule 3."""
            left = OTHERS
            while left and (moment_s := clock() + CALM_S) < until_s:
                _hold_until(moment_s)
                sys.setswitchinterval(ASKED_S)  # for this thread, should another one be faster
                self._let_go()
                sys.setswitchinterval(HELD_S)
                left -= clock() - moment_s < CALM_S  # else it was lost, and who had it waits as before

        def _ready(self, timeout: float | None) -> list[tuple[selectors.SelectorKey, int]]:
            sys.setswitchinterval(ASKED_S)
            ready = super().select(timeout)
            sys.setswitchinterval(HELD_S)  # at once: who has just given the lock away begins to wait for it
            self._polled_s = clock()
            self._turns.at_work()
            others = [(key, events) for key, events in ready if key.fd != self._alarm]
            if others:
                sys.setswitchinterval(ASKED_S)
            return others

        def close(self) -> None:
            """Give the files back; may be repeated."""
            if self._alarm >= 0:
                os.close(self._alarm)
                self._alarm = -1
                sys.setswitchinterval(self._kept_before_s)
            super().close()

    class _Time(ctypes.Structure):
        _fields_ = (("s", ctypes.c_long), ("ns", ctypes.c_long))

    class _Setting(ctypes.Structure):
        _fields_ = (("interval", _Time), ("s", ctypes.c_long), ("ns", ctypes.c_long))

    def _timer() -> tuple[int, Callable[[int, int], object], Callable[[float], object], Callable[[], object]]:
        """Return a timer, what sets one, what sleeps until a moment with the lock, and what lets go of it for nothing.

        It is set by file and ns from now (0: never), and is readable no more.
        """
        library = ctypes.PyDLL(None, use_errno=True)  # which keeps the lock: these calls take a microsecond

        settime, setting = library.timerfd_settime, _Setting()
        at = ctypes.byref(setting)  # made once: it takes longer than the call

        def set_timer(file: int, ns: int) -> None:
            setting.s, setting.ns = divmod(ns, 1_000_000_000)
            if settime(file, 0, at, None) != 0:
                raise OSError(ctypes.get_errno(), "timerfd_settime")

        def sleep_until(due_s: float) -> None:
            if due_s > clock():
                moment = _Time(*divmod(round(1e9 * due_s), 1_000_000_000))
                library.clock_nanosleep(MONOTONIC, ABSOLUTE, ctypes.byref(moment), None)

        file = library.timerfd_create(MONOTONIC, NONBLOCK | CLOEXEC)
        if file < 0:
            raise OSError(ctypes.get_errno(), "timerfd_create")
        library.prctl(TIMER_SLACK, 1, 0, 0, 0)  # of this thread: its waits for the lock are as short as they are meant
        return file, set_timer, sleep_until, partial(ctypes.CDLL(None).abs, 0)  # any short call by `CDLL` lets go of it
