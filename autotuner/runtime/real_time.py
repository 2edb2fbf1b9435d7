"""The real-time class of the system's scheduler, for the one thread that keeps the deadlines of the loops.

Rules of this file:

1. What that thread starts, threads and worker processes, is not in the class.
2. A thread of this class that never waits takes its processor from everybody else. After `DEMOTED_S` without a wait
   it is put back into the usual class; where even that is impossible, the system ends the process after `ENDED_S`, and
   the next start gives its loops back.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from types import FrameType

DEMOTED_S, ENDED_S = 1, 3

_log = logging.getLogger(__name__)
_claimed: set[int] = set()
"""System's numbers of the threads that are in the class."""


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
    _claimed.add(threading.get_native_id())
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


def _demote(_number: int, _frame: FrameType | None) -> None:
    """Put all threads back into the usual class."""
    if sys.platform == "linux":
        while _claimed:
            os.sched_setscheduler(_claimed.pop(), os.SCHED_OTHER, os.sched_param(0))
    _log.critical("a thread of the real-time class did not wait for %d s: it is in the usual class now", DEMOTED_S)
