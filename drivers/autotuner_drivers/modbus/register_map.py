"""A loop's register map: its checks, and the few requests that read it.

Invariants:

1. A map that cannot work is refused when it is made, with the key at fault, before anything is sent.
2. A read asks only for registers that the map names, unless `max_gap` allows to read across a gap: reading an
   unmapped register is an error on many devices.
3. The registers of one value always travel in one request, so no value is ever put together from two scans.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import pairwise
from typing import TYPE_CHECKING, Final, get_args

from autotuner.ports import AUTO, OUTPUT, PV
from autotuner_drivers.modbus.registers import BIT_TABLES, LAST_ADDRESS, TYPES, Order, Register, Table, raw_limits
from autotuner_drivers.options import Options, refuse
from autotuner_drivers.scaling import Modes, read_modes

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

_Place = tuple[str, int, int, float, float, tuple[int, ...], Register | None]
"""Name, first word, sign, scale, offset and invalid values of a signal of one word; else the register itself."""
_REMEMBERED: Final = 4096
"""Decoders that are kept: maps that differ in addresses alone share one."""

HEARTBEAT: Final = "heartbeat"
"""Counted up by the driver, so nothing else writes it."""

WORD_BITS: Final = 16
"""Bits of a register."""
MOST_REGISTERS: Final = 125
"""Most registers of one read; so is `MOST_BITS` for coils (V1.1b3, sections 6.1 to 6.4)."""
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
    """One request: `count` registers, or bits, of a table from `address` on, of a unit, and the signals in them."""

    table: Table
    address: int
    count: int
    registers: tuple[Register, ...]
    unit: int | None = None

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
    for register in sorted(registers, key=_place_in_order):
        if groups and _fits(groups[-1], register, limits):
            groups[-1].append(register)
        else:
            groups.append([register])
    return tuple(ReadRequest(g[0].table, g[0].address, g[-1].end - g[0].address, tuple(g), g[0].unit) for g in groups)


def _place_in_order(register: Register) -> tuple[int, str, int]:
    return (-1 if register.unit is None else register.unit, register.table, register.address)


def _fits(group: Sequence[Register], register: Register, limits: DeviceLimits) -> bool:
    first, last = group[0], group[-1]
    return (
        (register.unit, register.table) == (first.unit, first.table)
        and register.address - last.end <= limits.max_gap
        and register.end - first.address <= limits.longest_read(first.table)
    )


@dataclass(frozen=True, slots=True)
class Handshake:
    """A bit that is set after signals were written, and that the device clears once it has taken them."""

    register: Register
    signals: frozenset[str]


@dataclass(frozen=True, slots=True)
class RegisterMap:
    """The registers of one loop by signal, and the limits of its device.

    Attributes
    ----------
    registers : dict
        Registers by signal.
    limits : DeviceLimits
        What the device can do.
    together : tuple of tuple of str
        Signals in adjacent registers that the device takes only in one request, in order of their addresses.
    handshake : Handshake, optional
        What makes the device take over new values.
    """

    registers: dict[str, Register]
    limits: DeviceLimits
    together: tuple[tuple[str, ...], ...] = ()
    handshake: Handshake | None = None

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
    return RegisterMap(
        registers, limits, _read_together(options, registers), _read_handshake(options, registers, defaults)
    )


def _read_together(options: Options, registers: Mapping[str, Register]) -> tuple[tuple[str, ...], ...]:
    """Take `write_together`: lists of signals in adjacent holding registers."""
    value = options.value("write_together", [])
    if not isinstance(value, list | tuple) or not all(isinstance(group, list | tuple) for group in value):
        refuse("write_together", value, "must be a list of lists", 'Write write_together = [["kp", "ti", "td"]].')
    groups = []
    for group in value:
        for name in group:
            if name not in registers or registers[name].target.table != "holding" or registers[name].bit is not None:
                refuse("write_together", name, "is not a signal in a holding register", "Name signals of registers.")
        ordered = sorted(group, key=lambda name: registers[name].target.address)
        for one, other in pairwise(registers[name].target for name in ordered):
            if (one.end, one.unit) != (other.address, other.unit):
                refuse("write_together", list(group), "are not in adjacent registers", "Name adjacent registers only.")
        groups.append(tuple(ordered))
    return tuple(groups)


def _read_handshake(
    options: Options, registers: Mapping[str, Register], defaults: dict[str, Order]
) -> Handshake | None:
    """Take `handshake`: a coil, or a register or a bit of one, and the `signals` after which it is set."""
    if "handshake" not in options:
        return None
    table = options.table("handshake")
    names = table.value("signals")
    if not isinstance(names, list | tuple) or not names or not set(names) <= registers.keys():
        refuse(table.key("signals"), names, "must be signals of registers", 'Write signals = ["kp", "ti", "td"].')
    return Handshake(_read_register("handshake", table, defaults), frozenset(names))


_EXAMPLES: Final = {
    PV: '{ table = "input", address = 0, type = "int16", scale = 0.1 }',
    OUTPUT: '{ table = "holding", address = 0, type = "int16", scale = 0.1 }',
}


def _read_register(name: str, options: Options, defaults: dict[str, Order]) -> Register:
    table = options.choice("table", get_args(Table))
    coil = table in BIT_TABLES
    bit = options.integer("bit", low=0, high=WORD_BITS - 1) if "bit" in options else None
    kind = options.choice("type", tuple(TYPES), "bool" if coil else "int16" if bit is None else "uint16")
    if bit is not None and kind not in {"int16", "uint16"}:
        refuse(options.key("bit"), bit, f"has no meaning in a {kind}", "Bits are those of one register.")
    if coil != (kind == "bool"):
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
        _read_states(name, "bool" if bit is not None else kind, options),
        bit,
        options.integer("unit", low=0, high=255) if "unit" in options else None,
    )
    register = _with_targets(register, options, defaults)
    _check_register(register, options)
    options.done()
    return register


def _with_targets(register: Register, options: Options, defaults: dict[str, Order]) -> Register:
    """Take where a signal is written, if not where it is read."""
    if "write" in options:
        table = options.table("write")
        table.values = {"type": register.type} | dict(table.values)
        target = _read_register(f"{register.name}.write", table, defaults)
        target = replace(
            target, name=register.name, scale=register.scale, offset=register.offset, states=register.states
        )
        return replace(register, write_to=target)
    if "auto_pulse" not in options and "manual_pulse" not in options:
        return register
    manual, auto = (
        replace(_read_register(f"{register.name}.{key}", options.table(key), defaults), name=register.name)
        for key in ("manual_pulse", "auto_pulse")
    )
    return replace(register, pulses=(manual, auto))


def _read_states(name: str, kind: str, options: Options) -> tuple[tuple[int, ...], tuple[int, ...]] | None:
    """Return the raw values of manual and auto; other signals have none, so the keys are unknown to them."""
    if name != AUTO:
        return None
    if kind.startswith("float"):
        refuse(options.key("type"), kind, "cannot hold a mode", "Use a coil or an integer register.")
    modes = read_modes(options, Modes(auto=(1,), manual=(0,)))
    low, high = raw_limits(kind)
    for key, raws in (("manual_value", modes.manual), ("auto_value", modes.auto)):
        for raw in raws:
            if isinstance(raw, str | float) or not low <= raw <= high:
                refuse(options.key(key), raw, f"is not a value of {kind}", f"Give {low:g} to {high:g}.")
    return tuple(int(raw) for raw in modes.manual), tuple(int(raw) for raw in modes.auto)


def _check_register(register: Register, options: Options) -> None:
    if register.scale == 0.0:
        refuse(options.key("scale"), 0.0, "must not be zero", "Give the value of one count, such as 0.1.")
    if (register.type == "bool" or register.states or register.bit is not None) and not register.plain:
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
    if register.name == HEARTBEAT and (register.type in {"float32", "float64"} or not register.plain):
        refuse(f"{key}.type", register.type, "cannot count", "Use a coil, a bit, or an integer without scale.")
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
    for before, after in pairwise(sorted(registers, key=_place_in_order)):
        if before.bit is not None and after.bit is not None and before.bit != after.bit:
            continue
        if (before.unit, before.table) == (after.unit, after.table) and after.address < before.end:
            refuse(
                f"registers.{after.name}.address",
                after.address,
                f"overlaps registers.{before.name}, which takes {before.place}",
                f"Use {before.end} or higher, or correct the type of registers.{before.name}.",
            )
