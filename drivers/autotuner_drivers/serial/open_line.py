"""A serial line that is open: whose turn it is, and which loops use it.

The two channels of one board are two loops on one port: one command at a time, each loop in its turn.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from autotuner_drivers.shared_ports import SharedPorts

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
        How often the line was connected: after each, the protocol has to be entered again.
    users : dict
        Those who have joined, and what to call when the device may have lost what they have set.
    """

    def __init__(self, link: SerialLink, frame: Frame | None = None) -> None:
        self.link, self.frame = link, frame
        self.turn = asyncio.Lock()
        self.connections = 0
        self.users: dict[object, Callable[[], None]] = {}

    @property
    def shared(self) -> tuple[str, object] | None:
        """The port and the frame; None where one loop has the line to itself."""
        return None if self.frame is None else (self.frame.serial.port, self.frame)

    async def disconnect(self) -> None:
        """Close the port."""
        await self.link.disconnect()

    def doubt(self) -> None:
        """Report to all users that the device may have lost their settings."""
        for doubtful in self.users.values():
            doubtful()


PORTS: Final[SharedPorts[OpenLine]] = SharedPorts(
    "Give all loops on one serial port the same protocol, baudrate, parity, stopbits, echo and times."
)
"""The lines that are open."""
