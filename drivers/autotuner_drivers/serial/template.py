r"""Protocol of text lines, defined by the user in the configuration.

Options::

    line_end = "\n"                        # after each command
    error = "ERR.*"                       # an answer by which the device refuses; default none
    pause_s = 0.0                         # silence that the device needs between two commands
    settle_s = 0.0                        # silence of the device after its port was opened
    volatile_output = false               # true: set the output again after a command that was not understood
    checksum = { kind = "xor", before = "*", skip = 1 }    # default none; kinds: xor, sum, lrc, crc16

    [loops.NAME.device.signals]
    pv = { read = "PV?", answer = "([-+.0-9]+)", valid = [-50.0, 300.0] }
    output = { read = "OUT?", write = "OUT {output:.2f}", confirm = "OK" }
    set_point = { read = "SP?", write = "SP {set_point:.0f}", scale = 0.1 }
    auto = { read = "MODE?", write = "MODE {auto}", auto_value = "AUTO", manual_value = "MAN" }

`read` and `write` are commands; in `write`, the signal's name in braces is replaced by its value, in Python's format
syntax. The value is the device's number times `scale` plus `offset`; `valid` and `tolerance` are values. A `checksum`
ends every command and answer, as two hexadecimal digits (crc16: four) after the text `before`; the first `skip`
characters of a message do not count. `answer` is a regular expression of a whole line whose first group is the number,
by default the whole line; readings outside of `valid` are NaN. `confirm` is a regular expression of the line that
answers a write; without it a write has no answer. A signal that can be read is read after a write, and must match the
written value to `tolerance`, default 0.01.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import reduce
from operator import xor
from typing import TYPE_CHECKING, Final

from autotuner.errors import DeviceRefusedError
from autotuner.ports import OUTPUT, PV
from autotuner_drivers.options import refuse
from autotuner_drivers.scaling import Modes, Scaling, read_scaling
from autotuner_drivers.serial.protocol import (
    NO_RANGES,
    DeniedError,
    Exchange,
    check_held,
    nothing,
    number,
    split_lines,
    within,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from autotuner_drivers.options import Options
    from autotuner_drivers.scaling import Raw
    from autotuner_drivers.serial.protocol import Steps

ANY_LINE: Final = "(.+)"
MOST_SKIPPED: Final = 8
"""Most characters that a checksum may skip."""
_MODES: Final = Modes(auto=(1,), manual=(0,))
_DECIMALS: Final = re.compile(r"\{\w+:[^}]*\.(\d+)f\}")


@dataclass(frozen=True, slots=True)
class Signal:
    """Commands and parsers of one signal; `read` or `write` is empty for a signal that cannot be read or written."""

    name: str
    read: str
    answer: re.Pattern[bytes]
    write: str
    confirm: re.Pattern[bytes] | None
    valid: tuple[float, float]
    tolerance: float
    scaling: Scaling

    def value(self, text: bytes) -> float | None:
        """Return the value of a number or a mode in an answer; None when it is neither."""
        modes = self.scaling.modes
        if modes is None or not any(isinstance(raw, str) for raw in (*modes.auto, *modes.manual)):
            raw: Raw | None = number(text)
        else:
            raw = text.decode(errors="replace")
        try:
            return None if raw is None else self.scaling.value(raw)
        except DeviceRefusedError as error:  # an unknown or damaged mode: the read is repeated
            raise DeniedError(error.message, field=self.name, value=raw, remedy=error.remedy) from error


def _crc16(message: bytes) -> int:
    """Return the CRC-16 of Modbus over serial line V1.02, section 6.2.2: polynomial 0xA001, initial value 0xFFFF."""
    crc = 0xFFFF
    for byte in message:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
    return crc


KINDS: Final[dict[str, tuple[Callable[[bytes], int], int]]] = {
    "xor": (lambda message: reduce(xor, message, 0), 2),
    "sum": (lambda message: sum(message) % 256, 2),
    "lrc": (lambda message: -sum(message) % 256, 2),
    "crc16": (_crc16, 4),
}
"""Checksum functions and the number of their hexadecimal digits."""


@dataclass(frozen=True, slots=True)
class Checksum:
    """End of every message: `before` and the checksum in hexadecimal; the first `skip` characters do not count."""

    kind: str
    before: bytes
    skip: int

    def added(self, message: bytes) -> bytes:
        """Return a message with its checksum."""
        check, digits = KINDS[self.kind]
        return message + self.before + b"%0*X" % (digits, check(message[self.skip :]))

    def stripped(self, line: bytes) -> bytes | None:
        """Return a message without its checksum; None for a wrong checksum."""
        message = line[: -(len(self.before) + KINDS[self.kind][1])]
        return message if message and self.added(message).upper() == line.upper() else None


class Template:
    """A protocol defined in the configuration.

    Parameters
    ----------
    signals : dict
        The signals by name.
    line_end : str
        End of a command.
    error : re.Pattern, optional
        Pattern of an answer by which the device refuses.
    checksum : Checksum, optional
        Checksum at the end of every command and answer.
    pause_s, settle_s, volatile_output
        As in `LineProtocol`.
    """

    def __init__(
        self,
        signals: dict[str, Signal],
        line_end: str,
        error: re.Pattern[bytes] | None,
        checksum: Checksum | None,
        *,
        pause_s: float,
        settle_s: float,
        volatile_output: bool,
    ) -> None:
        self._signals, self._line_end, self._error, self._checksum = signals, line_end, error, checksum
        self.ranges: Mapping[str, tuple[float, float]] = NO_RANGES
        self.pause_s, self.settle_s, self.volatile_output = pause_s, settle_s, volatile_output

    @property
    def readable(self) -> frozenset[str]:
        """Signals with a read command."""
        return frozenset(name for name, signal in self._signals.items() if signal.read)

    @property
    def writable(self) -> frozenset[str]:
        """Signals with a write command."""
        return frozenset(name for name, signal in self._signals.items() if signal.write)

    def step(self, name: str) -> float:
        """Return the resolution of transmitted values, by the decimals of the write command; 0 where unknown."""
        signal = self._signals[name]
        decimals = _DECIMALS.search(signal.write)
        return abs(signal.scaling.scale) * 10.0 ** -int(decimals.group(1)) if decimals else 0.0

    def split(self, buffer: bytes) -> tuple[list[bytes], bytes]:
        """Split into lines."""
        return split_lines(buffer)

    def enter(self) -> Steps:
        """Read the PV to check that the device is present."""
        return (yield from self.read(PV))

    def leave(self, found: float) -> Steps:
        """Do nothing."""
        return nothing(found)

    def read(self, name: str) -> Steps:
        """Send the command and parse the number in the answer."""
        signal = self._signals[name]
        value = yield Exchange(self._command(signal.read), lambda line: self._number(signal, line))
        return within(value, signal.valid)

    def write(self, name: str, value: float) -> Steps:
        """Send the command, check its confirmation, and read the signal back where possible."""
        signal = self._signals[name]
        command = self._command(signal.write.format(**{name: signal.scaling.raw(value)}))
        yield Exchange(command, (lambda line: self._confirmed(signal, line)) if signal.confirm else None)
        if signal.read:
            return check_held(name, (yield from self.read(name)), value, signal.tolerance)
        return value

    def _command(self, text: str) -> bytes:
        message = text.encode()
        return (self._checksum.added(message) if self._checksum else message) + self._line_end.encode()

    def _number(self, signal: Signal, line: bytes) -> float | None:
        message = self._checked(signal, line)
        match = None if message is None else signal.answer.fullmatch(message)
        return signal.value(match.group(1)) if match else None

    def _confirmed(self, signal: Signal, line: bytes) -> float | None:
        message = self._checked(signal, line)
        return 0.0 if message is not None and signal.confirm and signal.confirm.fullmatch(message) else None

    def _checked(self, signal: Signal, line: bytes) -> bytes | None:
        """Return an answer without its checksum, None for a wrong checksum; raise when the answer is a refusal."""
        message = self._checksum.stripped(line) if self._checksum else line
        if message is not None:
            self._check_error(signal, message)
        return message

    def _check_error(self, signal: Signal, line: bytes) -> None:
        if self._error and self._error.fullmatch(line):
            raise DeniedError(
                f"was refused by the device: {line.decode(errors='replace')}",
                field=signal.name,
                remedy="Look the answer up in the device's manual.",
            )


def read_template(options: Options) -> Template:
    """Take the protocol's options; check that every command can be formatted."""
    table = options.table("signals")
    signals = {name: _signal(name, table.table(name)) for name in table}
    for name, key in ((PV, "read"), (OUTPUT, "write")):
        if name not in signals or not getattr(signals[name], key):
            refuse(f"{table.key(name)}.{key}", None, "is missing", f"Add the command that {key}s the {name}.")
    return Template(
        signals,
        options.text("line_end", "\n"),
        _pattern(options, "error", None),
        _read_checksum(options.table("checksum")) if "checksum" in options else None,
        pause_s=options.number("pause_s", 0.0, low=0.0, high=10.0, unit="s"),
        settle_s=options.number("settle_s", 0.0, low=0.0, high=60.0, unit="s"),
        volatile_output=options.flag("volatile_output", default=False),
    )


