"""Turns at the interpreter's lock: what can wait begins where the thread of the loops will not want it soon.

    asked - ROOM_S <= now    wait until due + WORK_S, and look again

`asked` is when that thread wakes for its next deadline, `due` that deadline. A thread that is in the middle of
something when it wakes has to be asked for the lock, which takes the interpreter `ASKED_S` and the system two changes
of threads: more than the lead, now and then. A request takes some hundred microseconds in one piece, so most of them
never meet a deadline if they begin in time.

Rules of this file:

1. It is a courtesy, not a lock: whoever gives way does so for `LONGEST_S` at most, and the thread of the loops never
   waits for anybody.
2. Numbers are written by the one thread and read by the others, each in one step; a look that is out of date costs one
   meeting.
3. Whoever gives way sleeps a thread, which is never that of the loops: nothing here is for code in virtual time.
"""

from __future__ import annotations

import asyncio
import math
import selectors
import sys
import time
from typing import TYPE_CHECKING

from autotuner.control.clock.ticker import clock

if TYPE_CHECKING:
    from collections.abc import Callable

ROOM_S = 100e-6
"""What is begun shall have at least so much time before the lock is wanted."""
WORK_S = 150e-6
"""From a deadline to the end of the work that it stands for, usually."""
AGAIN_S = 60e-6
"""Time between two looks at a thread that is at work."""
LONGEST_S = 1.2e-3
"""Longest time for which anybody gives way."""


class Turns:
    """When the thread of the loops wants the lock."""

    __slots__ = ("_asked_s", "_due_s")

    def __init__(self) -> None:
        self._asked_s = self._due_s = math.inf

    def wanted(self, asked_s: float, due_s: float) -> None:
        """Take note that it waits until `asked_s` for what is due at `due_s`, s on the clock."""
        self._asked_s, self._due_s = asked_s, due_s

    def at_work(self) -> None:
        """Take note that it has woken."""
        self._asked_s = -math.inf

    def free(self) -> None:
        """Take note that it waits for nothing that is due."""
        self._asked_s = math.inf

    def give_way(self, sleep: Callable[[float], object] = time.sleep) -> None:  # noqa: TID251 - rule 3
        """Wait until what takes `ROOM_S` may begin, `LONGEST_S` at most; to be called in other threads."""
        begun_s = now_s = clock()
        while self._asked_s - now_s < ROOM_S and now_s - begun_s < LONGEST_S:
            over_s = self._due_s + WORK_S - now_s
            sleep(over_s if 0.0 < over_s < LONGEST_S else AGAIN_S)
            now_s = clock()


def courteous_event_loop(turns: Turns) -> asyncio.AbstractEventLoop:
    """Return a new event loop that gives way before each round of what has become ready."""
    if sys.platform == "win32":  # whose event loop has no selector, and the loops there no turns
        return asyncio.new_event_loop()
    return asyncio.SelectorEventLoop(_Courteous(turns))


class _Courteous(selectors.DefaultSelector):
    def __init__(self, turns: Turns) -> None:
        super().__init__()
        self._turns = turns

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Return what is ready, when its turn has come."""
        ready = super().select(timeout)
        self._turns.give_way()
        return ready
