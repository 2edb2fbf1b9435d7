"""A serial line that is open: whose turn it is, and which loops use it.

The two channels of one board are two loops on one port: one command at a time, each loop in its turn.

Rules of this file:

1. A port is opened by the first loop that needs it and closed by the last; all of them ask for the same frame.
2. Lines are shared within one event loop. Another program, or another process of this one, finds the port in use.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final
from weakref import WeakKeyDictionary

from autotuner.errors import LinkError

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner_drivers.serial.link import SerialLink, Timing
    from autotuner_drivers.serial.port import SerialSettings


@dataclass(frozen=True, slots=True)
class Frame:
    """What all loops on one line have in common: the port and its frame, the protocol, the timing."""

    serial: SerialSettings
    protocol: str
    timing: Timing


class OpenLine:
    """A line and those who use it.

    Parameters
    ----------
    link : SerialLink
        The line.
    frame : Frame, optional
        What others who share it must ask for too; None: it is not shared.

    Attributes
    ----------
    turn : asyncio.Lock
        Held by the user of the line.
    connections : int
        How often the line was connected: after each, the device has to be met again.
    users : dict
        Those who have joined, and what to call when the device may have lost what they have set.
    """

    def __init__(self, link: SerialLink, frame: Frame | None = None) -> None:
        self.link, self.frame = link, frame
        self.turn = asyncio.Lock()
        self.connections = 0
        self.users: dict[object, Callable[[], None]] = {}

    def doubt(self) -> None:
        """Report to all users that the device may have lost their settings."""
        for doubtful in self.users.values():
            doubtful()


_ports: Final[WeakKeyDictionary[asyncio.AbstractEventLoop, dict[Path, OpenLine]]] = WeakKeyDictionary()
"""The lines that are open in each event loop, by their ports."""


def join(user: object, own: OpenLine, doubtful: Callable[[], None]) -> OpenLine:
    """Return the line that is open on the port already, or the user's own, and note that the user has joined.

    Raises
    ------
    LinkError
        Another loop has opened the port with another frame.
    """
    line = own
    if own.frame is not None:
        open_lines = _ports.setdefault(asyncio.get_running_loop(), {})
        line = open_lines.setdefault(Path(own.frame.serial.port).resolve(), own)
        if line.frame != own.frame:
            raise LinkError(
                f"{own.frame.serial.port} is open for another loop with other settings",
                remedy="Give all loops on one serial port the same protocol, baudrate, parity, stopbits, echo and "
                "times.",
            )
    line.users[user] = doubtful
    return line


async def leave(user: object, line: OpenLine) -> None:
    """Take leave of a line; the last one closes it."""
    line.users.pop(user, None)
    if line.users:
        return
    open_lines = _ports.get(asyncio.get_running_loop(), {})
    for port in [port for port, other in open_lines.items() if other is line]:
        del open_lines[port]
    await line.link.disconnect()
