"""Several requests under way at once on one Modbus TCP connection, each tied to its answer by its transaction number.

The library sends one request after another. These are sent beside it, with numbers that it does not use, and their
answers are read from the same packets; the library skips answers whose number is not its own. (Modbus Messaging on
TCP/IP Implementation Guide V1.0b, 4.4.1.2: a server may take 1 to 16 transactions at once.)
"""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, Final

from pymodbus.exceptions import ModbusException
from pymodbus.framer import FramerSocket
from pymodbus.pdu import DecodePDU

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pymodbus.pdu import ModbusPDU

FRAMER: Final = FramerSocket(DecodePDU(is_server=False))
HEADER_BYTES: Final = 7
"""Transaction, protocol, length and unit, before the function code."""
LENGTH_END: Final = 6
"""The length counts the bytes from here on."""
NUMBERS: Final = range(65001, 65536)
"""Transaction numbers that the library does not use: its own go from 1 to 65000."""


class Overlap:
    """The requests that are under way at once."""

    def __init__(self) -> None:
        self._awaited: set[int] = set()
        self._answers: dict[int, tuple[ModbusPDU | None, float]] = {}
        self._ended = asyncio.Event()
        self._sent = 0

    async def answers(
        self, requests: Sequence[ModbusPDU], send: Callable[[bytes], object], lost: asyncio.Future[None], limit_s: float
    ) -> list[tuple[ModbusPDU | None, float]]:
        """Send requests and return their answers with the time of each; None where there is none, or a garbled one.

        Parameters
        ----------
        requests : sequence of ModbusPDU
            The requests.
        send : callable
            Puts bytes on the connection.
        lost : Future
            Done when the connection is lost, which ends the wait.
        limit_s : float
            Longest wait for all answers, s.
        """
        numbers = [NUMBERS[(self._sent + k) % len(NUMBERS)] for k in range(len(requests))]
        self._sent += len(requests)
        self._answers, self._awaited, self._ended = {}, set(numbers), asyncio.Event()
        for number, request in zip(numbers, requests, strict=True):
            request.transaction_id = number
        lost.add_done_callback(self._end)
        try:
            for request in requests:  # a segment each: some servers read no more than one request out of a segment
                send(FRAMER.buildFrame(request))
            async with asyncio.timeout(limit_s):
                await self._ended.wait()
        except TimeoutError:
            pass
        finally:
            lost.remove_done_callback(self._end)
            self._awaited = set()
        return [self._answers.get(number, (None, math.nan)) for number in numbers]

    def receive(self, packet: bytes) -> None:
        """Take the answers out of what the connection's buffer holds, which begins with a message."""
        while self._awaited and len(packet) > HEADER_BYTES and not any(packet[2:4]):
            size = LENGTH_END + int.from_bytes(packet[4:LENGTH_END], "big")
            if len(packet) < size:
                return
            number = int.from_bytes(packet[:2], "big")
            if number in self._awaited:
                self._awaited.remove(number)
                self._answers[number] = _decoded(packet[:size]), asyncio.get_running_loop().time()
            packet = packet[size:]
            if not self._awaited:
                self._ended.set()

    def _end(self, _: object) -> None:
        self._ended.set()


def _decoded(frame: bytes) -> ModbusPDU | None:
    try:
        return FRAMER.handleFrame(frame, 0, 0)[1]
    except ModbusException:
        return None
