"""Real-time support of a loop process, in addition to Python's event loop.

    timers       a timer of the kernel, without slack, wakes the process shortly before a deadline; the process then
                 polls until the deadline. The timers of `epoll` have a resolution of whole milliseconds
    collector    objects are frozen every `PERIOD_S`, so a garbage collection only visits newer ones
    priority     `service.real_time`: the real-time class of the scheduler, locked memory, processors that do not halt
    stalls       how long a call blocked the event loop: this time does not count against the device

An interrupt wakes a halted processor. In a virtual machine the wake-up needs a free processor of the host and took
milliseconds on a loaded one. `cyclictest` also keeps processors from halting.

Invariants:

1. Where the system lacks or refuses one of these, a log line reports it if it was requested, and the loops are driven
   without it.
2. A thread of the real-time class that never waits starves all other processes. After `DEMOTED_S` without
   a wait the whole process returns to the usual class; where even that is impossible, the system ends the process after
   `ENDED_S`, and its front lets another process recover the loops.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import gc
import heapq
import logging
import os
import signal
import struct
import sys
from pathlib import Path
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

if TYPE_CHECKING:
    from collections.abc import Iterator
    from types import FrameType

DEMOTED_S, ENDED_S = 1, 3
PERIOD_S = 0.5
"""Period of `Upkeep`, s: it bounds the objects that one collection visits."""
YOUNG = 50_000
"""New objects after which a collection starts while a loop is driven."""
STALL_CHECK_S = 0.25
"""Period of the stall check, s; shorter delays are normal scheduling."""
LATENCY = Path("/dev/cpu_dma_latency")
"""While it is held open with 0 us in it, an idle processor waits instead of halting (`pm_qos_interface` of Linux)."""
SLACK = Path("/proc/self/timerslack_ns")
"""Timer slack of the main thread, ns; 50,000 by default."""
MEMORY = 1 | 2 | 4
"""MCL_CURRENT, MCL_FUTURE and MCL_ONFAULT of Linux: pages stay in memory after their first use."""
MONOTONIC = 1
"""CLOCK_MONOTONIC of Linux, the clock of the event loop."""
HEAD_START_S, HEAD_SHARE = 250e-6, 0.15
"""Longest time from the alarm to its deadline, s and as a share of the period: usual wake-up latency."""
MOST_AWAKE = 8
"""Loops of a process for which it waits awake: 8 at 10 Hz cost 2 % of a processor, 1,000 would need more than one."""
ABSOLUTE = 1
"""TFD_TIMER_ABSTIME of Linux: the time is a moment and no duration."""

_log = logging.getLogger(__name__)


def claim(priority: int) -> bool:
    """Put the calling main thread and its children into the real-time class, and lock its memory.

    Parameters
    ----------
    priority : int
        1 to 99; 0 for the usual class.

    Returns
    -------
    bool
        Whether it is in the class.
    """
    with contextlib.suppress(OSError):
        SLACK.write_text("1")
    if priority <= 0:
        return False
    if sys.platform != "linux":
        _log.warning("service.real_time has no effect on this system")
        return False
    try:
        _limit()
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        _log.warning("service.real_time has no effect: %s; give the service CAP_SYS_NICE", error.strerror)
        return False
    _lock_memory()
    return True


def _limit() -> None:
    """Let no thread of this process stay in the class without ever waiting."""
    import resource  # noqa: PLC0415 - not on every system

    signal.signal(signal.SIGXCPU, _demote)
    hard = resource.getrlimit(resource.RLIMIT_RTTIME)[1]
    limits = [round(1e6 * limit_s) for limit_s in (DEMOTED_S, ENDED_S)]
    if hard != resource.RLIM_INFINITY:
        limits = [min(limit, hard) for limit in limits]
    resource.setrlimit(resource.RLIMIT_RTTIME, (limits[0], limits[1]))


def _demote(_number: int, _frame: FrameType | None) -> None:
    """Put all threads of this process back into the usual class."""
    for thread in Path("/proc/self/task").iterdir():
        with contextlib.suppress(OSError):  # it has ended meanwhile
            os.sched_setscheduler(int(thread.name), os.SCHED_OTHER, os.sched_param(0))
    _log.critical("a thread of the real-time class did not wait for %d s: it is in the usual class now", DEMOTED_S)


def _lock_memory() -> None:
    """Lock used pages in memory, where the limit leaves room for all of them."""
    import resource  # noqa: PLC0415 - not on every system

    if resource.RLIM_INFINITY in resource.getrlimit(resource.RLIMIT_MEMLOCK) or os.geteuid() == 0:
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).mlockall(MEMORY)


class Alarm:
    """Wakes an event loop in time for a deadline: a timerfd is a file that becomes readable at its moment.

    `epoll_wait` takes its limit in whole milliseconds, and Python rounds it up, so that a usual timer is late by half a
    millisecond at the median.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop, self._due_s = loop, list[float]()
        self._library = ctypes.CDLL(None, use_errno=True)
        self._file = self._library.timerfd_create(MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC)
        if self._file < 0:
            raise OSError(ctypes.get_errno(), "timerfd_create")
        loop.add_reader(self._file, self._ring)

    @property
    def waiting(self) -> int:
        """Number of pending deadlines."""
        return len(self._due_s)

    def ring_at(self, due_s: float) -> None:
        """Have the event loop awake at a moment of its clock, s."""
        heapq.heappush(self._due_s, due_s)
        if self._due_s[0] == due_s:
            self._set()

    def _ring(self) -> None:
        now_s = self._loop.time()
        while self._due_s and self._due_s[0] <= now_s:
            heapq.heappop(self._due_s)
        self._set()

    def _set(self) -> None:
        """Set the timer to the earliest time, or disarm it; clear its readable state."""
        due_ns = round(1e9 * self._due_s[0]) if self._due_s else 0
        setting = struct.pack("@llll", 0, 0, *divmod(due_ns, 1_000_000_000))
        self._library.timerfd_settime(self._file, ABSOLUTE, setting, None)

    def close(self) -> None:
        """Return the file to the system."""
        self._loop.remove_reader(self._file)
        os.close(self._file)


