"""Serial ports that several loops share: units on one RS-485 line, or the channels of one board.

Invariants:

1. A port is opened by the first loop that needs it and closed by the last; all of them ask for the same frame.
2. Ports are shared within one event loop. Another program, or another process of this one, finds the port in use.
"""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar
from weakref import WeakKeyDictionary

from autotuner.errors import LinkError


class Line(Protocol):
    """A line and those who use it.

    Attributes
    ----------
    users : dict
        The users that have joined, with a callback each.
    """

    users: dict[object, Any]

    @property
    def shared(self) -> tuple[str, object] | None:
        """The serial port, and the frame that all of its users ask for; None for a line of one loop alone."""

    async def disconnect(self) -> None:
        """Close the line."""


LineT = TypeVar("LineT", bound=Line)


class SharedPorts(Generic[LineT]):
    """The lines of one kind that are open in each event loop, by their ports.

    Parameters
    ----------
    remedy : str
        Advice where another loop has the port open with another frame.
    """

    def __init__(self, remedy: str) -> None:
        self._remedy = remedy
        self._ports: WeakKeyDictionary[asyncio.AbstractEventLoop, dict[Path, LineT]] = WeakKeyDictionary()

    def join(self, user: object, own: LineT, callback: object) -> LineT:
        """Return the line that is open on the port already, or the user's own, and note that the user has joined.

        Raises
        ------
        LinkError
            Another loop has opened the port with another frame.
        """
        line = own
        if own.shared is not None:
            port, _ = own.shared
            open_lines = self._ports.setdefault(asyncio.get_running_loop(), {})
            line = open_lines.setdefault(Path(port).resolve(), own)
            if line.shared != own.shared:
                raise LinkError(f"{port} is open for another loop with other settings", remedy=self._remedy)
        line.users[user] = callback
        return line

    async def leave(self, user: object, line: LineT) -> None:
        """Take leave of a line; the last user closes it."""
        line.users.pop(user, None)
        if line.users:
            return
        open_lines = self._ports.get(asyncio.get_running_loop(), {})
        for port in [port for port, other in open_lines.items() if other is line]:
            del open_lines[port]
        await line.disconnect()
