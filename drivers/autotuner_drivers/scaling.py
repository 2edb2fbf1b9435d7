"""Conversion between raw numbers of a device and values in engineering units.

    value = raw * scale + offset                    raw = (value - offset) / scale

A mode is a raw value. Several raw values may mean automatic (auto, cascade, remote) or manual; the first of each is
written. Raw values are numbers, booleans or texts, depending on the protocol. Invariant: pure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from autotuner.errors import DeviceRefusedError
from autotuner.ports import AUTO
from autotuner_drivers.options import refuse

if TYPE_CHECKING:
    from autotuner_drivers.options import Options

Raw = float | int | bool | str

HIGHEST_FLOAT32: Final = 3.4028234663852886e38
"""Largest finite number of 32 bits (IEEE 754), which REAL of a PLC and Float of OPC UA are."""
FLOAT_BITS: Final = {"float32": 23, "float64": 52}
"""Bits of the mantissa (IEEE 754)."""


@dataclass(frozen=True, slots=True)
class Modes:
    """Raw values of `auto`: those that mean automatic, and those that mean manual."""

    auto: tuple[Raw, ...]
    manual: tuple[Raw, ...]

    def value(self, raw: Raw) -> float:
        """Return 1.0 for automatic and 0.0 for manual; raise `DeviceRefusedError` for any other mode."""
        for state, raws in ((1.0, self.auto), (0.0, self.manual)):
            if any(_same(raw, known) for known in raws):
                return state
        raise DeviceRefusedError(
            f"is neither automatic ({', '.join(map(str, self.auto))}) nor manual ({', '.join(map(str, self.manual))})",
            field=AUTO,
            value=raw,
            remedy="Switch the device to one of the two modes, or correct auto_value and manual_value.",
        )

    def raw(self, value: float) -> Raw:
        """Return the raw value for 1.0 or 0.0."""
        if value not in {0.0, 1.0}:
            raise DeviceRefusedError("can only be 0 or 1", field=AUTO, value=value, remedy="Give 0 or 1.")
        return (self.auto if value else self.manual)[0]


def _same(raw: Raw, known: Raw) -> bool:
    if isinstance(raw, str) or isinstance(known, str):
        return str(raw).strip().casefold() == str(known).strip().casefold()
    return float(raw) == float(known)


@dataclass(frozen=True, slots=True)
class Scaling:
    """Scale and offset of a signal, or its modes."""

    scale: float = 1.0
    offset: float = 0.0
    modes: Modes | None = None

    def value(self, raw: Raw) -> float:
        """Return the value of a raw number or mode."""
        return self.modes.value(raw) if self.modes else float(raw) * self.scale + self.offset

    def raw(self, value: float) -> Raw:
        """Return the raw number or mode of a value."""
        return self.modes.raw(value) if self.modes else (value - self.offset) / self.scale

    def limits(self, low: float, high: float) -> tuple[float, float]:
        """Return the lowest and highest value for raw numbers from `low` to `high`."""
        bounds = (low * self.scale + self.offset, high * self.scale + self.offset)
        return min(bounds), max(bounds)

    def resolution(self, kind: str, value: float) -> float:
        """Return the resolution around `value`, in its unit; `kind` is float32, float64 or an integer type."""
        if self.modes:
            return 0.0
        if kind not in FLOAT_BITS:
            return abs(self.scale)
        raw = abs((value - self.offset) / self.scale)
        return abs(self.scale) * 2.0 ** (math.frexp(raw)[1] - 1 - FLOAT_BITS[kind])


def read_scaling(name: str, options: Options, modes: Modes) -> Scaling:
    """Take `scale` and `offset` from a signal's options; for `auto` its modes, with `modes` as the default."""
    if name == AUTO:
        return Scaling(modes=read_modes(options, modes))
    scale = options.number("scale", 1.0)
    if scale == 0.0:
        refuse(options.key("scale"), 0.0, "must not be zero", "Give the value of one count, such as 0.1.")
    return Scaling(scale, options.number("offset", 0.0))


def read_modes(options: Options, default: Modes) -> Modes:
    """Take `auto_value` and `manual_value`, each one raw value or a list, the first of which is written."""
    modes = Modes(_raws(options, "auto_value", default.auto), _raws(options, "manual_value", default.manual))
    for raw in modes.auto:
        if any(_same(raw, other) for other in modes.manual):
            refuse(options.key("auto_value"), raw, "equals manual_value", "Give the two modes different values.")
    return modes


def _raws(options: Options, key: str, default: tuple[Raw, ...]) -> tuple[Raw, ...]:
    value = options.value(key, list(default))
    raws = tuple(value) if isinstance(value, list | tuple) else (value,)
    if not raws or any(not isinstance(raw, int | float | bool | str) or raw != raw for raw in raws):  # noqa: PLR0124
        refuse(options.key(key), value, "must be a value or a list of values", f"Write {key} = 1, for instance.")
    return raws
