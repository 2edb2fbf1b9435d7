"""Lines that several loops share: units on one RS-485 line, channels of one board, loops of one PLC.

Invariants:

1. The first loop that needs a line opens it, and the last loop closes it; all of them must request the same settings.
2. Lines are shared within one event loop. Another program, or another process of this one, finds a serial port in use.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar
from weakref import WeakKeyDictionary

from autotuner.errors import LinkError

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Mapping


class Line(Protocol):
    """A line and its users.

    Attributes
    ----------
    users : dict
        Users that have joined, each with a callback.
    """

    users: dict[Any, Any]

    @property
    def shared(self) -> tuple[Hashable, object] | None:
        """The key of the line and the settings that all users request; None for a line that is not shared."""

    async def disconnect(self) -> None:
        """Close the line."""


def report_closed(users: Mapping[Any, Callable[[str], None] | None], reason: str) -> None:
    """Pass the reason why a device is gone to all users that have a callback for it."""
    for callback in list(users.values()):
        if callback is not None:
            callback(reason)


LineT = TypeVar("LineT", bound=Line)


class SharedLines(Generic[LineT]):
    """Open lines of one kind in each event loop, by their keys.

    Parameters
    ----------
    remedy : str
        Advice for a line that another loop has open with different settings.
    """

    def __init__(self, remedy: str) -> None:
        self._remedy = remedy
        self._open: WeakKeyDictionary[asyncio.AbstractEventLoop, dict[Hashable, LineT]] = WeakKeyDictionary()

    def join(self, user: object, own: LineT, callback: object) -> LineT:
        """Return the line that is open already, or `own`, and register the user.

        Raises
        ------
        LinkError
            Another loop has opened the line with different settings.
        """
        line = own
        if own.shared is not None:
            key, _ = own.shared
            line = self._open.setdefault(asyncio.get_running_loop(), {}).setdefault(key, own)
            if line.shared != own.shared:
                raise LinkError(f"{key} is open for another loop with other settings", remedy=self._remedy)
        line.users[user] = callback
        return line

    async def leave(self, user: object, line: LineT) -> None:
        """Take leave of a line; the last user closes it."""
        line.users.pop(user, None)
        if line.users:
            return
        open_lines = self._open.get(asyncio.get_running_loop(), {})
        for key in [key for key, other in open_lines.items() if other is line]:
            del open_lines[key]
        await line.disconnect()