_alarms: WeakKeyDictionary[asyncio.AbstractEventLoop, Alarm] = WeakKeyDictionary()


@contextlib.contextmanager
def fine_timers() -> Iterator[None]:
    """Give the running event loop an alarm meanwhile, where the system has such timers."""
    loop = asyncio.get_running_loop()
    try:
        alarm = _alarms[loop] = Alarm(loop)
    except (OSError, AttributeError):  # not permitted here, or another C library
        yield
        return
    try:
        yield
    finally:
        del _alarms[loop]
        alarm.close()


def woken_at(due_s: float, period_s: float) -> float:
    """Return when the running event loop is awake for a deadline of its clock, s: a little before, if by an alarm."""
    alarm = _alarms.get(asyncio.get_running_loop())
    if alarm is None:
        return due_s
    head_s = min(HEAD_START_S, HEAD_SHARE * period_s) if alarm.waiting < MOST_AWAKE else 0.0
    woken_s = due_s - head_s
    alarm.ring_at(woken_s)
    return woken_s


class Upkeep:
    """Work of every `PERIOD_S` for the deadlines of a loop process; in a service every second.

    Parameters
    ----------
    awake : bool
        Whether processors shall not halt while a loop is driven.
    """

    def __init__(self, *, awake: bool) -> None:
        self._awake, self._latency, self._aside = awake, -1, False
        self._young, *self._older = gc.get_threshold()

    def look(self, *, busy: bool) -> None:
        """Freeze objects while a loop is driven; collect once after the last loop."""
        if busy or self._aside:
            gc.set_threshold(YOUNG if busy else self._young, *self._older)
            if not busy:
                gc.unfreeze()
            gc.collect()
            gc.freeze()
        self._aside = busy
        if self._latency >= 0 and not busy:
            os.close(self._latency)
            self._latency = -1
        elif self._awake and self._latency < 0 and busy:
            self._stay_awake()

    def _stay_awake(self) -> None:
        """Request processors that do not halt; it ends with the file, and so with the process, however that ends."""
        try:
            self._latency = os.open(LATENCY, os.O_WRONLY)
            os.write(self._latency, struct.pack("=i", 0))
        except OSError as error:
            self._awake = False
            _log.warning(
                "processors may halt between samples: %s: %s; let the service write it", LATENCY, error.strerror
            )


class StallMeter:
    """Beats on the running event loop until it is ended.

        beat_k = beat_(k-1) + PULSE_S         still += now - due, where that is more than `STALL_CHECK_S`

    A call that ran into its time limit may have been left without an answer, or this program was paused and could not
    take it. A timer that goes off late distinguishes them.
    """

    __slots__ = ("_loop", "_next", "_still_s")

    def __init__(self) -> None:
        loop = self._loop = asyncio.get_running_loop()
        self._still_s = 0.0
        self._next = loop.call_at(loop.time() + STALL_CHECK_S, self._beat)

    def end(self) -> float:
        """Return how long the event loop was blocked, s; call once."""
        self._next.cancel()
        late_s = self._loop.time() - self._next.when()
        return self._still_s + late_s if late_s > STALL_CHECK_S else self._still_s

    def _beat(self) -> None:
        now_s = self._loop.time()
        late_s = now_s - self._next.when()
        self._still_s += late_s if late_s > STALL_CHECK_S else 0.0
        self._next = self._loop.call_at(now_s + STALL_CHECK_S, self._beat)
