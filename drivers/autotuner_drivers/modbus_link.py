"""One Modbus connection: requests, answers, time limits, reconnecting.

Rules of this file:

1. Every call ends within its time limit, with an answer, a `DriverError` whose cause is chained, or its cancellation.
2. The connection is made by the call that needs it. After a failed attempt, calls fail at once until the pause is
   over; the pause doubles up to `LONGEST_PAUSE_S`. Nothing reconnects in the background, so a closed link stays closed.
3. An answer is accepted only when it has the shape that was asked for. Over TCP the transaction identifier also ties
   it to its request, so a late answer is dropped.
4. A request that got no answer is repeated `retries` times by this file, never by the library underneath, which would
   repeat it while the first answer may still be on its way.
"""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Protocol

from pymodbus.client.mixin import ModbusClientMixin
from pymodbus.exceptions import ConnectionException, ModbusException, ModbusIOException

from autotuner.errors import DeviceRefusedError, DeviceTimeoutError, DriverError, LinkError
from autotuner_drivers.registers import BIT_TABLES

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from pymodbus.client.base import ModbusBaseClient
    from pymodbus.pdu import ModbusPDU

    from autotuner_drivers.register_map import ReadRequest
    from autotuner_drivers.registers import Table

# The library's warnings repeat what the errors of this file say; without a handler they would go to stderr.
logging.getLogger("pymodbus.logging").addHandler(logging.NullHandler())

FIRST_PAUSE_S: Final = 0.1
LONGEST_PAUSE_S: Final = 2.0
SILENT_REQUESTS: Final = 2
"""After so many requests without an answer in a row, the next one closes the connection and a new one is made."""


