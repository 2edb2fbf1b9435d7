"""Requests and answers over one Modbus connection, and their time limits.

Invariants:

1. Every call ends within its time limit, with an answer, a `DriverError` whose cause is chained, or its cancellation.
2. A connection that is lost fails the request under way at once; `ModbusConnection` makes it again.
3. An answer is accepted only when it has the requested shape. Over TCP the transaction identifier also ties
   it to its request; on a line without one, `LineWatch` keeps a late answer from the next request.
4. A request that got no answer is repeated `retries` times by this file, never by the library underneath, which would
   repeat it while the first answer may still be on its way.
5. Over a slow TCP line several reads are under way at once (`ask_all`). What the device did not answer so is requested
   again alone; a device that answers alone what it did not answer together gets one request after another from then on.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from collections import deque
from dataclasses import dataclass
from functools import partial
from statistics import median
from typing import TYPE_CHECKING, Final

from pymodbus.exceptions import ModbusException

from autotuner.errors import DeviceTimeoutError
from autotuner_drivers.links import REPEAT, GarbledAnswerError
from autotuner_drivers.modbus.open_line import PORTS, OpenLine
from autotuner_drivers.modbus.overlap import FRAMER, HEADER_BYTES, Overlap
from autotuner_drivers.modbus.protocol import driver_error, refusal

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from pymodbus.client.base import ModbusBaseClient
    from pymodbus.pdu import ModbusPDU

    from autotuner_drivers.modbus.connection import ModbusConnection
    from autotuner_drivers.modbus.line_watch import LineWatch
    from autotuner_drivers.modbus.lines import Line
    from autotuner_drivers.modbus.protocol import Request

# The library's lines repeat what the errors of this file say, with the bytes of the last twenty packets: they go
# neither to stderr nor into the log of the service, where every line is an event.
_library = logging.getLogger("pymodbus.logging")
_library.addHandler(logging.NullHandler())
_library.propagate = False

_log = logging.getLogger("autotuner.drivers.modbus")

REPEATED: Final = (DeviceTimeoutError, GarbledAnswerError)
"""After these a request is repeated."""

SLOW_LINE_S: Final = 0.05
"""From this round trip on requests overlap: on faster lines that gains nothing, and some servers lose requests."""
LOSSES: Final = 2
"""After so many losses of the connection in a row while requests overlapped, they no longer do: one may be a fault."""

SHORTEST_WAIT_S: Final = 0.001
"""Shortest sleep while the line has to be silent, s: one of 0 would spin."""
REMEMBERED: Final = 64
"""Answers whose times are remembered."""


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """How requests are sent to a device.

    Attributes
    ----------
    unit : int
        Unit identifier.
    timeout_s : float
        Longest wait for an answer, s.
    retries : int
        How often a request without an answer is repeated.
    overlap : int
        Most requests under way at once, where answers carry a number.
    """

    unit: int
    timeout_s: float
    retries: int
    overlap: int = 1


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
        Time, on the event loop's clock, at which the device carried out the last request: the middle between request
        and answer, s. A write whose answer came damaged was done then, not when it was repeated.
    repeated : int
        How many requests were repeated.
    """

    def __init__(self, line: Line, settings: LinkSettings) -> None:
        self._unit, self._timeout_s, self._retries = settings.unit, settings.timeout_s, settings.retries
        self._device = f"{line.label} unit {settings.unit}"
        self._closed_line = partial(OpenLine, line, self._device, settings.timeout_s, self._readable)
        self._line = self._closed_line()
        self._gone: Callable[[str], None] | None = None
        self._most_at_once = 1 if line.watch or not settings.retries else settings.overlap
        self._overlap, self._losses = Overlap(), 0
        self._took_s: deque[float] = deque(maxlen=REMEMBERED)
        self._sent_s = math.nan
        self._wait: asyncio.Timeout | None = None
        self._spoilt: str | None = None
        self._usual = (b"", 0)
        self.moment_s = math.nan
        self.repeated = 0

    async def open(self) -> None:
        """Connect now, without regard to an earlier failure; nothing when connected."""
        if self not in self._line.users:
            self._line = PORTS.join(self, self._line, self._gone)
        async with self._line.turn:
            await self._connection.open()

    async def close(self) -> None:
        """Disconnect, unless others share the line; a request under way fails."""
        line, self._line = self._line, self._closed_line()
        await PORTS.leave(self, line)

    @property
    def connected(self) -> bool:
        """Whether there is a connection, as far as is known."""
        return self._connection.up

    def watch(self, gone: Callable[[str], None] | None) -> None:
        """Call `gone` with the reason as soon as the device has closed the connection and takes no new one."""
        self._gone = gone
        if self in self._line.users:
            self._line.users[self] = gone

    @property
    def _connection(self) -> ModbusConnection:
        return self._line.connection

    @property
    def _watch(self) -> LineWatch | None:
        return self._line.watch

    @property
    def latency_s(self) -> float:
        """Median time from a request to its answer, of the last ones, s; 0 before the first."""
        return median(self._took_s) if self._took_s else 0.0

    async def ask(self, request: Request) -> tuple[int, ...]:
        """Return the words, or the bits, of the answer to a request."""
        async with self._line.turn:
            return await self._repeated(request, self._retries)

    async def ask_all(self, requests: Sequence[Request]) -> list[tuple[int, ...]]:
        """Return the words of the answers to requests of which none depends on another, at once where possible.

        Another call has its turn between two requests, or between two lots that overlap: a restore never waits for the
        whole of a slow reading.
        """
        answers: list[tuple[int, ...]] = []
        while len(answers) < len(requests):
            async with self._line.turn:
                at_once = self._most_at_once if self.latency_s >= SLOW_LINE_S else 1
                some = requests[len(answers) : len(answers) + at_once]
                if len(some) > 1:
                    answers += await self._together(some)
                else:
                    answers.append(await self._repeated(some[0], self._retries))
        return answers

    async def _together(self, requests: Sequence[Request]) -> list[tuple[int, ...]]:
        """Return the answers to requests under way at once; what is not answered is requested again alone."""
        client = self._connection.current or await self._connection.client()
        lost = self._connection.lost
        assert lost is not None  # noqa: S101 - narrows the type: set by every connect
        sent_s = asyncio.get_running_loop().time()
        pdus = [request.pdu(self._unit) for request in requests]
        heard = await self._overlap.answers(pdus, client.ctx.send, lost, self._timeout_s)
        if lost.done():
            self._losses += 1
            if self._losses >= LOSSES:
                self._one_by_one("closed the connection")
            error = ConnectionResetError("the connection was closed while answers were awaited")
            raise driver_error(error, self._device, self._timeout_s) from error
        answers = [await self._heard_or_repeated(*pair, sent_s) for pair in zip(requests, heard, strict=True)]
        self._losses = 0
        if any(pdu is None for pdu, _ in heard):
            self._one_by_one("left requests unanswered")
        if heard[-1][0] is not None:
            self.moment_s = (sent_s + heard[-1][1]) / 2.0
        return answers

    async def _heard_or_repeated(
        self, request: Request, heard: tuple[ModbusPDU | None, float], sent_s: float
    ) -> tuple[int, ...]:
        """Return the words of an answer that was heard, or ask again."""
        pdu, answered_s = heard
        if pdu is None:
            self.repeated += 1
            return await self._repeated(request, self._retries - 1)
        words = self._checked(request, pdu)
        self._timed(sent_s, answered_s)
        self._note_answer()
        return words

    def _one_by_one(self, reason: str) -> None:
        """Overlap no more."""
        self._most_at_once = 1
        _log.warning("%s %s when they overlapped: requests are sent one after another", self._device, reason)

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
        if self._watch is not None:
            await self._settled(self._watch, self._watch.settings.size(request.rtu_answer_size))
        clock = asyncio.get_running_loop().time
        sent_s = self._sent_s = clock()
        try:
            answer = await self._answered(client, request)
        except (ModbusException, OSError) as error:
            raise driver_error(error, self._device, self._timeout_s) from error
        words = self._checked(request, answer)
        self._timed(sent_s, clock())
        self._note_answer()
        return words

    def _timed(self, sent_s: float, answered_s: float) -> None:
        """Record when the device carried out a request."""
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
        execute: Callable[[bool, ModbusPDU], Awaitable[ModbusPDU]] = client.execute
        wait = self._wait = asyncio.timeout(None)
        self._spoilt, self._usual = None, request.tcp_answer
        give_up = partial(_end, wait)
        lost.add_done_callback(give_up)
        look = asyncio.ensure_future(self._ended_when_garbled(self._watch, wait)) if self._watch else None
        try:
            async with wait:
                return await execute(False, request.pdu(self._unit))  # noqa: FBT003
        except TimeoutError:
            if lost.done():
                raise ConnectionResetError("the connection was closed while the answer was awaited") from None
            raise GarbledAnswerError(f"{self._device} sent an answer that {self._spoilt}", remedy=REPEAT) from None
        finally:
            lost.remove_done_callback(give_up)
            if look is not None:
                look.cancel()
                await asyncio.gather(look, return_exceptions=True)

    async def _ended_when_garbled(self, watch: LineWatch, wait: asyncio.Timeout) -> None:
        """End the wait once an answer has come that is none."""
        clock = asyncio.get_running_loop().time
        while not watch.garbled(clock()):  # noqa: ASYNC110 - silence is the criterion
            await asyncio.sleep(watch.settings.gap_s)
        self._spoilt = "fails its checksum"
        _end(wait)

    def _note_answer(self) -> None:
        self._connection.answered()
        if self._watch:
            self._watch.answered(asyncio.get_running_loop().time())

    def _readable(self, packet: bytes) -> bytes:
        """Return what the library can decode; anything else would make it close the connection."""
        self._overlap.hear(packet)
        head, size = self._usual
        if len(packet) == size and packet.startswith(head, HEADER_BYTES):
            return packet
        try:
            FRAMER.handleFrame(packet, 0, 0)
        except ModbusException:
            self._spoilt = "cannot be decoded"
            if self._wait is not None:
                _end(self._wait)
            return b""
        return packet


def _end(wait: asyncio.Timeout, _: object = None) -> None:
    """End a wait at once; nothing when it is over."""
    with contextlib.suppress(RuntimeError):
        wait.reschedule(-math.inf)
