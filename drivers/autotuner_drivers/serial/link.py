"""A serial line of commands and answers: exchanges, time limits, late answers, reconnection.

Invariants:

1. Every call ends within its time limit, with a value, a `DriverError` whose cause is chained, or its cancellation.
2. After a missing answer, the line is reserved: nothing is sent and input is dropped until the answer has arrived or
`late_answer_s` has passed.
3. A message that does not answer the command (an unsolicited line) is skipped; silence after it ends the wait.
4. On a line with an echo (`Timing.echo`), the answer begins after the echo.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque
from dataclasses import dataclass
from statistics import median
from typing import TYPE_CHECKING, Protocol, TypeVar

from autotuner.errors import DeviceTimeoutError, LinkError
from autotuner_drivers.links import (
    REMEMBERED,
    REPEAT,
    SHORTEST_WAIT_S,
    Backoff,
    GarbledAnswerError,
    link_error,
    put_off,
)

if TYPE_CHECKING:
    from collections.abc import Awaitable

    from autotuner_drivers.serial.protocol import Exchange, Split

T = TypeVar("T")


class Port(Protocol):
    """A serial port: `SerialThread`, or a stand-in."""

    async def open(self) -> None:
        """Open the port; raise `OSError` on failure."""

    async def write(self, message: bytes) -> None:
        """Send bytes."""

    async def read(self, wait_s: float) -> bytes:
        """Return the bytes that arrive within `wait_s`; may return early, with any number of bytes."""

    async def clear(self) -> None:
        """Discard the bytes that have arrived."""

    async def close(self) -> None:
        """Close the port; never raises."""


@dataclass(frozen=True, slots=True)
class Timing:
    """Timing of a line, s.

    Attributes
    ----------
    timeout_s : float
        Longest wait for an answer.
    late_answer_s : float
        How long after the time limit a late answer is awaited.
    gap_s : float
        Silence that ends a message.
    pause_s : float
        Silence that the device needs between two commands.
    echo : bool
        Whether sent bytes are received again, before any answer.
    """

    timeout_s: float
    late_answer_s: float
    gap_s: float
    pause_s: float
    echo: bool = False


class SerialLink:
    """A line to one device.

    Parameters
    ----------
    port : Port
        The port.
    label : str
        The device's address, for messages.
    timing : Timing
        Time limits and silences.
    split : callable
        Splits received bytes into complete messages and a remainder.

    Attributes
    ----------
    moment_s : float
        Time of the last successful exchange, the middle between command and answer, on the event loop's clock, s.
    """

    def __init__(self, port: Port, label: str, timing: Timing, split: Split) -> None:
        self._port, self._label, self._timing, self._split = port, label, timing, split
        self._backoff = Backoff()
        self._late_answer_until_s: float | None = None
        self._ready_s = 0.0
        self._took_s: deque[float] = deque(maxlen=REMEMBERED)
        self.moment_s = math.nan
        self.connected = False

    @property
    def latency_s(self) -> float:
        """Median time from a command to its answer, s; 0 before the first."""
        return median(self._took_s) if self._took_s else 0.0

    async def connect(self, *, at_once: bool = False) -> None:
        """Open the port; fail at once while the pause after a failed attempt lasts, unless `at_once`."""
        loop = asyncio.get_running_loop()
        wait_s = 0.0 if at_once else self._backoff.wait_s(loop.time())
        if wait_s > 0.0:
            reason = self._backoff.reason
            raise put_off(link_error(reason, self._label, self._timing.timeout_s), wait_s) from reason
        try:
            await self._port.open()
        except Exception as error:
            self._backoff.failed(loop.time(), error)
            raise link_error(error, self._label, self._timing.timeout_s) from error
        self._backoff.succeeded()
        self._late_answer_until_s, self.connected = None, True

    async def settle(self, silence_s: float) -> None:
        """Wait for a device that the opening of its port has reset, and discard its output meanwhile."""
        await asyncio.sleep(silence_s)
        await self._guarded(self._port.clear())

    async def exchange(self, exchange: Exchange) -> float:
        """Send a command and return the value of its answer; 0 for a command without an answer."""
        await self._line_free()
        loop = asyncio.get_running_loop()
        await self._guarded(self._port.clear())
        await self._guarded(self._port.write(exchange.request))
        if exchange.meaning is None:
            self.moment_s = loop.time()
            self._ready_s = self.moment_s + self._timing.pause_s
            return 0.0
        sent_s = loop.time()
        self._late_answer_until_s = sent_s + self._timing.timeout_s + self._timing.late_answer_s
        value = await self._answer(exchange, sent_s + self._timing.timeout_s)
        self._note_answer()
        answered_s = loop.time()
        self._took_s.append(answered_s - sent_s)
        self.moment_s = (sent_s + answered_s) / 2.0
        return value

    async def disconnect(self) -> None:
        """Close the port."""
        self.connected = False
        await self._port.close()

    async def _answer(self, exchange: Exchange, deadline_s: float) -> float:
        """Return the value of the first message that answers the command."""
        loop = asyncio.get_running_loop()
        buffer, received, received_s = b"", b"", loop.time()
        echo = exchange.request if self._timing.echo else b""
        while (now_s := loop.time()) < deadline_s and not (received and now_s >= received_s + self._timing.gap_s):
            piece = await self._guarded(self._port.read(max(deadline_s - now_s, SHORTEST_WAIT_S)))
            piece, echo = _without_echo(echo, piece)
            if not piece:
                continue
            received, received_s = received + piece, loop.time()
            messages, buffer = self._split(buffer + piece)
            for message in messages:
                if (value := self._meaning(exchange, message)) is not None:
                    return value
        if received and not buffer:
            self._note_answer()
        raise self._failure(received)

    def _meaning(self, exchange: Exchange, message: bytes) -> float | None:
        assert exchange.meaning is not None  # noqa: S101 - narrows the type: such a command waits for no answer
        try:
            return exchange.meaning(message)
        except Exception:
            self._note_answer()
            raise

    def _failure(self, received: bytes) -> LinkError:
        if received:
            return GarbledAnswerError(f"{self._label} sent {received[:60]!r} instead of an answer", remedy=REPEAT)
        return DeviceTimeoutError(
            f"{self._label} did not answer within {self._timing.timeout_s:g} s",
            remedy="Check the line, baud rate and parity, the protocol and the device's address, or raise timeout_s.",
        )

    def _note_answer(self) -> None:
        self._late_answer_until_s = None
        self._ready_s = asyncio.get_running_loop().time() + self._timing.pause_s

    async def _line_free(self) -> None:
        """Wait until no late answer is due and the device has had its pause."""
        loop = asyncio.get_running_loop()
        received_at_s = None
        while self._late_answer_until_s is not None and loop.time() < self._late_answer_until_s:
            if received_at_s is not None and loop.time() >= received_at_s + self._timing.gap_s:
                break
            if await self._guarded(self._port.read(self._timing.gap_s)):
                received_at_s = loop.time()
        self._late_answer_until_s = None
        wait_s = self._ready_s - loop.time()
        if wait_s > 0.0:
            await asyncio.sleep(max(wait_s, SHORTEST_WAIT_S))

    async def _guarded(self, call: Awaitable[T]) -> T:
        """Await a call of the port; on failure close the port and raise the matching error."""
        try:
            return await call
        except Exception as error:
            await self.disconnect()
            raise link_error(error, self._label, self._timing.timeout_s) from error


def _without_echo(echo: bytes, piece: bytes) -> tuple[bytes, bytes]:
    """Strip the echo from a piece; return the rest of the piece and of the expected echo."""
    size = min(len(echo), len(piece))
    return (piece[size:], echo[size:]) if piece[:size] == echo[:size] else (piece, b"")
