"""A line that is open: whose turn it is, its connection, and what it owes.

Units on one serial line share it, as RS-485 does: one port, one request at a time, each unit in its turn. Units that
are reached over TCP have a connection each.

Rules of this file:

1. A port is opened by the first that needs it and closed by the last; all of them ask for the same frame.
2. Lines are shared within one event loop. Another program, or another process of this one, finds the port in use.
"""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Final
from weakref import WeakKeyDictionary

from autotuner.errors import LinkError
from autotuner_drivers.modbus.connection import ModbusConnection
from autotuner_drivers.modbus.line_watch import LineWatch
from autotuner_drivers.modbus.lines import RtuLine

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
        self.connection.gone = self._tell
        self.users: dict[object, Callable[[str], None] | None] = {}
        self._readable = readable

    def _tell(self, reason: str) -> None:
        for gone in list(self.users.values()):
            if gone is not None:
                gone(reason)

    def _on_packet(self, sending: bool, packet: bytes) -> bytes:  # noqa: FBT001 - the library's signature
        if self.watch is None:
            return packet if sending else self._readable(packet)
        now_s = asyncio.get_running_loop().time()
        if not sending:
            return self.watch.heard(packet, now_s)
        self.watch.sent(packet, now_s)
        return packet


_ports: WeakKeyDictionary[asyncio.AbstractEventLoop, dict[Path, OpenLine]] = WeakKeyDictionary()
"""The serial lines that are open in each event loop, by their ports."""


def join(user: object, own: OpenLine, gone: Callable[[str], None] | None) -> OpenLine:
    """Return the line that is open on the port already, or the user's own, and note that the user has joined.

    Raises
    ------
    LinkError
        Another loop has opened the port with another frame.
    """
    line = own
    if isinstance(own.line, RtuLine):
        open_lines = _ports.setdefault(asyncio.get_running_loop(), {})
        line = open_lines.setdefault(Path(own.line.serial.port).resolve(), own)
        if line.line != own.line:
            raise LinkError(
                f"{own.line.label} is open for another loop with other settings",
                remedy="Give all loops on one serial line the same baudrate, parity, stopbits, echo and times.",
            )
    line.users[user] = gone
    return line


async def leave(user: object, line: OpenLine) -> None:
    """Take leave of a line; the last one closes it."""
    line.users.pop(user, None)
    if line.users:
        return
    open_lines = _ports.get(asyncio.get_running_loop(), {})
    for port in [port for port, other in open_lines.items() if other is line]:
        del open_lines[port]
    await line.connection.close()
