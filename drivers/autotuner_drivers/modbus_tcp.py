"""Modbus over TCP or TLS: requests and answers as bytes, and one connection.

    transaction (2)  protocol, 0 (2)  length of the rest (2)  unit (1)  function (1)  data

(Modbus Messaging on TCP/IP Implementation Guide V1.0b, section 3.1; sizes in bytes.) Many loops ask many times a
second, and the general library spends several times what the bytes themselves need; serial lines, where that does not
count, go through it.

Rules of this file:

1. One request at a time: whoever uses a client takes turns.
2. An answer counts when its transaction and unit are those of the request under way. Anything else that has the shape
   of an answer is late, or not ours, and is passed over; what has not is thrown away with all that came with it.
3. A request ends with an answer, at its time limit, or with the connection.
"""

from __future__ import annotations

import asyncio
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, cast

from pymodbus.exceptions import ConnectionException, ModbusIOException

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from autotuner_drivers.modbus_requests import Request

HEADER: Final = struct.Struct(">HHHBB")
_FIELDS: Final = struct.Struct(">HHHBBHH")
_SHORTEST, _LONGEST = 3, 254
"""Lengths that the header may tell: unit, function and a byte; the longest message of the protocol."""
_BITS, _WORDS = frozenset({1, 2}), frozenset({3, 4})
_ON: Final = 0xFF00
_REFUSED: Final = 0x80


@dataclass(frozen=True, slots=True)
class Answer:
    """An answer; of what it may hold only what its function has is filled in.

    `exception_code` is 0 unless the device refused; `address` is the one that it confirms to have written.
    """

    function_code: int
    exception_code: int = 0
    registers: Sequence[int] = ()
    bits: Sequence[int] = ()
    address: int = 0

    def isError(self) -> bool:
        """Return whether the device refused."""
        return self.exception_code != 0


def frame_of(request: Request, transaction: int, unit: int) -> bytes:
    """Return a request as bytes."""
    function, words = request.function, request.words
    value = request.count
    if function == 5:
        value = _ON if words[0] else 0
    elif function == 6:
        value = words[0]
    data = b""
    if function == 15:
        data = sum(bit << i for i, bit in enumerate(words)).to_bytes(-(-len(words) // 8), "little")
    elif function == 16:
        data = struct.pack(f">{len(words)}H", *words)
    if data:
        data = bytes((len(data),)) + data
    return _FIELDS.pack(transaction, 0, 6 + len(data), unit, function, request.address, value) + data


def answer_of(function: int, data: bytes) -> Answer | None:
    """Return the answer of a function code and its data; None when they do not make one."""
    if function & _REFUSED:
        return Answer(function & ~_REFUSED, data[0]) if len(data) == 1 and data[0] else None
    if function not in _BITS | _WORDS:
        return Answer(function, address=int.from_bytes(data[:2], "big")) if len(data) == 4 else None
    size = len(data) - 1
    if data[0] != size or (function in _WORDS and size % 2):
        return None
    if function in _WORDS:
        return Answer(function, registers=struct.unpack_from(f">{size // 2}H", data, 1))
    return Answer(function, bits=[byte >> i & 1 for byte in data[1:] for i in range(8)])


class TcpClient(asyncio.Protocol):
    """One connection, made once.

    Parameters
    ----------
    create : callable
        Makes the connection with the protocol that it is given.
    timeout_s : float
        Longest wait for the connection, and for an answer, s.
    most_silent : int
        After so many requests in a row without an answer, the next one closes the connection.
    on_connection : callable
        Is told that the connection is made (True) or lost (False).
    """

    def __init__(
        self,
        create: Callable[[Callable[[], asyncio.Protocol]], Awaitable[object]],
        timeout_s: float,
        most_silent: int,
        on_connection: Callable[[bool], None],
    ) -> None:
        self.create = create
        self._timeout_s, self._most_silent, self._on_connection = timeout_s, most_silent, on_connection
        self._transport: asyncio.Transport | None = None
        self._answer: asyncio.Future[Answer] | None = None
        self._asked = (0, 0)
        self._rest = b""
        self._silent = 0
        self._until_s = 0.0
        self._watch: asyncio.TimerHandle | None = None

    @property
    def connected(self) -> bool:
        """Whether there is a connection."""
        return self._transport is not None

    async def dial(self) -> Exception | None:
        """Connect; return why it failed."""
        try:
            async with asyncio.timeout(self._timeout_s):
                await self.create(lambda: self)
        except Exception as error:  # noqa: BLE001 - whoever asked for it decides
            return error
        return None

    def close(self) -> None:
        """Disconnect; a request under way fails."""
        self._end(ConnectionException("the connection was closed here"))

    async def ask(self, request: Request, unit: int) -> Answer:
        """Return the answer to a request; raise what the library would."""
        if self._transport is None:
            raise ConnectionException("not connected")
        loop = asyncio.get_running_loop()
        transaction = self._asked[0] % 0xFFFF + 1
        self._asked = transaction, unit
        answer: asyncio.Future[Answer] = loop.create_future()
        self._answer = answer
        self._transport.write(frame_of(request, transaction, unit))
        self._until_s = loop.time() + self._timeout_s
        if self._watch is None:
            self._watch = loop.call_at(self._until_s, self._look)
        try:
            return await answer
        finally:
            self._answer = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take the connection."""
        self._transport = cast("asyncio.Transport", transport)  # that of another event loop need not descend from it
        self._on_connection(True)  # noqa: FBT003 - the signature of all clients

    def connection_lost(self, exc: Exception | None) -> None:
        """Take note of the loss, wanted or not."""
        reason = ConnectionResetError("the connection was closed while the answer was awaited")
        reason.__cause__ = exc
        self._end(reason)

    def data_received(self, data: bytes) -> None:
        """Take bytes, in whatever pieces they come."""
        if self._rest:
            data = self._rest + data
        while len(data) >= HEADER.size:
            transaction, protocol, length, unit, function = HEADER.unpack_from(data)
            if protocol or not _SHORTEST <= length <= _LONGEST:
                data = b""
            elif len(data) < 6 + length:
                break
            elif (transaction, unit) == self._asked:
                self._take(answer_of(function, data[HEADER.size : 6 + length]))
            data = data[6 + length :]
        self._rest = data

    def _take(self, answer: Answer | None) -> None:
        if answer is not None and self._answer is not None and not self._answer.done():
            self._silent = 0
            self._answer.set_result(answer)

    def _look(self) -> None:
        """Look at the time limit of the request under way; one timer for many requests, late for none of them."""
        self._watch, answer = None, self._answer
        if answer is None or answer.done():
            return
        loop = answer.get_loop()
        if loop.time() < self._until_s:
            self._watch = loop.call_at(self._until_s, self._look)
            return
        self._silent += 1
        reason = ModbusIOException("no answer within the time limit")
        if self._silent > self._most_silent:
            self._end(reason)
        else:
            answer.set_exception(reason)

    def _end(self, reason: Exception) -> None:
        """Let the connection go, polite unless it has something to send that nobody takes, and tell."""
        transport, self._transport = self._transport, None
        if self._watch is not None:
            self._watch.cancel()
            self._watch = None
        if self._answer is not None and not self._answer.done():
            self._answer.set_exception(reason)
        if transport is None:
            return
        if transport.get_write_buffer_size():
            transport.abort()
        else:
            transport.close()
        self._on_connection(False)  # noqa: FBT003 - the signature of all clients