def _read_checksum(options: Options) -> Checksum:
    before = options.value("before", "")
    if not isinstance(before, str):
        refuse(options.key("before"), before, "must be a text", 'Write before = "*", or leave it out.')
    checksum = Checksum(
        options.choice("kind", tuple(KINDS)), before.encode(), options.integer("skip", 0, low=0, high=MOST_SKIPPED)
    )
    options.done()
    return checksum


def _signal(name: str, options: Options) -> Signal:
    answer = _pattern(options, "answer", ANY_LINE)
    if answer is None or answer.groups < 1:
        refuse(options.key("answer"), answer and answer.pattern, "has no group", 'Write "([-+.0-9]+)", for instance.')
    scaling = read_scaling(name, options, _MODES)
    signal = Signal(
        name,
        options.text("read") if "read" in options else "",
        answer,
        _write_command(name, options, scaling),
        _pattern(options, "confirm", None),
        options.span("valid", (-math.inf, math.inf)),
        options.number("tolerance", 0.01, low=0.0),
        scaling,
    )
    options.done()
    return signal


def _write_command(name: str, options: Options, scaling: Scaling) -> str:
    if "write" not in options:
        return ""
    command = options.text("write")
    try:
        commands = {command.format(**{name: scaling.raw(value) if scaling.modes else value}) for value in (0.0, 1.0)}
    except (KeyError, IndexError, ValueError, AttributeError, TypeError) as error:
        refuse(options.key("write"), command, f"cannot be formatted: {error}", f'Write "... {{{name}:.2f}}".')
    if len(commands) == 1:
        refuse(options.key("write"), command, "does not contain the value", f'Write "... {{{name}:.2f}}".')
    return command


def _pattern(options: Options, key: str, default: str | None) -> re.Pattern[bytes] | None:
    if default is None and key not in options:
        return None
    text = options.text(key, default)
    try:
        return re.compile(text.encode())
    except re.error as error:
        refuse(
            options.key(key),
            text,
            f"is not a regular expression: {error}",
            "Correct the expression at the named position.",
        )
