"""A bell: tells that something is new to whoever waits for it, in whatever event loop it waits.

Rules of this file:

1. Who rings never waits and takes no lock: one call for each event loop with somebody in it, however many they are.
2. None is lost: who listens first and looks then has seen it, or is woken. What is new stands elsewhere, in order.
"""

from __future__ import annotations

import asyncio
import contextlib


class Bell:
    """Rung by the thread that changes something; listened to from any event loop."""

    def __init__(self) -> None:
        self._waiting: dict[asyncio.AbstractEventLoop, asyncio.Event] = {}

    def listen(self) -> asyncio.Event:
        """Return what the next ring sets; it belongs to the caller's event loop."""
        return self._waiting.setdefault(asyncio.get_running_loop(), asyncio.Event())

    def ring(self) -> None:
        """Wake everybody who listens."""
        if not self._waiting:
            return
        here = _loop_of_this_thread()
        while self._waiting:
            # taking out an entry and putting one in are single steps for other threads: a listener finds either this
            # event, which is about to be set, or makes a new one and looks afterwards
            loop, event = self._waiting.popitem()
            if loop is here:  # an event loop of virtual time takes no calls from elsewhere
                event.set()
            else:
                with contextlib.suppress(RuntimeError):  # closed: nobody waits there any more
                    loop.call_soon_threadsafe(event.set)


def _loop_of_this_thread() -> asyncio.AbstractEventLoop | None:
    try:
        return asyncio.get_running_loop()
    except RuntimeError:
        return None
