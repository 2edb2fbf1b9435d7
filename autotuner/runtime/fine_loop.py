"""An event loop whose timers are due to the microsecond: a timer of the kernel (timerfd) among its files.

    deadline -> timerfd_settime -> epoll_wait without a time limit

`epoll_wait` takes its limit in whole milliseconds, and Python rounds it up, so that a usual event loop is late by half
a millisecond at the median. A timerfd is a file that becomes readable at its time, which has nanoseconds. Waking a
thread takes kernel and caches some 100 us more; so it is asked for `LEAD_S` earlier, and what is left is not slept: the
event loop asks again and again, for its files too, until the time has come.

Rule of this file: where the system has no such timer, the usual event loop is returned; nothing else differs.
"""

from __future__ import annotations

import asyncio
import ctypes
import math
import os
import selectors
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

MONOTONIC = 1  # CLOCK_MONOTONIC, the clock of the event loop
NONBLOCK = os.O_NONBLOCK if sys.platform != "win32" else 0
CLOEXEC = 0o2000000
LEAD_S = 100e-6
"""The end of a wait that is not slept: at most so much processor time a deadline."""


def fine_event_loop() -> asyncio.AbstractEventLoop:
    """Return a new event loop with fine timers where the system has them, else the usual one."""
    if sys.platform != "linux":
        return asyncio.new_event_loop()
    try:
        selector = FineSelector()
    except (OSError, AttributeError):  # not permitted here, or another C library
        return asyncio.new_event_loop()
    return asyncio.SelectorEventLoop(selector)


if sys.platform == "linux":

    class FineSelector(selectors.EpollSelector):
        """Waits as long as it is told, not rounded up to milliseconds."""

        def __init__(self) -> None:
            super().__init__()
            try:
                self._alarm, self._set = _timer()
            except BaseException:
                super().close()
                raise
            self.register(self._alarm, selectors.EVENT_READ)

        def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
            """Return what is ready, after `timeout` s at the latest; it may return earlier with nothing."""
            if timeout is not None and timeout > LEAD_S:
                self._set(self._alarm, math.ceil(1e9 * (timeout - LEAD_S)))
                timeout = None
            elif timeout is not None:
                timeout = 0.0
            ready = super().select(timeout)
            others = [(key, events) for key, events in ready if key.fd != self._alarm]
            if len(others) < len(ready):
                os.read(self._alarm, 8)
            return others

        def close(self) -> None:
            """Give the files back; may be repeated."""
            if self._alarm >= 0:
                os.close(self._alarm)
                self._alarm = -1
            super().close()

    class _Time(ctypes.Structure):
        _fields_ = (("s", ctypes.c_long), ("ns", ctypes.c_long))

    class _Setting(ctypes.Structure):
        _fields_ = (("interval", _Time), ("value", _Time))

    def _timer() -> tuple[int, Callable[[int, int], object]]:
        """Return a new timer, and what sets one, by file and ns from now."""
        if sys.version_info >= (3, 13):
            return os.timerfd_create(MONOTONIC, flags=NONBLOCK | CLOEXEC), _set_by_python
        library = ctypes.CDLL(None, use_errno=True)

        def set_by_library(file: int, ns: int) -> None:
            setting = _Setting(_Time(0, 0), _Time(*divmod(ns, 1_000_000_000)))
            if library.timerfd_settime(file, 0, ctypes.byref(setting), None) != 0:
                raise OSError(ctypes.get_errno(), "timerfd_settime")

        file = library.timerfd_create(MONOTONIC, NONBLOCK | CLOEXEC)
        if file < 0:
            raise OSError(ctypes.get_errno(), "timerfd_create")
        return file, set_by_library

    def _set_by_python(file: int, ns: int) -> None:
        if sys.version_info >= (3, 13):
            os.timerfd_settime_ns(file, initial=ns)
