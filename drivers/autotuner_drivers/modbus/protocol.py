"""Modbus messages: requests, the shape of their answers (V1.1b3, section 6), exceptions as errors of the port.

An exchange is a request with its outcome; an account is what one loop knows of its exchanges.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from pymodbus.client.mixin import ModbusClientMixin
from pymodbus.exceptions import ConnectionException, ModbusIOException

from autotuner.errors import DeviceRefusedError, DeviceTimeoutError, DriverError, LinkError
from autotuner_drivers.links import CHECK_LINE, Row, error_of, link_error

if TYPE_CHECKING:
    from collections.abc import Callable

    from pymodbus.pdu import ModbusPDU

    from autotuner_drivers.modbus.register_map import ReadRequest
    from autotuner_drivers.modbus.registers import Table


READ_CODES: Final[dict[Table, int]] = {"coil": 1, "discrete": 2, "holding": 3, "input": 4}
WRITE_CODES: Final[dict[tuple[Table, bool], int]] = {
    ("coil", True): 5,
    ("holding", True): 6,
    ("coil", False): 15,
    ("holding", False): 16,
}
"""By table, and whether it is the function for a single value."""


class _Messages(ModbusClientMixin["ModbusPDU"]):
    """The library's calls, which here only make their message."""

    def execute(self, no_response_expected: bool, request: ModbusPDU) -> ModbusPDU:  # noqa: ARG002, FBT001
        return request


_MESSAGES: Final = _Messages()  # type: ignore[no-untyped-call]
_METHODS: Final[dict[int, Callable[..., ModbusPDU]]] = {
    1: ModbusClientMixin.read_coils,
    2: ModbusClientMixin.read_discrete_inputs,
    3: ModbusClientMixin.read_holding_registers,
    4: ModbusClientMixin.read_input_registers,
    5: ModbusClientMixin.write_coil,
    6: ModbusClientMixin.write_register,
    15: ModbusClientMixin.write_coils,
    16: ModbusClientMixin.write_registers,
}
_BIT_READS: Final = frozenset({1, 2})
_SINGLE_WRITES: Final = frozenset({5, 6})


