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
6. Loops with the same line, unit and settings share the connection, and their readings are combined (`joint_reads`). A
   write is never combined, and has its turn between two reads.
7. The time of a write with a damaged answer is that of the first attempt, not of the repetition.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from collections import deque
from dataclasses import dataclass, field
from functools import partial
from statistics import median
from typing import TYPE_CHECKING, Final

from pymodbus.exceptions import ModbusException, ModbusIOException

from autotuner.errors import DeviceTimeoutError, DriverError
from autotuner_drivers.links import REMEMBERED, REPEAT, SHORTEST_WAIT_S, GarbledAnswerError
from autotuner_drivers.modbus.joint_reads import JointReads
from autotuner_drivers.modbus.open_line import PORTS, OpenLine
from autotuner_drivers.modbus.overlap import FRAMER, HEADER_BYTES, Overlap
from autotuner_drivers.modbus.protocol import Account, Exchange, driver_error, not_open, refusal
from autotuner_drivers.modbus.register_map import DeviceLimits
from autotuner_drivers.shared_lines import SharedLines, report_closed

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Hashable, Sequence

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
    limits : DeviceLimits
        The longest read, and the widest gap.
    """

    unit: int
    timeout_s: float
    retries: int
    overlap: int = 1
    limits: DeviceLimits = field(default_factory=DeviceLimits)


class ModbusLink:
    """A connection to one unit, which the loops of one device share.

    Parameters
    ----------
    line : Line
        The line.
    settings : LinkSettings
        Unit, time limit, repetitions, and what the device can do.
    own : bool
        Whether one loop has it to itself.

    Attributes
    ----------
    users : dict
        The accounts of the loops that have joined, and their callbacks for a device that is gone.
    """

    def __init__(self, line: Line, settings: LinkSettings, *, own: bool = False) -> None:
        self.settings = settings
        self.users: dict[Account, Callable[[str], None] | None] = {}
        self._kind, self._own = line, own
        self._device = f"{line.label} unit {settings.unit}"
        self._closed_line = partial(OpenLine, line, self._device, settings.timeout_s, self._readable)
        self._line = self._closed_line()
        self._joint = JointReads(self, settings.limits)
        self._counted_from_s = math.nan
        self._most_at_once = 1 if line.watch or not settings.retries else settings.overlap
        self._overlap, self._losses = Overlap(), 0
        self._took_s: deque[float] = deque(maxlen=REMEMBERED)
        self._sent_s, self._silent = math.nan, False
        self._wait: asyncio.Timeout | None = None
        self._spoilt: str | None = None
        self._usual = (b"", 0)

    @property
    def shared(self) -> tuple[Hashable, object] | None:
        """The line, and how requests are sent to its unit, which loops share that state the same of both."""
        return None if self._own else ((self._kind, self.settings), None)

    def take_line(self) -> None:
        """Join the line; raise `LinkError` where another loop has it open with other settings."""
        if self not in self._line.users:
            self._line = PORTS.join(self, self._line, partial(report_closed, self.users))

    async def open(self) -> None:
        """Connect now, without regard to an earlier failure; nothing when connected.

        A connection whose last request had no answer is made again, even if other loops share it: it may be half open.
        """
        async with self.turn:
            if self._silent and self._watch is None:
                await self._connection.close()
            await self._connection.open()

    async def disconnect(self) -> None:
        """Disconnect, unless other units share the line; a request under way fails."""
        line, self._line = self._line, self._closed_line()
        self._counted_from_s = math.nan
        await PORTS.leave(self, line)
        await self._joint.end()

    @property
    def connected(self) -> bool:
        """Whether there is a connection, as far as is known."""
        return self._connection.up

    def counted_from(self, now_s: float) -> float:
        """Return the time from which the periods of all loops count, s: when the first of them asked."""
        if math.isnan(self._counted_from_s):
            self._counted_from_s = now_s
        return self._counted_from_s

    @property
    def _connection(self) -> ModbusConnection:
        return self._line.connection

    @property
    def _watch(self) -> LineWatch | None:
        return self._line.watch

    @property
    def turn(self) -> asyncio.Lock:
        """Held by the user of the line."""
        return self._line.turn

    @property
    def retries(self) -> int:
        """How often a request without an answer is repeated."""
        return self.settings.retries

    @property
    def at_once(self) -> int:
        """Most requests under way at once, now."""
        return self._most_at_once if self.latency_s >= SLOW_LINE_S else 1

    @property
    def latency_s(self) -> float:
        """Median time from a request to its answer, of the last ones, s; 0 before the first."""
        return median(self._took_s) if self._took_s else 0.0

    async def ask(self, request: Request, account: Account) -> tuple[int, ...]:
        """Return the words, or the bits, of the answer to a request."""
        self._check_open(account)
        exchange = Exchange(request, self.retries)
        async with self.turn:
            await self.exchange([exchange])
        return account.words_of(exchange)

    async def ask_all(self, requests: Sequence[Request], account: Account) -> list[tuple[int, ...]]:
        """Return the words of the answers to requests of which none depends on another, at once where possible.

        Another call has its turn between two requests, or between two lots that overlap: a restore never waits for the
        whole of a slow reading.
        """
        self._check_open(account)
        if len(self.users) > 1 and self.retries:
            return await self._joint.read(requests, account)
        answers: list[tuple[int, ...]] = []
        while len(answers) < len(requests):
            async with self.turn:
                some = [Exchange(r, self.retries) for r in requests[len(answers) : len(answers) + self.at_once]]
                await self.exchange(some)
            answers += [account.words_of(exchange) for exchange in some]
        return answers

    def _check_open(self, account: Account) -> None:
        if account not in self.users:
            raise not_open(self._device)

    async def exchange(self, exchanges: Sequence[Exchange]) -> None:
        """Make exchanges, which then hold their outcomes; the caller holds the line."""
        if len(exchanges) > 1:
            await self._together(exchanges)
        else:
            await self._by_itself(exchanges[0], exchanges[0].retries)

    async def _together(self, exchanges: Sequence[Exchange]) -> None:
        """Have requests under way at once; what is not answered is requested again alone."""
        try:
            answers, sent_s = await self._answers_to([exchange.request for exchange in exchanges])
        except DriverError as error:
            for exchange in exchanges:
                exchange.error = error
            return
        for exchange, (pdu, answered_s) in zip(exchanges, answers, strict=True):
            if pdu is not None:
                self._take(exchange, pdu, sent_s, answered_s)
            elif exchange.retries:
                exchange.repeated += 1
                await self._by_itself(exchange, exchange.retries - 1)
            else:
                exchange.error = driver_error(ModbusIOException(), self._device, self.settings.timeout_s)
        self._losses = 0
        if any(pdu is None for pdu, _ in answers):
            self._one_by_one("left requests unanswered")

    async def _answers_to(self, requests: Sequence[Request]) -> tuple[list[tuple[ModbusPDU | None, float]], float]:
        """Send requests at once; return the answer to each, with its time, and when they were sent."""
        client = self._connection.current or await self._connection.client()
        lost = self._connection.lost
        assert lost is not None  # noqa: S101 - narrows the type: set by every connect
        sent_s = asyncio.get_running_loop().time()
        pdus = [request.pdu(self.settings.unit) for request in requests]
        answers = await self._overlap.answers(pdus, client.ctx.send, lost, self.settings.timeout_s)
        if lost.done():
            self._losses += 1
            if self._losses >= LOSSES:
                self._one_by_one("closed the connection")
            error = ConnectionResetError("the connection was closed while answers were awaited")
            raise driver_error(error, self._device, self.settings.timeout_s) from error
        return answers, sent_s

    def _take(self, exchange: Exchange, answer: ModbusPDU, sent_s: float, answered_s: float) -> None:
        """Take an answer that was received."""
        try:
            exchange.words = self._checked(exchange.request, answer)
        except DriverError as error:
            exchange.error = error
            return
        self._took_s.append(answered_s - sent_s)
        exchange.moment_s = (sent_s + answered_s) / 2.0
        self._note_answer()

    def _one_by_one(self, reason: str) -> None:
        """Overlap no more."""
        self._most_at_once = 1
        _log.warning("%s %s when they overlapped: requests are sent one after another", self._device, reason)

    async def _by_itself(self, exchange: Exchange, retries: int) -> None:
        """Make an exchange, and repeat it where no answer comes."""
        written_s = math.inf
        while True:
            try:
                await self._once(exchange)
                break
            except REPEATED as error:
                self._silent = True
                if retries <= 0:
                    exchange.error = error
                    return
            except DriverError as error:
                exchange.error = error
                return
            retries -= 1
            exchange.repeated += 1
            if exchange.request.words and self._watch and self._watch.answering:
                written_s = min(written_s, self._sent_s + self.latency_s / 2.0)
        exchange.moment_s = min(exchange.moment_s, written_s)

    async def _once(self, exchange: Exchange) -> None:
        client = self._connection.current or await self._connection.client()
        request = exchange.request
        if self._watch is not None:
            await self._settled(self._watch, self._watch.settings.size(request.rtu_answer_size))
        clock = asyncio.get_running_loop().time
        sent_s = self._sent_s = clock()
        try:
            answer = await self._answered(client, request)
        except (ModbusException, OSError) as error:
            raise driver_error(error, self._device, self.settings.timeout_s) from error
        exchange.words = self._checked(request, answer)
        answered_s = clock()
        self._took_s.append(answered_s - sent_s)
        exchange.moment_s = (sent_s + answered_s) / 2.0
        self._note_answer()

    def _checked(self, request: Request, answer: ModbusPDU) -> tuple[int, ...]:
        """Return the words of an answer; raise when it is a refusal, or not an answer to this request."""
        if answer.isError():
            self._note_answer()
            raise refusal(answer.exception_code, self._device)
        if mismatch := request.mismatch(answer):
            raise GarbledAnswerError(f"{self._device} {mismatch}", remedy=REPEAT)
        return request.words_of(answer)

    async def _settled(self, watch: LineWatch, expected: int) -> None:
        """Wait until no answer is pending on the line, or none can arrive any more."""
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
                return await execute(False, request.pdu(self.settings.unit))  # noqa: FBT003
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
        self._silent = False
        self._connection.answered()
        if self._watch:
            self._watch.answered(asyncio.get_running_loop().time())

    def _readable(self, packet: bytes) -> bytes:
        """Return what the library can decode; anything else would make it close the connection."""
        self._overlap.receive(packet)
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


LINKS: Final[SharedLines[ModbusLink]] = SharedLines("Give all loops of one device the same settings.")
"""The links that are open."""


def _end(wait: asyncio.Timeout, _: object = None) -> None:
    """End a wait at once; nothing when it is over."""
    with contextlib.suppress(RuntimeError):
        wait.reschedule(-math.inf)
