"""Protocol EI-Bisynch of Eurotherm's 800, 900 and 2000 series (ANSI X3.28-2.5-A4).

    poll      EOT g g u u c c ENQ                 STX c c data ETX BCC, or EOT: no such parameter
    select    EOT g g u u STX c c data ETX BCC    ACK, or NAK

`g` group and `u` unit of the device, one digit each, sent twice; `c c` the parameter; BCC the exclusive or of
everything after STX up to and including ETX. PV reading, OP output %, SL set point, XP, TI, TD of the device's
controller, SW status word as `>hhhh`, whose bit 15 is manual. The answer repeats the parameter of its poll. An
acknowledgement is confirmed by a poll of the written parameter, because a device in auto acknowledges an output and
ignores it.
"""

from __future__ import annotations

import re
from functools import partial, reduce
from operator import xor
from typing import TYPE_CHECKING, Final

from autotuner.ports import AUTO, OUTPUT, PV, SET_POINT
from autotuner_drivers.serial.protocol import NO_RANGES, DeniedError, Exchange, check_held, nothing, number, within

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner_drivers.options import Options
    from autotuner_drivers.serial.protocol import Steps

STX, ETX, EOT, ENQ, ACK, NAK = b"\x02", b"\x03", b"\x04", b"\x05", b"\x06", b"\x15"
MANUAL: Final = 0x8000
"""Bit of the status word: the loop is in manual."""
STATUS: Final = "SW"
PARAMETERS: Final = {PV: "PV", OUTPUT: "OP", SET_POINT: "SL", "kp": "XP", "ti": "TI", "td": "TD"}
"""Parameters by signal; the gains are in the device's own form: proportional band in %, times in s."""

_MESSAGE: Final = re.compile(rb"\x02[^\x03]*\x03.|[\x04\x06\x15]", re.DOTALL)


def check_character(content: bytes) -> bytes:
    """Return the BCC of the bytes after STX up to and including ETX."""
    return bytes([reduce(xor, content, 0)])


def split_messages(buffer: bytes) -> tuple[list[bytes], bytes]:
    """Split into answers: STX to BCC, or a single EOT, ACK or NAK; bytes in between are noise."""
    messages, end = [], 0
    while match := _MESSAGE.search(buffer, end):
        if STX in buffer[end : match.start()]:  # an incomplete answer with a control byte as noise or BCC
            break
        messages.append(match.group())
        end = match.end()
    return messages, buffer[end:]


def understand(parameter: str, message: bytes) -> float | None:
    """Return the value in the answer to a poll; None for a damaged message or one of another parameter."""
    if message == EOT:
        raise DeniedError(
            "is not a parameter of the device",
            field=parameter,
            remedy="Check the model and the signals of the loop; on a two-wire line set echo = true.",
        )
    content = message[1:-1]
    if message[:1] != STX or check_character(content) != message[-1:] or content[:2] != parameter.encode():
        return None
    data = content[2:-1].strip()
    return float(int(data[1:], 16)) if re.fullmatch(rb">[0-9A-Fa-f]{4}", data) else number(data)


def acknowledged(parameter: str, message: bytes) -> float | None:
    """Return 0 for ACK; raise `DeniedError` for NAK."""
    if message == NAK:
        raise DeniedError(
            "was not acknowledged by the device", field=parameter, remedy="Check the value against the device's limits."
        )
    return 0.0 if message == ACK else None


class Bisynch:
    """One device.

    Parameters
    ----------
    group, unit : int
        Address of the device, 0 to 9 each.
    decimals : int
        Decimals of transmitted values, as configured in the device's display.
    valid : tuple of float
        Plausible range of the PV; a value outside means a broken sensor and is NaN.
    """

    pause_s: float = 0.005
    settle_s: float = 0.0
    ranges: Mapping[str, tuple[float, float]] = NO_RANGES
    volatile_output: bool = False

    def __init__(self, group: int, unit: int, decimals: int, valid: tuple[float, float]) -> None:
        self._address = f"{group}{group}{unit}{unit}".encode()
        self._decimals = decimals
        self._valid = valid

    @property
    def readable(self) -> frozenset[str]:
        """All parameters, and the mode."""
        return frozenset(PARAMETERS) | {AUTO}

    @property
    def writable(self) -> frozenset[str]:
        """All but the PV."""
        return self.readable - {PV}

    def step(self, name: str) -> float:  # noqa: ARG002 - it is the same for all parameters
        """Return the resolution of transmitted values."""
        return 10.0**-self._decimals

    def split(self, buffer: bytes) -> tuple[list[bytes], bytes]:
        """Split into answers."""
        return split_messages(buffer)

    def enter(self) -> Steps:
        """Poll the status word to check that the device is present."""
        return (yield self._poll(STATUS))

    def leave(self, found: float) -> Steps:
        """Do nothing: a write changes nothing but its signal."""
        return nothing(found)

    def read(self, name: str) -> Steps:
        """Poll a parameter."""
        if name == AUTO:
            return 0.0 if int((yield self._poll(STATUS))) & MANUAL else 1.0
        value = yield self._poll(PARAMETERS[name])
        return within(value, self._valid) if name == PV else value

    def write(self, name: str, value: float) -> Steps:
        """Select a parameter and poll it; of the status word change only the mode bit."""
        if name == AUTO:
            return (yield from self._write_mode(manual=value == 0.0))
        parameter = PARAMETERS[name]
        yield self._select(parameter, f"{value:.{self._decimals}f}")
        return check_held(name, (yield self._poll(parameter)), value, 0.6 * 10.0**-self._decimals)

    def _write_mode(self, *, manual: bool) -> Steps:
        status = int((yield self._poll(STATUS)))
        wanted = status | MANUAL if manual else status & ~MANUAL
        yield self._select(STATUS, f">{wanted:04X}")
        held = int((yield self._poll(STATUS))) & MANUAL
        check_held(AUTO, float(held == 0), float(not manual), 0.0)
        return float(not manual)

    def _poll(self, parameter: str) -> Exchange:
        return Exchange(EOT + self._address + parameter.encode() + ENQ, partial(understand, parameter))

    def _select(self, parameter: str, data: str) -> Exchange:
        content = parameter.encode() + data.encode() + ETX
        request = EOT + self._address + STX + content + check_character(content)
        return Exchange(request, partial(acknowledged, parameter))


def read_bisynch(options: Options) -> Bisynch:
    """Take the protocol's options: `group` = 0, `unit` = 1, `decimals` = 1, `valid` = [-1999.0, 9998.0]."""
    return Bisynch(
        options.integer("group", 0, low=0, high=9),
        options.integer("unit", 1, low=0, high=9),
        options.integer("decimals", 1, low=0, high=4),
        options.span("valid", (-1999.0, 9998.0)),
    )
