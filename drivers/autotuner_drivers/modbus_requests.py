"""Requests of the Modbus protocol and the shape of their answers (V1.1b3, section 6), as a table by function code."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from pymodbus.client.mixin import ModbusClientMixin

if TYPE_CHECKING:
    from collections.abc import Callable

    from pymodbus.pdu import ModbusPDU

    from autotuner_drivers.register_map import ReadRequest
    from autotuner_drivers.registers import Table

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
    """

    function: int
    address: int
    count: int  # type: ignore[assignment]  # of registers, not of fields
    words: tuple[int, ...] = ()

    def pdu(self, unit: int) -> ModbusPDU:
        """Return the request as a message of the library."""
        method = _METHODS[self.function]
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
            return f"answered function {answer.function_code} where {self.function} was asked for"
        if self.words:
            fits = answer.address == self.address
            return None if fits else f"confirmed address {answer.address} instead of {self.address}"
        held = len(self.words_of(answer))
        return None if held == self._held_by_answer() else f"answered {held} values where {self.count} were asked for"

    @property
    def rtu_answer_size(self) -> int:
        """Length of the answer on a serial line, bytes: unit, function, content, checksum."""
        if self.words:
            return 8
        held = self._held_by_answer()
        return 5 + (held // 8 if self.function in _BIT_READS else 2 * held)

    def _held_by_answer(self) -> int:
        """Return the number of values in the answer to a read: bits come in whole bytes."""
        return -(-self.count // 8) * 8 if self.function in _BIT_READS else self.count


def read_request(read: ReadRequest) -> Request:
    """Return the request of a read that was planned."""
    return Request(READ_CODES[read.table], read.address, read.count)
