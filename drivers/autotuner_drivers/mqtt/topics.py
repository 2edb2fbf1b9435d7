"""The signals of a loop as MQTT topics: configuration, payloads and values. Pure.

A payload is a number, a text, or JSON. A path selects a value in JSON: `DS18B20.Temperature`, `sensors.0.value`.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from autotuner.errors import DeviceRefusedError
from autotuner.ports import AUTO, OUTPUT, PV
from autotuner_drivers.options import refuse
from autotuner_drivers.scaling import Modes, Scaling, read_scaling

if TYPE_CHECKING:
    from autotuner_drivers.options import Options
    from autotuner_drivers.scaling import Raw

_VALUE: Final = re.compile(r"\{value(?::([^}]*))?\}")
_DECIMALS: Final = re.compile(r"\.(\d+)f$")
_DEFAULT_MODES: Final = Modes(auto=("auto",), manual=("manual",))


@dataclass(frozen=True, slots=True)
class TopicSignal:
    """One signal.

    Attributes
    ----------
    name : str
        Name of the signal, such as ``pv``.
    topic : str
        Where the device reports it; empty for a signal that is only written.
    path : str
        Path into a JSON payload; empty where the payload is the value.
    command : str
        Topic that sets it; empty for a signal that is only read.
    payload : str
        What is published there; ``{value}`` or ``{value:.1f}`` is the value.
    request : tuple of (str, str), optional
        Topic and payload that request a report from the device.
    retain : bool
        Whether commands are retained by the broker.
    scaling : Scaling
        Scale and offset, or the modes.
    tolerance : float
        Largest difference between a command and the device's report that confirms it.
    """

    name: str
    topic: str
    path: str
    command: str
    payload: str
    request: tuple[str, str] | None
    retain: bool
    scaling: Scaling
    tolerance: float

    def text(self, value: float) -> str:
        """Return the payload that sets a value."""
        raw = self.scaling.raw(value)
        return _VALUE.sub(lambda match: format(raw, match[1] or ""), self.payload)

    @property
    def step(self) -> float:
        """Step of the values that are sent, by the decimals of the payload; 0 where unknown."""
        match = _VALUE.search(self.payload)
        decimals = _DECIMALS.search(match[1] or "") if match else None
        return abs(self.scaling.scale) * 10.0 ** -int(decimals[1]) if decimals else 0.0

    def confirms(self, reported: float, value: float) -> bool:
        """Return whether a report confirms a command."""
        return abs(reported - value) <= max(self.tolerance, 0.5 * self.step * (1.0 + 1e-9))


def value_of(signal: TopicSignal, payload: bytes) -> tuple[float, str]:
    """Return the value of a payload and an empty text, or NaN and the reason."""
    try:
        raw = _picked(json.loads(payload), signal.path) if signal.path else payload.decode()
    except (ValueError, LookupError, TypeError) as error:
        return math.nan, f"{payload[:60]!r} has no {signal.path or 'text'}: {type(error).__name__}"
    if signal.scaling.modes is None and (raw is None or isinstance(raw, str)):
        raw = _number(raw)
    if not isinstance(raw, int | float | str):
        return math.nan, f"{payload[:60]!r} carries no value"
    try:
        value = signal.scaling.value(raw)
    except DeviceRefusedError as error:
        return math.nan, error.finding
    return value, "" if math.isfinite(value) else f"{payload[:60]!r} is not a number"


def _number(raw: str | None) -> Raw:
    try:
        return float(raw or "nan")
    except ValueError:
        return math.nan


def _picked(value: Any, path: str) -> Any:
    for key in path.split("."):
        value = value[int(key)] if isinstance(value, list) else value[key]
    return value


def read_signals(options: Options) -> dict[str, TopicSignal]:
    """Take the table `topics` out of the driver's options."""
    table = options.table("topics")
    signals = {name: _read_signal(name, table.table(name)) for name in table}
    for name, key in ((PV, "topic"), (OUTPUT, "command")):
        if name not in signals or not getattr(signals[name], key):
            refuse(f"{table.key(name)}.{key}", None, "is missing", f'Add topics.{name}.{key} = "device/...".')
    return signals


def _read_signal(name: str, options: Options) -> TopicSignal:
    topic = options.text("topic") if "topic" in options else ""
    command = options.text("command") if "command" in options else ""
    if not topic and not command:
        refuse(options.key("topic"), None, "is missing", "Give topic, command or both.")
    for key, text in (("topic", topic), ("command", command)):
        if set(text) & {"+", "#", "\0"}:
            refuse(options.key(key), text, "contains a wildcard", "Name one topic.")
    payload = options.text("payload", "{value}")
    signal = TopicSignal(
        name,
        topic,
        options.text("json") if "json" in options else "",
        command,
        payload,
        (options.text("request"), str(options.value("request_payload", ""))) if "request" in options else None,
        options.flag("retain", default=False),
        read_scaling(name, options, _DEFAULT_MODES),
        options.number("tolerance", 0.01, low=0.0),
    )
    try:
        payloads = {signal.text(value) for value in (0.0, 1.0)}
    except (ValueError, TypeError) as error:
        refuse(options.key("payload"), payload, f"cannot be formatted: {error}", 'Write "{value:.1f}".')
    if command and len(payloads) == 1 and name != AUTO:
        refuse(options.key("payload"), payload, "does not contain the value", 'Write "{value:.1f}".')
    options.done()
    return signal
