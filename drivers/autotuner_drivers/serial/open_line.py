"""An open serial line, its lock and its users.

The two channels of one board are two loops on one port: one command at a time.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from autotuner_drivers.shared_lines import SharedLines

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner_drivers.serial.link import SerialLink, Timing
    from autotuner_drivers.serial.port import SerialSettings


@dataclass(frozen=True, slots=True)
class Frame:
    """Settings that all loops on one line share: the port and its frame, the protocol, the timing."""

    serial: SerialSettings
    protocol: str
    timing: Timing


class OpenLine:
    """A line and its users.

    Parameters
    ----------
    link : SerialLink
        The line.
    frame : Frame, optional
        Settings that all users must request; None for a line that is not shared.

    Attributes
    ----------
    turn : asyncio.Lock
        Held by the present user of the line.
    connections : int
        Number of connections so far; the protocol is entered again after each.
    users : dict
        Callbacks by user, called when the device may have lost its settings.
    """

    def __init__(self, link: SerialLink, frame: Frame | None = None) -> None:
        self.link, self.frame = link, frame
        self.turn = asyncio.Lock()
        self.connections = 0
        self.users: dict[object, Callable[[], None]] = {}

    @property
    def shared(self) -> tuple[Path, object] | None:
        """The port and the frame; None for a line that is not shared."""
        return None if self.frame is None else (Path(self.frame.serial.port).resolve(), self.frame)

    async def disconnect(self) -> None:
        """Close the port."""
        await self.link.disconnect()

    def doubt(self) -> None:
        """Notify all users that the device may have lost its settings."""
        for notify in self.users.values():
            notify()


PORTS: Final[SharedLines[OpenLine]] = SharedLines(
    "Give all loops on one serial port the same protocol, baudrate, parity, stopbits, echo and times."
)
"""The lines that are open."""
