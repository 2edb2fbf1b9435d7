"""A line that is open: whose turn it is, its connection, and what it owes.

Units on one serial line share it, as RS-485 does: one port, one request at a time, each unit in its turn. Units that
are reached over TCP have a connection each, which the loops of one unit share (`ModbusLink`).
"""

from __future__ import annotations

import asyncio
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from autotuner_drivers.modbus.connection import ModbusConnection
from autotuner_drivers.modbus.line_watch import LineWatch
from autotuner_drivers.modbus.lines import RtuLine
from autotuner_drivers.shared_lines import SharedLines, report_closed

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner_drivers.modbus.lines import Line

SILENT_REQUESTS: Final = 2
"""After so many requests without an answer in a row, the next one closes the connection and a new one is made."""


class OpenLine:
    """A line and those who use it.

    Parameters
    ----------
    line : Line
        The line.
    device : str
        The name of what is reached over it, for messages.
    timeout_s : float
        Longest wait for a connection, s.
    readable : callable
        Returns what the library can decode of a packet that was received over a line without a watch.

    Attributes
    ----------
    turn : asyncio.Lock
        Held by the user of the line.
    watch : LineWatch, optional
        What the line owes; None where answers carry a number.
    connection : ModbusConnection
        The connection.
    users : dict
        The users that have joined, and their callbacks for a device that is gone.
    """

    def __init__(self, line: Line, device: str, timeout_s: float, readable: Callable[[bytes], bytes]) -> None:
        self.line = line
        self.turn = asyncio.Lock()
        self.watch = LineWatch(line.watch) if line.watch else None
        self.connection = ModbusConnection(line, device, timeout_s, SILENT_REQUESTS - 1, self._on_packet, self.turn)
        self.users: dict[object, Callable[[str], None] | None] = {}
        self.connection.gone = partial(report_closed, self.users)
        self._readable = readable

    @property
    def shared(self) -> tuple[Path, object] | None:
        """The serial port and the line's settings; None for a line that is no serial one."""
        return (Path(self.line.serial.port).resolve(), self.line) if isinstance(self.line, RtuLine) else None

    async def disconnect(self) -> None:
        """Close the connection."""
        await self.connection.close()

    def _on_packet(self, sending: bool, packet: bytes) -> bytes:  # noqa: FBT001 - the library's signature
        if self.watch is None:
            return packet if sending else self._readable(packet)
        now_s = asyncio.get_running_loop().time()
        if not sending:
            return self.watch.received(packet, now_s)
        self.watch.sent(packet, now_s)
        return packet


PORTS: Final[SharedLines[OpenLine]] = SharedLines(
    "Give all loops on one serial line the same baudrate, parity, stopbits, echo and times."
)
"""The serial lines that are open."""
