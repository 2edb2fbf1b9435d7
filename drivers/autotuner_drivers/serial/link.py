"""One serial line of commands and answers: exchanges, time limits, what is late, reconnecting.

Invariants:

1. Every call ends within its time limit, with a value, a `DriverError` whose cause is chained, or its cancellation.
2. After an exchange whose answer did not come, the line owes one: until it has come and gone, or until it is not
   believed to come any more, nothing is sent, and what arrives is dropped.
3. A message that is no answer to the command (an unasked line) is passed over; silence after it ends the wait.
4. On a line that sends back what is sent (`Timing.echo`), the answer begins after that.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque
from dataclasses import dataclass
from statistics import median
from typing import TYPE_CHECKING, Final, Protocol, TypeVar

from autotuner.errors import DeviceTimeoutError, LinkError
from autotuner_drivers.links import REPEAT, Backoff, GarbledAnswerError, link_error, put_off

if TYPE_CHECKING:
    from collections.abc import Awaitable

    from autotuner_drivers.serial.protocol import Exchange, Split

T = TypeVar("T")
SHORTEST_WAIT_S: Final = 0.001
"""Shortest wait for bytes or for silence, s: one of 0 would spin."""
REMEMBERED: Final = 64
"""Answers whose times are remembered."""


class Port(Protocol):
    """A serial port: `SerialThread`, or a stand-in."""

    async def open(self) -> None:
        """Open the port; raise `OSError` when it cannot be had."""

    async def write(self, message: bytes) -> None:
        """Send bytes."""

    async def read(self, wait_s: float) -> bytes:
        """Return what has arrived, waiting for it for at most `wait_s`; perhaps nothing, perhaps earlier."""

    async def clear(self) -> None:
        """Forget what has arrived."""

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
        After that, an answer is believed to come for so long.
    gap_s : float
        Silence that ends a message.
    pause_s : float
        Silence that the device needs between two commands.
    echo : bool
        Whether what is sent is heard again, before any answer.
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
        Cuts what has arrived into whole messages and a rest.

    Attributes
    ----------
    moment_s : float
        Time of the last exchange that succeeded, the middle between command and answer, on the event loop's clock, s.
    """

    def __init__(self, port: Port, label: str, timing: Timing, split: Split) -> None:
        self._port, self._label, self._timing, self._split = port, label, timing, split
        self._backoff = Backoff()
        self._owed_until_s: float | None = None
        self._ready_s = 0.0
        self._took_s: deque[float] = deque(maxlen=REMEMBERED)
        self.moment_s = math.nan
        self.connected = False

    @property
    def latency_s(self) -> float:
        """Median time from a command to its answer, of the last ones, s; 0 before the first."""
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
        self._owed_until_s, self.connected = None, True

    async def settle(self, silence_s: float) -> None:
        """Wait for a device that was reset by the opening of its port, and drop what it sends meanwhile."""
        await asyncio.sleep(silence_s)
        await self._guarded(self._port.clear())

    async def exchange(self, exchange: Exchange) -> float:
        """Send a command and return the value of its answer; 0 when it has none."""
        await self._line_free()
        loop = asyncio.get_running_loop()
        await self._guarded(self._port.clear())
        await self._guarded(self._port.write(exchange.request))
        if exchange.meaning is None:
            self.moment_s = loop.time()
            self._ready_s = self.moment_s + self._timing.pause_s
            return 0.0
        sent_s = loop.time()
        self._owed_until_s = sent_s + self._timing.timeout_s + self._timing.late_answer_s
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
        """Return the value of the first message that is an answer."""
        loop = asyncio.get_running_loop()
        buffer, heard, heard_s = b"", b"", loop.time()
        echo = exchange.request if self._timing.echo else b""
        while (now_s := loop.time()) < deadline_s and not (heard and now_s >= heard_s + self._timing.gap_s):
            piece = await self._guarded(self._port.read(max(deadline_s - now_s, SHORTEST_WAIT_S)))
            piece, echo = _behind(echo, piece)
            if not piece:
                continue
            heard, heard_s = heard + piece, loop.time()
            messages, buffer = self._split(buffer + piece)
            for message in messages:
                if (value := self._meaning(exchange, message)) is not None:
                    return value
        if heard and not buffer:
            self._note_answer()
        raise self._failure(heard)

    def _meaning(self, exchange: Exchange, message: bytes) -> float | None:
        assert exchange.meaning is not None  # noqa: S101 - narrows the type: such a command waits for no answer
        try:
            return exchange.meaning(message)
        except Exception:
            self._note_answer()
            raise

    def _failure(self, heard: bytes) -> LinkError:
        if heard:
            return GarbledAnswerError(f"{self._label} answered {heard[:60]!r}, which makes no sense", remedy=REPEAT)
        return DeviceTimeoutError(
            f"{self._label} did not answer within {self._timing.timeout_s:g} s",
            remedy="Check the line, baud rate and parity, the protocol and the device's address, or raise timeout_s.",
        )

    def _note_answer(self) -> None:
        self._owed_until_s = None
        self._ready_s = asyncio.get_running_loop().time() + self._timing.pause_s

    async def _line_free(self) -> None:
        """Wait until the line owes no answer, and the device has had its pause."""
        loop = asyncio.get_running_loop()
        heard_s = None
        while self._owed_until_s is not None and loop.time() < self._owed_until_s:
            if heard_s is not None and loop.time() >= heard_s + self._timing.gap_s:
                break
            if await self._guarded(self._port.read(self._timing.gap_s)):
                heard_s = loop.time()
        self._owed_until_s = None
        wait_s = self._ready_s - loop.time()
        if wait_s > 0.0:
            await asyncio.sleep(max(wait_s, SHORTEST_WAIT_S))

    async def _guarded(self, call: Awaitable[T]) -> T:
        """Return what a call of the port returns; when it fails, close the port and raise the error that it means."""
        try:
            return await call
        except Exception as error:
            await self.disconnect()
            raise link_error(error, self._label, self._timing.timeout_s) from error


def _behind(echo: bytes, piece: bytes) -> tuple[bytes, bytes]:
    """Return the part of a piece after the echo, and the rest of the echo that is to come; none where it differs."""
    size = min(len(echo), len(piece))
    return (piece[size:], echo[size:]) if piece[:size] == echo[:size] else (piece, b"")
