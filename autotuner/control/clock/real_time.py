"""The real-time class of the system's scheduler, for the one thread that keeps the deadlines of the loops.

    claimed     that thread, at its priority, for good
    lent        the other threads of this process, one step below, while a tuning runs

A thread of the usual class that has the interpreter's lock when another program takes its processor keeps the lock for
the whole slice of that program, 3 ms, and the urgent thread waits for it however high its priority is. So whoever may
hold the lock has nearly the priority of whoever waits for it: the ceiling protocol.

Rules of this file:

1. What threads of the class start, threads and worker processes, is not in the class.
2. A thread of this class that never waits takes its processor from everybody else. After `DEMOTED_S` without a wait
   what is lent is taken back, after twice that the urgent thread is put back too; where even that is impossible, the
   system ends the process after `ENDED_S`, and the next start gives its loops back.
3. Nothing is lent while the other threads take more than `SHARE` of a processor together, as under a flood of requests.
4. While a tuning runs, the processors stay awake too (`autotuner.control.clock.wakefulness`).
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING

from autotuner.control.clock.ticker import clock
from autotuner.control.clock.wakefulness import Wakefulness

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from types import FrameType

DEMOTED_S, ENDED_S = 1, 3

SHARE = 0.6
"""Most processor time of the other threads, of one processor, with which priority is lent to them."""

_log = logging.getLogger(__name__)
_claimed: dict[int, int] = {}
"""Priorities of the threads that asked for the class, by the system's numbers."""
_lent: set[int] = set()
"""Numbers of the threads that were put into it."""


def claim(priority: int) -> bool:
    """Put the calling thread into the class; without permission it stays as it is.

    Parameters
    ----------
    priority : int
        1 to 99; 0 for the usual class.

    Returns
    -------
    bool
        Whether it is in the class.
    """
    if priority <= 0:
        return False
    if sys.platform != "linux":
        _log.warning("service.real_time has no effect on this system")
        return False
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except OSError as error:
        _log.warning("service.real_time has no effect: %s; give the service CAP_SYS_NICE", error.strerror)
        return False
    _claimed[threading.get_native_id()] = priority
    return True


def leave() -> None:
    """Take the calling thread out of the class, whoever put it there; always permitted."""
    if sys.platform == "linux":
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def guard() -> None:
    """Let no thread of this process stay in the class without ever waiting; to be called in the main thread."""
    if sys.platform != "linux":
        return
    import resource  # noqa: PLC0415 - not on every system

    signal.signal(signal.SIGXCPU, _demote)
    hard = resource.getrlimit(resource.RLIMIT_RTTIME)[1]
    limits = [round(1e6 * limit_s) for limit_s in (DEMOTED_S, ENDED_S)]
    if hard != resource.RLIM_INFINITY:
        limits = [min(limit, hard) for limit in limits]
    resource.setrlimit(resource.RLIMIT_RTTIME, (limits[0], limits[1]))


class Lender:
    """Lends priority to the threads that may hold the interpreter's lock, and keeps the processors awake.

    Parameters
    ----------
    busy : callable
        Returns whether a tuning runs.
    """

    def __init__(self, busy: Callable[[], bool]) -> None:
        self._busy = busy
        self._wakefulness = Wakefulness()
        self._then_s, self._used_s = clock(), _used_s()

    def look(self) -> None:
        """Lend to the threads that are there now, or take back what is lent; called about twice a second."""
        now_s, used_s = clock(), _used_s()
        frugal = used_s - self._used_s < SHARE * (now_s - self._then_s)
        self._then_s, self._used_s = now_s, used_s
        needed = bool(_claimed) and self._busy()
        if needed:
            self._wakefulness.ask()
        else:
            self._wakefulness.withdraw()
        if frugal and needed:
            _lend()
        elif _lent:
            _take_back()


def _lend() -> None:
    threads, priority = _threads(), max(min(_claimed.values()) - 1, 1)
    _lent.intersection_update(threads)
    new = threads.difference(_lent, _claimed)
    _lent.update(_put(new, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, priority))


def _used_s() -> float:
    """Return the processor time of the threads that did not claim the class, s."""
    used, claimed_ns = os.times(), 0
    for thread in _claimed:
        with contextlib.suppress(OSError):  # it has ended, or this kernel does not tell
            claimed_ns += int(Path(f"/proc/self/task/{thread}/schedstat").read_text().split()[0])
    return used.user + used.system - 1e-9 * claimed_ns


def _threads() -> set[int]:
    """Return the numbers of the threads that may hold the interpreter's lock; that of one that ended is given anew."""
    return {thread.native_id for thread in threading.enumerate() if thread.native_id is not None}


def _put(threads: Iterable[int], policy: int, priority: int) -> Iterable[int]:
    """Put threads into a class; return those for which it was possible."""
    done = []
    for thread in threads:
        with contextlib.suppress(OSError):  # it has ended meanwhile, or the permission is gone
            os.sched_setscheduler(thread, policy, os.sched_param(priority))
            done.append(thread)
    return done


def _take_back() -> None:
    _put(_lent.intersection(_threads()), os.SCHED_OTHER, 0)
    _lent.clear()


def _demote(_number: int, _frame: FrameType | None) -> None:
    """Put back into the usual class what is lent; when nothing is, all threads."""
    told = "what was lent to the others is taken back" if _lent else "it is in the usual class now"
    if _lent:
        _take_back()
    else:
        _put(_claimed, os.SCHED_OTHER, 0)
        _claimed.clear()
    _log.critical("a thread of the real-time class did not wait for %d s: %s", DEMOTED_S, told)
