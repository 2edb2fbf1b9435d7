"""A loop's register map: its checks, and the few requests that read it.

Rules of this file:

1. A map that cannot work is refused when it is made, with the key at fault, before anything is sent.
2. A read asks only for registers that the map names, unless `max_gap` allows to read across a gap: reading an
   unmapped register is an error on many devices.
3. The registers of one value always travel in one request, so no value is ever put together from two scans.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import pairwise
from typing import TYPE_CHECKING, Final, get_args

from autotuner.ports import AUTO, OUTPUT, PV
from autotuner_drivers.options import Options, refuse
from autotuner_drivers.registers import BIT_TABLES, LAST_ADDRESS, TYPES, Order, Register, Table, raw_limits

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Sequence

_Place = tuple[str, int, int, float, float, tuple[int, ...], Register | None]
"""Name, first word, sign, scale, offset and invalid values of a signal of one word; else the register itself."""
_REMEMBERED: Final = 4096

HEARTBEAT: Final = "heartbeat"
"""Counted up by the driver, so nobody else writes it."""

MOST_REGISTERS: Final = 125
MOST_BITS: Final = 2000
"""Limits of the protocol itself for one read (V1.1b3, sections 6.1 to 6.4)."""


@dataclass(frozen=True, slots=True)
class DeviceLimits:
    """What a real device can do of what the protocol allows.

    Attributes
    ----------
    max_registers_per_read, max_bits_per_read : int
        Longest read that the device answers.
    max_gap : int
        Most unmapped registers that one read may cross.
    use_fc5, use_fc6, use_fc16 : bool
        Whether the device knows the function codes for a single coil, a single register, several registers.
    odd_addresses : bool
        Whether values of several words may start at an odd address.
    """

    max_registers_per_read: int = MOST_REGISTERS
    max_bits_per_read: int = MOST_BITS
    max_gap: int = 0
    use_fc5: bool = True
    use_fc6: bool = True
    use_fc16: bool = True
    odd_addresses: bool = False

    def longest_read(self, table: Table) -> int:
        """Return the most registers, or bits, of one read of a table."""
        return self.max_bits_per_read if table in BIT_TABLES else self.max_registers_per_read

    def single(self, register: Register) -> bool:
        """Return whether a register is written by the function code for a single one."""
        return self.use_fc5 if register.table == "coil" else self.use_fc6 and register.size == 1


@dataclass(frozen=True, slots=True)
class ReadRequest:
    """One request: `count` registers, or bits, of a table from `address` on, and the signals that they hold."""

    table: Table
    address: int
    count: int
    registers: tuple[Register, ...]

    def decode(self, words: Sequence[int]) -> dict[str, float]:
        """Return the value of each signal from the words of the answer."""
        return self.decoder()(words)

    def decoder(self) -> Callable[[Sequence[int]], dict[str, float]]:
        """Return what decodes the words of an answer; made once for many reads."""
        return _decoder(tuple(_place(r, r.address - self.address) for r in self.registers))


def _place(r: Register, start: int) -> _Place:
    return r.name, start, r.sign or 0, r.scale, r.offset, r.invalid, r if r.sign is None else None


@lru_cache(_REMEMBERED)
def _decoder(places: tuple[_Place, ...]) -> Callable[[Sequence[int]], dict[str, float]]:
    """Shared by loops whose maps differ in addresses alone: it then stays in the processor's caches."""
    return partial(_decoded, places)


def _decoded(places: tuple[_Place, ...], words: Sequence[int]) -> dict[str, float]:
    """Return the value of each signal: of one word at once, as `Register.decode` would."""
    values: dict[str, float] = {}
    for name, start, sign, scale, offset, invalid, register in places:
        if register is not None:
            values[name] = register.decode(words[start : start + register.size])
        else:
            raw = (words[start] ^ sign) - sign
            values[name] = math.nan if raw in invalid else raw * scale + offset
    return values


