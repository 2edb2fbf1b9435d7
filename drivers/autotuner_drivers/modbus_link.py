"""Requests and answers over one Modbus connection, and their time limits.

Rules of this file:

1. Every call ends within its time limit, with an answer, a `DriverError` whose cause is chained, or its cancellation.
2. A connection that is lost fails the request under way at once; `ModbusConnection` makes it again.
3. An answer is accepted only when it has the shape that was asked for. Over TCP the transaction identifier also ties
   it to its request; on a line without one, `LineWatch` keeps a late answer from the next request.
4. A request that got no answer is repeated `retries` times by this file, never by the library underneath, which would
   repeat it while the first answer may still be on its way.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections import deque
from dataclasses import dataclass
from statistics import median
from typing import TYPE_CHECKING, Any, Final

from pymodbus.exceptions import ModbusException

from autotuner.errors import DeviceTimeoutError
from autotuner_drivers.line_watch import LineWatch
from autotuner_drivers.link_errors import REPEAT, GarbledAnswerError
from autotuner_drivers.modbus_connection import ModbusConnection
from autotuner_drivers.modbus_errors import driver_error, refusal
from autotuner_drivers.modbus_exchange import QuickClient

if TYPE_CHECKING:
    from collections.abc import Callable

    from pymodbus.client.base import ModbusBaseClient
    from pymodbus.pdu import ModbusPDU

    from autotuner_drivers.modbus_exchange import Exchange
    from autotuner_drivers.modbus_lines import Line
    from autotuner_drivers.modbus_requests import Request

# The library's lines repeat what the errors of this file say, with the bytes of the last twenty packets: they go
# neither to stderr nor into the log of the service, where every line is an event.
_library = logging.getLogger("pymodbus.logging")
_library.addHandler(logging.NullHandler())
_library.propagate = False

SILENT_REQUESTS: Final = 2
"""After so many requests without an answer in a row, the next one closes the connection and a new one is made."""

REPEATED: Final = (DeviceTimeoutError, GarbledAnswerError)
"""After these a request is repeated."""

SHORTEST_WAIT_S: Final = 0.001
REMEMBERED: Final = 64
"""Answers whose times are remembered."""


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """Which unit is asked, how long an answer may take (s), and how often a request is repeated without one."""

    unit: int
    timeout_s: float
    retries: int


class ModbusLink:
    """A connection to one unit.

    Parameters
    ----------
    line : Line
        The line.
    settings : LinkSettings
        Unit, time limit and repetitions.

    Attributes
    ----------
    moment_s : float
        Time, on the event loop's clock, at which the device did what was asked of it last: the middle between request
        and answer, s. A write whose answer came damaged was done then, not when it was repeated.
    repeated : int
        How many requests were repeated.
    """

    def __init__(self, line: Line, settings: LinkSettings) -> None:
        self._unit, self._timeout_s, self._retries = settings.unit, settings.timeout_s, settings.retries
        self._device = f"{line.label} unit {settings.unit}"
        self._watch = LineWatch(line.watch) if line.watch else None
        self._turn = asyncio.Lock()
        self._connection = ModbusConnection(
            line, self._device, settings.timeout_s, SILENT_REQUESTS - 1, self._on_packet, self._turn
        )
        self._exchange: Exchange | None = None  # over which the device has answered
        self._took_s: deque[float] = deque(maxlen=REMEMBERED)
        self._sent_s = math.nan
        self.moment_s = math.nan
        self.repeated = 0

    async def open(self) -> None:
        """Connect now, without regard to an earlier failure; nothing when connected."""
        async with self._turn:
            await self._connection.open()

    async def close(self) -> None:
        """Disconnect; a request under way fails."""
        await self._connection.close()

    @property
    def connected(self) -> bool:
        """Whether there is a connection, as far as is known."""
        return self._connection.up

    def watch(self, gone: Callable[[str], None] | None) -> None:
        """Call `gone` with the reason as soon as the device has closed the connection and takes no new one."""
        self._connection.gone = gone

    @property
    def latency_s(self) -> float:
        """Median time from a request to its answer, of the last ones, s; 0 before the first."""
        return median(self._took_s) if self._took_s else 0.0

    async def ask(self, request: Request) -> tuple[int, ...]:
        """Return the words, or the bits, of the answer to a request."""
        await self._turn.acquire()  # half the cost of `async with`
        try:
            exchange, retries = self._exchange, self._retries
            if exchange is not None and exchange.transport is not None:  # what many loops do many times a second
                try:
                    return await self._over(exchange, request)
                except REPEATED:
                    if retries == 0:
                        raise
                    self.repeated += 1
                retries -= 1
            return await self._repeated(request, retries)
        finally:
            self._turn.release()

    async def _repeated(self, request: Request, retries: int) -> tuple[int, ...]:
        written_s = math.inf
        for _ in range(retries):
            try:
                answer = await self._once(request)
                break
            except REPEATED:
                self.repeated += 1
                if request.words and self._watch and self._watch.answering:
                    written_s = min(written_s, self._sent_s + self.latency_s / 2.0)
        else:
            answer = await self._once(request)
        self.moment_s = min(self.moment_s, written_s)
        return answer

    async def _once(self, request: Request) -> tuple[int, ...]:
        client = self._connection.current or await self._connection.client()
        if isinstance(client, QuickClient):
            words = await self._over(client.exchange, request)
            self._exchange = client.exchange
        else:
            words = await self._by_library(client, request)
        self._note_answer()
        return words

    async def _over(self, exchange: Exchange, request: Request) -> tuple[int, ...]:
        sent_s = exchange.loop.time()
        try:
            answer = await exchange.ask(request, self._unit, sent_s)
        except (ModbusException, OSError) as error:
            raise driver_error(error, self._device, self._timeout_s) from error
        words = answer if isinstance(answer, tuple) else self._checked(request, answer)
        self._timed(sent_s, exchange.loop.time())
        return words

    async def _by_library(self, client: ModbusBaseClient, request: Request) -> tuple[int, ...]:
        if self._watch is not None:
            await self._settled(self._watch, request.rtu_answer_size)
        clock = asyncio.get_running_loop().time
        sent_s = self._sent_s = clock()
        try:
            answer = await self._answered(client, request)
        except (ModbusException, OSError) as error:
            raise driver_error(error, self._device, self._timeout_s) from error
        words = self._checked(request, answer)
        self._timed(sent_s, clock())
        return words

    def _timed(self, sent_s: float, answered_s: float) -> None:
        """Take note of when the device did what was asked."""
        self._took_s.append(answered_s - sent_s)
        self.moment_s = (sent_s + answered_s) / 2.0

    def _checked(self, request: Request, answer: ModbusPDU) -> tuple[int, ...]:
        """Return the words of an answer; raise when it is a refusal, or not an answer to this request."""
        if answer.isError():
            self._note_answer()
            raise refusal(answer.exception_code, self._device)
        if mismatch := request.mismatch(answer):
            raise GarbledAnswerError(f"{self._device} {mismatch}", remedy=REPEAT)
        return request.words_of(answer)

    async def _settled(self, watch: LineWatch, expected: int) -> None:
        """Wait until the line owes no answer, or none is believed to come any more."""
        loop = asyncio.get_running_loop()
        while True:
            wait_s = watch.ready_s() - loop.time()
            if wait_s <= 0.0:
                break
            await asyncio.sleep(max(min(wait_s, watch.settings.gap_s), SHORTEST_WAIT_S))
        watch.expect(expected)

    async def _answered(self, client: ModbusBaseClient, request: Request) -> ModbusPDU:
        """Return the answer, or fail as soon as there cannot be one: connection lost, or garbled."""
        lost = self._connection.lost
        assert lost is not None  # noqa: S101 - narrows the type: set by every connect
        message = request.pdu(self._unit)
        waiting: asyncio.Future[ModbusPDU] = asyncio.ensure_future(client.execute(False, message))  # noqa: FBT003
        either: tuple[asyncio.Future[Any], ...] = (waiting, lost)
        look_s = self._watch.settings.gap_s if self._watch else None
        try:
            while not (waiting.done() or lost.done()):
                await asyncio.wait(either, timeout=look_s, return_when=asyncio.FIRST_COMPLETED)
                self._check_garbled(waiting)
            if not waiting.done():
                raise ConnectionResetError("the connection was closed while the answer was awaited")
            return waiting.result()
        finally:
            waiting.cancel()
            await asyncio.gather(waiting, return_exceptions=True)

    def _check_garbled(self, waiting: asyncio.Future[ModbusPDU]) -> None:
        if self._watch and not waiting.done() and self._watch.garbled(asyncio.get_running_loop().time()):
            raise GarbledAnswerError(f"{self._device} sent an answer that fails its checksum", remedy=REPEAT)

    def _note_answer(self) -> None:
        self._connection.answered()
        if self._watch:
            self._watch.answered(asyncio.get_running_loop().time())

    def _on_packet(self, sending: bool, packet: bytes) -> bytes:  # noqa: FBT001 - the library's signature
        if self._watch is None:
            return packet
        now_s = asyncio.get_running_loop().time()
        if not sending:
            return self._watch.heard(packet, now_s)
        self._watch.sent(packet, now_s)
        return packet
