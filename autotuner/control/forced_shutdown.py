"""Forced shutdown: after a second request to end, no device is waited for; the next start does the remaining work.

Invariant: it holds for everything on an event loop and cannot be undone: that loop is about to end.
"""

from __future__ import annotations

import asyncio
from weakref import WeakKeyDictionary

_events: WeakKeyDictionary[asyncio.AbstractEventLoop, asyncio.Event] = WeakKeyDictionary()


def forced_shutdown() -> asyncio.Event:
    """Return the event that is set when the running event loop must not wait for a device any more."""
    return _events.setdefault(asyncio.get_running_loop(), asyncio.Event())


def wait_no_more() -> None:
    """End the waiting of everything on the running event loop for devices that have not answered."""
    forced_shutdown().set()