def plan_reads(registers: Iterable[Register], limits: DeviceLimits) -> tuple[ReadRequest, ...]:
    """Return the fewest requests that read the registers within the device's limits, by table and address."""
    groups: list[list[Register]] = []
    for register in sorted(registers, key=lambda r: (r.table, r.address)):
        if groups and _fits(groups[-1], register, limits):
            groups[-1].append(register)
        else:
            groups.append([register])
    return tuple(ReadRequest(g[0].table, g[0].address, g[-1].end - g[0].address, tuple(g)) for g in groups)


def _fits(group: Sequence[Register], register: Register, limits: DeviceLimits) -> bool:
    first, last = group[0], group[-1]
    return (
        register.table == first.table
        and register.address - last.end <= limits.max_gap
        and register.end - first.address <= limits.longest_read(first.table)
    )


@dataclass(frozen=True, slots=True)
class RegisterMap:
    """The registers of one loop by signal, and the limits of its device."""

    registers: dict[str, Register]
    limits: DeviceLimits

    @property
    def readable(self) -> frozenset[str]:
        """Names of the signals that can be read: all of them."""
        return frozenset(self.registers)

    @property
    def writable(self) -> frozenset[str]:
        """Names of the signals that can be written: not the PV, a measurement in any table, nor the heartbeat."""
        return frozenset(name for name, r in self.registers.items() if r.writable) - {PV, HEARTBEAT}

    def reads(self, names: Collection[str]) -> tuple[ReadRequest, ...]:
        """Return the requests that read the named signals, the PV's last: it is then nearest to the next write."""
        requests = plan_reads([self.registers[name] for name in names], self.limits)
        return tuple(sorted(requests, key=lambda request: any(r.name == PV for r in request.registers)))


def read_limits(options: Options) -> DeviceLimits:
    """Take the device's limits out of the driver's options."""
    return DeviceLimits(
        max_registers_per_read=options.integer("max_registers_per_read", MOST_REGISTERS, low=1, high=MOST_REGISTERS),
        max_bits_per_read=options.integer("max_bits_per_read", MOST_BITS, low=1, high=MOST_BITS),
        max_gap=options.integer("max_gap", 0, low=0, high=MOST_REGISTERS),
        use_fc5=options.flag("use_fc5", default=True),
        use_fc6=options.flag("use_fc6", default=True),
        use_fc16=options.flag("use_fc16", default=True),
        odd_addresses=options.flag("odd_addresses", default=False),
    )


def read_map(options: Options) -> RegisterMap:
    """Make the map out of the driver's options: the table `registers`, and the device's limits.

    Raises
    ------
    ConfigurationError
        Names the key, the value and the remedy.
    """
    limits = read_limits(options)
    defaults = {
        "word_order": options.choice("word_order", get_args(Order), "big"),
        "byte_order": options.choice("byte_order", get_args(Order), "big"),
    }
    table = options.table("registers")
    registers = {name: _read_register(name, table.table(name), defaults) for name in table}
    for name in (PV, OUTPUT):
        if name not in registers:
            refuse(table.key(name), None, "is missing", f"Add registers.{name}, for instance {_EXAMPLES[name]}.")
    for register in registers.values():
        _check_device(register, limits)
    _check_overlap(registers.values())
    return RegisterMap(registers, limits)


_EXAMPLES: Final = {
    PV: '{ table = "input", address = 0, type = "int16", scale = 0.1 }',
    OUTPUT: '{ table = "holding", address = 0, type = "int16", scale = 0.1 }',
}


def _read_register(name: str, options: Options, defaults: dict[str, Order]) -> Register:
    table = options.choice("table", get_args(Table))
    bit = table in BIT_TABLES
    kind = options.choice("type", tuple(TYPES), "bool" if bit else "int16")
    if bit != (kind == "bool"):
        refuse(
            options.key("type"),
            kind,
            f"does not fit the table {table}",
            "Coils and discrete inputs are bool, and nothing else is.",
        )
    register = Register(
        name,
        table,
        options.integer("address", low=0, high=LAST_ADDRESS),
        kind,
        options.choice("word_order", get_args(Order), defaults["word_order"]),
        options.choice("byte_order", get_args(Order), defaults["byte_order"]),
        options.number("scale", 1.0),
        options.number("offset", 0.0),
        options.integers("invalid"),
        _read_states(name, kind, options),
    )
    _check_register(register, options)
    options.done()
    return register