class Request(NamedTuple):
    """One request.

    Attributes
    ----------
    function : int
        Function code.
    address : int
        First register or bit.
    count : int
        Number of registers or bits.
    words : tuple of int
        What is written; empty for a read.
    unit : int, optional
        Unit identifier, where it is not that of the device.
    """

    function: int
    address: int
    count: int  # type: ignore[assignment]  # of registers, not of fields
    words: tuple[int, ...] = ()
    unit: int | None = None

    def pdu(self, unit: int) -> ModbusPDU:
        """Return the request as a message of the library."""
        method, unit = _METHODS[self.function], unit if self.unit is None else self.unit
        if not self.words:
            return method(_MESSAGES, self.address, count=self.count, device_id=unit)
        value = self.words[0] if self.function in _SINGLE_WRITES else list(self.words)
        return method(_MESSAGES, self.address, value, device_id=unit)

    def words_of(self, answer: ModbusPDU) -> tuple[int, ...]:
        """Return the words, or the bits, of the answer to a read."""
        return tuple(map(int, answer.bits if self.function in _BIT_READS else answer.registers))

    def mismatch(self, answer: ModbusPDU) -> str | None:
        """Return in what the answer, no refusal, is not one to this request; None when it fits."""
        if answer.function_code != self.function:
            return f"answered function {answer.function_code} where {self.function} was requested"
        if self.words:
            fits = answer.address == self.address
            return None if fits else f"confirmed address {answer.address} instead of {self.address}"
        held = len(self.words_of(answer))
        return None if held == self._held_by_answer() else f"answered {held} values where {self.count} were requested"

    @property
    def rtu_answer_size(self) -> int:
        """Length of the answer on a serial line, bytes: unit, function, content, checksum."""
        if self.words:
            return 8
        held = self._held_by_answer()
        return 5 + (held // 8 if self.function in _BIT_READS else 2 * held)

    @property
    def tcp_answer(self) -> tuple[bytes, int]:
        """How the usual answer begins after the header of TCP, and its whole length, bytes."""
        size = self.rtu_answer_size + 4  # a header of 7 bytes for the unit and the checksum
        return bytes((self.function,) if self.words else (self.function, size - 9)), size

    def _held_by_answer(self) -> int:
        """Return the number of values in the answer to a read: bits come in whole bytes."""
        return -(-self.count // 8) * 8 if self.function in _BIT_READS else self.count


def read_request(read: ReadRequest) -> Request:
    """Return the request of a read that was planned."""
    return Request(READ_CODES[read.table], read.address, read.count, unit=read.unit)


_LIBRARY: Final[dict[type[Exception], Row]] = {
    ModbusIOException: (
        DeviceTimeoutError,
        "did not answer within {timeout_s:g} s",
        "Check the unit number and the line, or raise timeout_s.",
    ),
    ConnectionException: (LinkError, "lost the connection", CHECK_LINE),
}

EXCEPTION_CODES: Final[dict[int, Row]] = {
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
    4: (DeviceRefusedError, "device failure", "Check the device: it reports a fault of its own."),
    5: (DeviceRefusedError, "acknowledged, but not yet done", "Repeat the request later."),
    6: (DeviceRefusedError, "device busy", "Repeat the request later, or use a longer sample time."),
    8: (DeviceRefusedError, "memory parity error", "Check the device: it reports a fault of its own."),
    10: (LinkError, "gateway path unavailable", "Check the gateway's configuration and the unit number."),
    11: (DeviceTimeoutError, "no answer from the device behind the gateway", "Check the device and the unit number."),
}
"""Exception codes of the protocol (V1.1b3, section 7)."""

_UNKNOWN_CODE: Final[Row] = (DeviceRefusedError, "not in the standard", "See the device's manual.")


def driver_error(error: Exception, device: str, timeout_s: float) -> DriverError:
    """Return the error of the port for an exception of the library, the socket or the serial port."""
    row = _LIBRARY.get(type(error))
    return error_of(row, error, device, timeout_s) if row else link_error(error, device, timeout_s)


def refusal(code: int, device: str) -> DriverError:
    """Return the error of the port for an exception answer."""
    kind, meaning, remedy = EXCEPTION_CODES.get(code, _UNKNOWN_CODE)
    return kind(f"{device} answered exception {code} ({meaning})", remedy=remedy)


def not_open(device: str) -> LinkError:
    """Return the error of a call to a device that was not opened, or was closed."""
    return LinkError(f"{device} is not open", remedy="Open the backend first.")


@dataclass(slots=True, eq=False)
class Exchange:
    """A request and its outcome: `words` of the answer, or an `error`.

    Attributes
    ----------
    request : Request
        The request.
    retries : int
        Largest number of repetitions.
    words : tuple of int
        The words, or the bits, of the answer.
    error : DriverError or None
        Why there is no answer.
    moment_s : float
        Time of execution by the device, on the clock of the event loop, s.
    repeated : int
        Number of repetitions.
    """

    request: Request
    retries: int
    words: tuple[int, ...] = ()
    error: DriverError | None = None
    moment_s: float = math.nan
    repeated: int = 0


@dataclass(slots=True, eq=False)
class Account:
    """Account of the requests of one loop.

    Attributes
    ----------
    moment_s : float
        Time of the last exchange that read the PV or wrote, on the clock of the event loop, s.
    repeated : int
        Number of repeated requests.
    """

    moment_s: float = math.nan
    repeated: int = 0

    def take(self, exchange: Exchange, *, last: bool = True) -> None:
        """Record an exchange; the `last` exchange of a call sets the moment."""
        self.repeated += exchange.repeated
        if last and exchange.error is None:
            self.moment_s = exchange.moment_s

    def words_of(self, exchange: Exchange) -> tuple[int, ...]:
        """Record an exchange, and return its words or raise its error."""
        self.take(exchange)
        if exchange.error is not None:
            raise exchange.error
        return exchange.words
