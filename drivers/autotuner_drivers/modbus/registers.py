"""Modbus registers: which words of a device hold which signal of a loop.

    value = raw * scale + offset                        raw = (value - offset) / scale

`raw` is the number in the device, rounded to the nearest integer for the integer types. A type of several words is
stored high word first (`word_order = "big"`) or low word first; within a word the protocol sends the high byte first
(`byte_order = "big"`), some devices the low one. Addresses are those of the protocol, from 0 (Modbus Application
Protocol Specification V1.1b3, section 4.4), not the 40001 style numbers of manuals.

Invariants: pure, no input or output; a value that does not fit its register is refused, never wrapped or
clipped; a value that the device cannot vouch for is NaN.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Final, Literal

from autotuner.errors import DeviceRefusedError

if TYPE_CHECKING:
    from collections.abc import Sequence

Table = Literal["input", "holding", "coil", "discrete"]
Order = Literal["big", "little"]

BIT_TABLES: Final = frozenset({"coil", "discrete"})
WRITABLE_TABLES: Final = frozenset({"holding", "coil"})
LAST_ADDRESS: Final = 0xFFFF
"""Highest address of a register in a request: two bytes."""

TYPES: Final[dict[str, str]] = {
    "bool": "?",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
    "bcd16": "H",
    "bcd32": "I",
}
"""Codes of the module `struct` by the names that the configuration uses."""

BCD_DIGITS: Final = {"bcd16": 4, "bcd32": 8}
"""Decimal digits, four bits each, of binary-coded decimal types."""

_VALUE: Final = {name: struct.Struct(f">{code}") for name, code in TYPES.items()}
_SIZE: Final = {name: max(value.size // 2, 1) for name, value in _VALUE.items()}
_SIGNS: Final = {"int16": 0x8000, "uint16": 0}
"""Sign bits of the types of one word."""
_WORDS: Final[dict[Order, dict[int, struct.Struct]]] = {
    "big": {size: struct.Struct(f">{size}H") for size in _SIZE.values()},
    "little": {size: struct.Struct(f"<{size}H") for size in _SIZE.values()},
}
"""Values, and words by the order of their bytes, made once: many loops read and write many times a second."""


@dataclass(frozen=True, slots=True)
class Register:
    """One signal's place in the device.

    Attributes
    ----------
    name : str
        Name of the signal, such as ``pv``.
    table : {"input", "holding", "coil", "discrete"}
        The device's table.
    address : int
        First register or bit, from 0.
    type : str
        A key of `TYPES`; ``bool`` for coils and discrete inputs, and for them only.
    word_order, byte_order : {"big", "little"}
        Order of the words of one value, and of the bytes of one word.
    scale, offset : float
        `value = raw * scale + offset`.
    invalid : tuple of int
        Raw values by which the device reports that it has no value, such as 32767 for a broken sensor; read as NaN.
    states : tuple of (tuple of int, tuple of int), optional
        Raw values that mean 0.0 and 1.0; for a mode register: manual and auto. The first of each is written.
    bit : int, optional
        The bit of the word that holds the signal, 0 the lowest.
    unit : int, optional
        Unit identifier of the register, where it is not that of the device.
    write_to : Register, optional
        Where the signal is written, if not where it is read.
    pulses : tuple of (Register, Register), optional
        Registers or coils of which 1 is written to set 0.0 and 1.0; the device clears them.
    """

    name: str
    table: Table
    address: int
    type: str
    word_order: Order = "big"
    byte_order: Order = "big"
    scale: float = 1.0
    offset: float = 0.0
    invalid: tuple[int, ...] = ()
    states: tuple[tuple[int, ...], tuple[int, ...]] | None = None
    bit: int | None = None
    unit: int | None = None
    write_to: Register | None = None
    pulses: tuple[Register, Register] | None = None

    @property
    def size(self) -> int:
        """Number of registers, or of bits, that the value takes."""
        return _SIZE[self.type]

    @property
    def end(self) -> int:
        """First address after the value."""
        return self.address + self.size

    @property
    def writable(self) -> bool:
        """Whether the protocol can write the signal."""
        return self.pulses is not None or self.target.table in WRITABLE_TABLES

    @property
    def target(self) -> Register:
        """Where the signal is written."""
        return self.write_to or self

    @property
    def plain(self) -> bool:
        """Whether the value is the raw number itself."""
        return (self.scale, self.offset) == (1.0, 0.0)

    @property
    def sign(self) -> int | None:
        """Sign bit of a number that is one word, as most are: `raw = (word ^ sign) - sign`; None for all others."""
        plain = self.byte_order == "big" and self.states is None and self.bit is None
        return _SIGNS.get(self.type) if plain else None

    @property
    def place(self) -> str:
        """The place of the value, in words."""
        bit = "" if self.bit is None else f" bit {self.bit}"
        return f"{self.table} {self.address}" + (f"..{self.end - 1}" if self.size > 1 else "") + bit

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest value that the register can hold."""
        low, high = raw_limits("bool" if self.bit is not None else self.type)
        ends = (low * self.scale + self.offset, high * self.scale + self.offset)
        return min(ends), max(ends)

    def resolution(self, value: float) -> float:
        """Return the distance of the values next to `value` that the register can hold."""
        if not self.type.startswith("float"):
            return abs(self.scale)
        raw = abs((value - self.offset) / self.scale)
        mantissa_bits = 23 if self.type == "float32" else 52
        return abs(self.scale) * 2.0 ** (math.frexp(raw)[1] - 1 - mantissa_bits)

    def decode(self, words: Sequence[int]) -> float:
        """Return the value of `size` words, or of one bit.

        Raises
        ------
        DeviceRefusedError
            A mode register holds neither of its two values.
        """
        raw = self._raw_of(words)
        if self.states is not None:
            return self._state_of(raw)
        if raw in self.invalid or not math.isfinite(raw):
            return math.nan
        return raw * self.scale + self.offset

    def encode(self, value: float) -> tuple[int, ...]:
        """Return the words, or the bit, that stand for a value.

        Raises
        ------
        DeviceRefusedError
            The value is not finite, or does not fit the register.
        """
        if not math.isfinite(value):
            raise self._refusal("is not a finite number", value, "Give a number.")
        if self.states is not None:
            return self._words_of(self.states[self._bit_of(value)][0])
        if self.type == "bool" or self.bit is not None:
            return (self._bit_of(value),)
        raw = (value - self.offset) / self.scale
        low, high = raw_limits(self.type)
        raw = raw if self.type.startswith("float") else round(raw)
        if not low <= raw <= high:
            raise self._refusal(
                f"does not fit {self.type} at {self.place}, which holds {self.limits[0]:g} to {self.limits[1]:g}",
                value,
                "Set the loop's limits within the register's range, or correct its scale.",
            )
        return self._words_of(raw)

    def _raw_of(self, words: Sequence[int]) -> float:
        if self.type == "bool":
            return int(bool(words[0]))
        in_order = words if self.word_order == "big" else reversed(words)
        raw: float = _VALUE[self.type].unpack(_WORDS[self.byte_order][self.size].pack(*in_order))[0]
        if self.bit is not None:
            return int(raw) >> self.bit & 1
        return _from_bcd(int(raw), BCD_DIGITS[self.type]) if self.type in BCD_DIGITS else raw

    def merged(self, word: int, value: int) -> int:
        """Return a word of the device with the signal's bit set or cleared."""
        mask = 1 << (self.bit or 0)
        return word | mask if value else word & ~mask

    def _words_of(self, raw: float) -> tuple[int, ...]:
        if self.type == "bool":
            return (int(raw),)
        if self.sign is not None:
            return (int(raw) & 0xFFFF,)
        if self.bit is not None:
            return (int(raw),)
        if self.type in BCD_DIGITS:
            raw = int(str(int(raw)), 16)
        words: tuple[int, ...] = _WORDS[self.byte_order][self.size].unpack(_VALUE[self.type].pack(raw))
        return words if self.word_order == "big" else words[::-1]

    def _state_of(self, raw: float) -> float:
        for state, raws in enumerate(self.states or ((0,), (1,))):
            if raw in raws:
                return float(state)
        manual, auto = (", ".join(map(str, raws)) for raws in self.states or ((0,), (1,)))
        raise self._refusal(
            f"at {self.place} holds a mode that is neither {auto} (1.0) nor {manual} (0.0)",
            raw,
            "Bring the device to one of the two modes, or correct auto_value and manual_value.",
        )

    def _bit_of(self, value: float) -> int:
        if value not in {0.0, 1.0}:
            raise self._refusal("can only be 0 or 1", value, "Give 0 or 1.")
        return int(value)

    def _refusal(self, message: str, value: float, remedy: str) -> DeviceRefusedError:
        return DeviceRefusedError(message, field=self.name, value=value, remedy=remedy)


@cache
def raw_limits(kind: str) -> tuple[float, float]:
    """Return the lowest and highest number of a type of `TYPES`."""
    if kind == "bool":
        return 0, 1
    if kind.startswith("float"):
        highest: float = (
            struct.unpack(">f", b"\x7f\x7f\xff\xff")[0] if kind == "float32" else math.nextafter(math.inf, 0)
        )
        return -highest, highest
    if kind in BCD_DIGITS:
        return 0, 10 ** BCD_DIGITS[kind] - 1
    bits = 8 * _VALUE[kind].size
    return (0, 2**bits - 1) if kind.startswith("u") else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)


def _from_bcd(raw: int, digits: int) -> float:
    """Return the number of binary-coded decimal digits; NaN where one is none."""
    text = f"{raw:0{digits}x}"
    return float(text) if text.isdecimal() else math.nan
