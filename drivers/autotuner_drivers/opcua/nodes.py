"""The signals of a loop as nodes of an OPC UA server: configuration, data types and values. Pure.

An attribute `Value` carries a status, a source timestamp (when the value was measured) and a server timestamp (OPC
10000-4, 7.11). A value whose status is bad or uncertain, or whose source timestamp is older than `max_age_s`, is NaN.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from autotuner.errors import DeviceRefusedError
from autotuner.ports import AUTO, OUTPUT, PV
from autotuner_drivers.options import refuse
from autotuner_drivers.scaling import HIGHEST_FLOAT32, Modes, Scaling, read_scaling

if TYPE_CHECKING:
    from datetime import datetime

    from autotuner_drivers.options import Options

INTEGER_BITS: Final = {
    "SByte": (-(2**7), 2**7 - 1),
    "Byte": (0, 2**8 - 1),
    "Int16": (-(2**15), 2**15 - 1),
    "UInt16": (0, 2**16 - 1),
    "Int32": (-(2**31), 2**31 - 1),
    "UInt32": (0, 2**32 - 1),
    "Int64": (-(2**63), 2**63 - 1),
    "UInt64": (0, 2**64 - 1),
}
"""Lowest and highest value by data type."""
FLOATS: Final = {"Float": "float32", "Double": "float64"}
TEXT: Final = "String"
BOOLEAN: Final = "Boolean"
BAD: Final = 2
"""Severity of a status, its two highest bits: 0 good, 1 uncertain, 2 bad."""
_DEFAULT_MODES: Final = Modes(auto=(1,), manual=(0,))


@dataclass(frozen=True, slots=True)
class Call:
    """A method that sets a signal: object, method and arguments; ``"{value}"`` is replaced by the value."""

    owner: str
    method: str
    arguments: tuple[object, ...] = ()


@dataclass(frozen=True, slots=True)
class NodeSignal:
    """One signal.

    Attributes
    ----------
    name : str
        Name of the signal, such as ``pv``.
    node : str
        Node identifier, such as ``ns=2;s=TIC101.PV``, or a browse path from the root's `Objects` folder.
    write_node : str
        Node that is written; `node` unless the device reads and writes a value at different places.
    scaling : Scaling
        Scale and offset, or the modes.
    max_age_s : float
        Oldest source timestamp that counts as a measurement, s.
    calls : mapping
        Methods by value: 1.0 and 0.0 for a mode; None for any value.
    """

    name: str
    node: str
    write_node: str
    scaling: Scaling
    max_age_s: float
    calls: dict[float | None, Call]

    def call(self, value: float) -> Call | None:
        """Return the method that sets this value; None when the node is written."""
        return self.calls.get(value, self.calls.get(None))


def read_signals(options: Options) -> dict[str, NodeSignal]:
    """Take the table `nodes` out of the driver's options; `pv` and `output` are required."""
    table = options.table("nodes")
    signals = {name: _read_signal(name, table.table(name)) for name in table}
    for name in (PV, OUTPUT):
        if name not in signals:
            refuse(table.key(name), None, "is missing", f'Add nodes.{name} = {{ node = "ns=2;s=TIC101.{name}" }}.')
    return signals


def _read_signal(name: str, options: Options) -> NodeSignal:
    node = options.text("node")
    calls: dict[float | None, Call] = {}
    for key, value in (("auto_call", 1.0), ("manual_call", 0.0)) if name == AUTO else (("call", None),):
        if key in options:
            calls[value] = _read_call(options.table(key))
    if name == AUTO and len(calls) == 1:
        missing = "manual_call" if 1.0 in calls else "auto_call"
        refuse(options.key(missing), None, "is missing", "Give auto_call and manual_call, or neither.")
    signal = NodeSignal(
        name,
        node,
        options.text("write_node", node),
        read_scaling(name, options, _DEFAULT_MODES),
        options.number("max_age_s", math.inf, low=0.001, unit="s") if "max_age_s" in options else math.inf,
        calls,
    )
    options.done()
    return signal


def _read_call(options: Options) -> Call:
    arguments = options.value("arguments", [])
    if not isinstance(arguments, list | tuple):
        refuse(options.key("arguments"), arguments, "must be a list", 'Write arguments = ["{value}"], for instance.')
    call = Call(options.text("object"), options.text("method"), tuple(arguments))
    options.done()
    return call


def is_identifier(node: str) -> bool:
    """Return whether a node is named by its identifier and not by a browse path."""
    return any(node.startswith(start) for start in ("ns=", "nsu=", "i=", "s=", "g=", "b="))


def value_of(signal: NodeSignal, data: Any, unchanged_s: float = 0.0) -> tuple[float, str]:
    """Return the value of a `DataValue` and an empty text, or NaN and the reason.

    Parameters
    ----------
    signal : NodeSignal
        The signal.
    data : asyncua.ua.DataValue
        Response of the server.
    unchanged_s : float
        How long the source timestamp has been the same, s.

    Raises
    ------
    DeviceRefusedError
        The node does not hold a number, or holds a mode that is neither automatic nor manual.
    """
    severity = data.StatusCode.value >> 30 if data.StatusCode is not None else 0
    if severity:
        quality = "bad" if severity >= BAD else "uncertain"
        return math.nan, f"the server reports {quality} quality: {data.StatusCode.name}"
    age_s = max(_age_s(data.SourceTimestamp, data.ServerTimestamp), unchanged_s)
    if age_s > signal.max_age_s:
        return math.nan, f"its source timestamp is {age_s:.1f} s old"
    raw = data.Value.Value if data.Value is not None else None
    if raw is None:
        return math.nan, "the node holds no value"
    if signal.scaling.modes is None and not isinstance(raw, int | float):
        raise DeviceRefusedError(
            f"holds a {type(raw).__name__}, not a number", field=signal.name, value=raw, remedy="Correct the node."
        )
    return signal.scaling.value(raw), ""


def _age_s(source: datetime | None, server: datetime | None) -> float:
    """Return the age of a value at the response, s, by the server's own clock; 0 without a source timestamp."""
    return 0.0 if source is None or server is None else (server - source).total_seconds()


def raw_of(signal: NodeSignal, kind: str, value: float) -> bool | int | float | str:
    """Return the raw value of a write, in the data type of the node.

    Raises
    ------
    DeviceRefusedError
        The value does not fit the data type; it is never wrapped or clipped.
    """
    raw = signal.scaling.raw(value)
    if kind == TEXT:
        return str(raw)
    if isinstance(raw, str):
        raise _refused(signal, value, f"is the text {raw!r}, but the node holds a {kind}")
    if kind == BOOLEAN:
        if raw not in {0, 1}:
            raise _refused(signal, value, "can only be 0 or 1")
        return bool(raw)
    low, high = raw_limits(kind)
    if not low <= round(raw) <= high:
        raise _refused(signal, value, f"does not fit the node's data type {kind}, {low:g} to {high:g}")
    return float(raw) if kind in FLOATS else round(raw)


def raw_limits(kind: str) -> tuple[float, float]:
    """Return the lowest and highest raw number of a data type; infinite for an unknown type."""
    if kind == BOOLEAN:
        return 0, 1
    if kind == "Float":
        return -HIGHEST_FLOAT32, HIGHEST_FLOAT32
    return INTEGER_BITS.get(kind, (-math.inf, math.inf))


def _refused(signal: NodeSignal, value: float, message: str) -> DeviceRefusedError:
    return DeviceRefusedError(
        message, field=signal.name, value=value, remedy="Correct scale, offset and the loop's limits, or the node."
    )