class Transport(Protocol):
    """The kind of line: makes a client of the library that is not yet connected."""

    @property
    def label(self) -> str:
        """The device's address, for messages."""

    def client(self, timeout_s: float, on_connection: Callable[[bool], None]) -> ModbusBaseClient:
        """Return a client that neither repeats nor reconnects by itself and reports each change of its connection."""


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
    transport : Transport
        The line.
    settings : LinkSettings
        Unit, time limit and repetitions.
    """

    def __init__(self, transport: Transport, settings: LinkSettings) -> None:
        self._transport = transport
        self._settings = settings
        self._turn = asyncio.Lock()
        self._client: ModbusBaseClient | None = None
        self._lost: asyncio.Future[None] | None = None
        self._opened = False
        self._pause_s = 0.0
        self._not_before = 0.0
        self._reason: Exception | None = None

    async def open(self) -> None:
        """Connect now, without regard to an earlier failure; nothing when connected."""
        async with self._turn:
            self._opened = True
            self._not_before = 0.0
            await self._connected()

    def close(self) -> None:
        """Disconnect; a request under way fails."""
        self._opened = False
        self._drop()

    async def read(self, request: ReadRequest) -> Sequence[int]:
        """Return the words, or the bits, of one read."""
        ask = _READS[request.table]
        answer = await self._ask(
            lambda client: ask(client, request.address, count=request.count, device_id=self._settings.unit)
        )
        words = answer.bits if request.table in BIT_TABLES else answer.registers
        expected = -(-request.count // 8) * 8 if request.table in BIT_TABLES else request.count
        if len(words) != expected:
            raise self._error(LinkError, f"answered {len(words)} values where {request.count} were asked for", _GARBLED)
        return [int(word) for word in words]

    async def write(self, table: Table, address: int, words: Sequence[int], *, single: bool) -> None:
        """Write words to holding registers or bits to coils; `single` takes the function code for one."""
        send = _WRITES[table, single]
        value = words[0] if single else list(words)
        answer = await self._ask(lambda client: send(client, address, value, device_id=self._settings.unit))
        if answer.address != address:
            raise self._error(LinkError, f"confirmed address {answer.address} instead of {address}", _GARBLED)

    async def _ask(self, send: Callable[[ModbusBaseClient], Awaitable[ModbusPDU]]) -> ModbusPDU:
        async with self._turn:
            for _ in range(self._settings.retries):
                try:
                    return await self._once(send)
                except DeviceTimeoutError:
                    continue
            return await self._once(send)

    async def _once(self, send: Callable[[ModbusBaseClient], Awaitable[ModbusPDU]]) -> ModbusPDU:
        client = await self._connected()
        try:
            answer = await self._unless_lost(send(client))
        except (ModbusException, OSError) as error:
            raise self._translated(error) from error
        if answer.isError():
            raise self._refusal(answer.exception_code)
        return answer

    async def _unless_lost(self, answer: Awaitable[ModbusPDU]) -> ModbusPDU:
        """Return the answer, or fail as soon as the connection is lost instead of at the time limit."""
        assert self._lost is not None  # noqa: S101 - narrows the type: set by every connect
        waiting = asyncio.ensure_future(answer)
        either: tuple[asyncio.Future[Any], ...] = (waiting, self._lost)
        try:
            await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
            if not waiting.done():
                raise ConnectionResetError("the connection was closed while the answer was awaited")
            return waiting.result()
        finally:
            waiting.cancel()
            await asyncio.gather(waiting, return_exceptions=True)

    async def _connected(self) -> ModbusBaseClient:
        if not self._opened:
            raise self._error(LinkError, "is not open", "Open the backend first.")
        if self._client is not None and self._client.connected:
            return self._client
        wait_s = self._not_before - asyncio.get_running_loop().time()
        if wait_s > 0.0:
            message = f"is not connected; the next attempt is due in {wait_s:.1f} s"
            raise self._error(LinkError, message, _CHECK_LINE) from self._reason
        return await self._connect()

    async def _connect(self) -> ModbusBaseClient:
        self._drop()
        loop = asyncio.get_running_loop()
        lost: asyncio.Future[None] = loop.create_future()
        client = self._transport.client(self._settings.timeout_s, lambda up: _note_loss(lost, up))
        client.set_max_no_responses(SILENT_REQUESTS - 1)
        reason = await _dial(client)
        if reason is not None:
            self._pause_s = min(max(2.0 * self._pause_s, FIRST_PAUSE_S), LONGEST_PAUSE_S)
            self._not_before = loop.time() + self._pause_s
            self._reason = reason
            raise self._translated(reason) from reason
        self._pause_s = 0.0
        self._client, self._lost = client, lost
        return client

    def _drop(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None
        if self._lost is not None and not self._lost.done():
            self._lost.set_result(None)

    def _translated(self, error: Exception) -> DriverError:
        kind, message, remedy = next(row for cause, row in _TRANSLATIONS.items() if isinstance(error, cause))
        return self._error(kind, message.format(error=error, timeout_s=self._settings.timeout_s), remedy)

    def _refusal(self, code: int) -> DriverError:
        kind, meaning, remedy = EXCEPTION_CODES.get(code, (DeviceRefusedError, "unknown", "See the device's manual."))
        return self._error(kind, f"answered exception {code} ({meaning})", remedy)

    def _error(self, kind: type[DriverError], message: str, remedy: str) -> DriverError:
        return kind(f"{self._transport.label} unit {self._settings.unit} {message}", remedy=remedy)


def _note_loss(lost: asyncio.Future[None], connected: bool) -> None:  # noqa: FBT001 - the library's signature
    if not connected and not lost.done():
        lost.set_result(None)


async def _dial(client: ModbusBaseClient) -> Exception | None:
    """Connect; return why it failed, which the library only logs."""
    reason: Exception = TimeoutError("no connection within the time limit")
    create = client.ctx.call_create

    async def create_and_note() -> object:
        nonlocal reason
        try:
            return await create()
        except OSError as error:
            reason = error
            raise

    client.ctx.call_create = create_and_note
    return None if await client.connect() else reason


_READS: Final[dict[Table, Callable[..., Awaitable[ModbusPDU]]]] = {
    "input": ModbusClientMixin.read_input_registers,
    "holding": ModbusClientMixin.read_holding_registers,
    "coil": ModbusClientMixin.read_coils,
    "discrete": ModbusClientMixin.read_discrete_inputs,
}

_WRITES: Final[dict[tuple[Table, bool], Callable[..., Awaitable[ModbusPDU]]]] = {
    ("holding", True): ModbusClientMixin.write_register,
    ("holding", False): ModbusClientMixin.write_registers,
    ("coil", True): ModbusClientMixin.write_coil,
    ("coil", False): ModbusClientMixin.write_coils,
}

_CHECK_LINE: Final = "Check that the device is on, its address and port, and that no other client holds it."
_GARBLED: Final = "Check the line and the device's documentation; the request may simply be repeated."

_TRANSLATIONS: Final[dict[type[Exception], tuple[type[DriverError], str, str]]] = {
    TimeoutError: (DeviceTimeoutError, "could not be connected within {timeout_s:g} s", _CHECK_LINE),
    ModbusIOException: (
        DeviceTimeoutError,
        "did not answer within {timeout_s:g} s",
        "Check the unit number and the line, or raise timeout_s.",
    ),
    ConnectionRefusedError: (LinkError, "refused the connection", _CHECK_LINE),
    ConnectionResetError: (LinkError, "closed the connection", _CHECK_LINE),
    ConnectionException: (LinkError, "lost the connection", _CHECK_LINE),
    OSError: (LinkError, "cannot be reached: {error}", _CHECK_LINE),
    ModbusException: (LinkError, "failed: {error}", _GARBLED),
}
"""First match wins."""

EXCEPTION_CODES: Final[dict[int, tuple[type[DriverError], str, str]]] = {
    1: (
        DeviceRefusedError,
        "illegal function",
        "Set use_fc5, use_fc6 or use_fc16 to false when the device lacks that function code.",
    ),
    2: (
        DeviceRefusedError,
        "illegal data address",
        "Check table and address of the registers (manuals often count from 1), and max_gap.",
    ),
    3: (
        DeviceRefusedError,
        "illegal data value",
        "The value may be out of the device's range, or the read longer than it allows: see max_registers_per_read.",
    ),
    4: (DeviceRefusedError, "device failure", "Look at the device: it reports a fault of its own."),
    5: (DeviceRefusedError, "acknowledged, but not yet done", "Repeat the request later."),
    6: (DeviceRefusedError, "device busy", "Repeat the request later, or use a longer sample time."),
    8: (DeviceRefusedError, "memory parity error", "Look at the device: it reports a fault of its own."),
    10: (LinkError, "gateway path unavailable", "Check the gateway's configuration and the unit number."),
    11: (DeviceTimeoutError, "no answer from the device behind the gateway", "Check the device and the unit number."),
}
"""Exception codes of the protocol (V1.1b3, section 7)."""
