"""Serial ports shared by several loops: units on one RS-485 line, or the channels of one board.

Invariants:

1. The first loop that needs a port opens it, and the last loop closes it; all of them must request the same frame.
2. Ports are shared within one event loop. Another program, or another process of this one, finds the port in use.
"""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar
from weakref import WeakKeyDictionary

from autotuner.errors import LinkError


class Line(Protocol):
    """A line and its users.

    Attributes
    ----------
    users : dict
        Users that have joined, each with a callback.
    """

    users: dict[object, Any]

    @property
    def shared(self) -> tuple[str, object] | None:
        """The serial port and the frame that all users request; None for a line that is not shared."""

    async def disconnect(self) -> None:
        """Close the line."""


LineT = TypeVar("LineT", bound=Line)


class SharedPorts(Generic[LineT]):
    """Open lines of one kind in each event loop, by port.

    Parameters
    ----------
    remedy : str
        Advice for a port that another loop has open with a different frame.
    """

    def __init__(self, remedy: str) -> None:
        self._remedy = remedy
        self._ports: WeakKeyDictionary[asyncio.AbstractEventLoop, dict[Path, LineT]] = WeakKeyDictionary()

    def join(self, user: object, own: LineT, callback: object) -> LineT:
        """Return the line that is open on the port already, or `own`, and register the user.

        Raises
        ------
        LinkError
            Another loop has opened the port with a different frame.
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
        """Unregister a user; the last user closes the line."""
        line.users.pop(user, None)
        if line.users:
            return
        open_lines = self._ports.get(asyncio.get_running_loop(), {})
        for port in [port for port, other in open_lines.items() if other is line]:
            del open_lines[port]
        await line.disconnect()