def _read_states(name: str, kind: str, options: Options) -> tuple[int, int] | None:
    """Return the raw values of manual and auto; other signals have none, so the keys are unknown to them."""
    if name != AUTO:
        return None
    if kind.startswith("float"):
        refuse(options.key("type"), kind, "cannot hold a mode", "Use a coil or an integer register.")
    low, high = (int(end) for end in raw_limits(kind))
    states = (
        options.integer("manual_value", 0, low=low, high=high),
        options.integer("auto_value", 1, low=low, high=high),
    )
    if states[0] == states[1]:
        refuse(options.key("auto_value"), states[1], "equals manual_value", "Give the two modes different values.")
    return states


def _check_register(register: Register, options: Options) -> None:
    if register.scale == 0.0:
        refuse(options.key("scale"), 0.0, "must not be zero", "Give the value of one count, such as 0.1.")
    if (register.type == "bool" or register.states) and not register.plain:
        key = "scale" if register.scale != 1.0 else "offset"
        refuse(options.key(key), getattr(register, key), "has no meaning for a bit or a mode", f"Leave out {key}.")
    if register.end - 1 > LAST_ADDRESS:
        refuse(
            options.key("address"),
            register.address,
            f"leaves no room for the {register.size} registers of {register.type}",
            f"The last address is {LAST_ADDRESS}.",
        )
    low, high = raw_limits(register.type)
    for raw in register.invalid:
        if not low <= raw <= high:
            refuse(options.key("invalid"), raw, f"is not a value of {register.type}", f"Give {low:g} to {high:g}.")


def _check_device(register: Register, limits: DeviceLimits) -> None:
    key = f"registers.{register.name}"
    if register.name in {OUTPUT, HEARTBEAT} and not register.writable:
        refuse(f"{key}.table", register.table, "cannot be written", "Use a holding register or a coil.")
    if register.name == HEARTBEAT and (register.type in {"bool", "float32", "float64"} or not register.plain):
        refuse(f"{key}.type", register.type, "cannot count", "Use an integer type without scale and offset.")
    if register.size > limits.longest_read(register.table):
        refuse(
            f"{key}.type",
            register.type,
            f"needs {register.size} registers, but max_registers_per_read is {limits.max_registers_per_read}",
            "Raise max_registers_per_read, or use a narrower type.",
        )
    if register.size > 1 and register.address % 2 and not limits.odd_addresses:
        refuse(
            f"{key}.address",
            register.address,
            f"is odd, but {register.type} starts at even addresses on most devices",
            "Manuals often count from 1: try one less. If the device has it there, set odd_addresses = true.",
        )
    _check_writes(register, limits)


def _check_writes(register: Register, limits: DeviceLimits) -> None:
    if register.table != "holding" or register.name == PV or limits.use_fc16:
        return
    if register.size > 1:
        refuse(
            f"registers.{register.name}.type",
            register.type,
            "cannot be written by a device without function code 16",
            "Set use_fc16 = true, or use a type of one register.",
        )
    if not limits.use_fc6:
        refuse(
            "use_fc16",
            False,  # noqa: FBT003
            f"leaves no way to write registers.{register.name}, because use_fc6 is false too",
            "Allow one of use_fc6 and use_fc16.",
        )


def _check_overlap(registers: Iterable[Register]) -> None:
    for before, after in pairwise(sorted(registers, key=lambda r: (r.table, r.address))):
        if before.table == after.table and after.address < before.end:
            refuse(
                f"registers.{after.name}.address",
                after.address,
                f"overlaps registers.{before.name}, which takes {before.place}",
                f"Use {before.end} or higher, or correct the type of registers.{before.name}.",
            )
