"""Protocol of the Arduino Temperature Control Lab, from its firmware.

    T1            23.154        temperature, degC
    Q1 40.500     40.500        set heater, %; answers what it has set
    P1 200.00     200.00        duty of the heater at 100 %, 0 to 255
    R1            40.500        heater as set
    VER           TCLab Firmware 2.0.1 Arduino Uno

Opening the port resets the board: 2 s of silence, heaters off. An unknown command switches both heaters off and is
answered by its first word in capitals, so one damaged byte in `T1` stops the heating without an error; hence
`volatile_output`. One flipped bit makes `P1` of `Q1`, `R1` or `T1` and weakens the heater permanently without any other
sign. Therefore numbers are recognised by their decimals, and each write of the heater sets the duty too (firmware 2 on)
and reads the heater last. The board has no watchdog: the heater stays on when its master stops.
"""

from __future__ import annotations

import re
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from autotuner.ports import OUTPUT, PV
from autotuner_drivers.serial.protocol import Exchange, check_held, check_range, fixed_number, split_lines, within

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner_drivers.options import Options
    from autotuner_drivers.serial.protocol import Steps

HEATER: Final = (0.0, 100.0)
SENSOR: Final = (-49.9, 278.9)
"""Plausible temperatures, degC; readings at the ends of the converter mean a broken or shorted sensor."""
DUTY_DECIMALS: Final = 2
"""Decimals of the duty that the firmware parses."""
DUTY_SINCE: Final = 2
"""Major version of the firmware that knows the duty command; to older boards the command may be unknown."""
DUTIES: Final = {1: 200.0, 2: 100.0}
"""Duties after a reset of the board, by channel, 0 to 255."""


class TcLab:
    """One heater and its sensor.

    Parameters
    ----------
    channel : {1, 2}
        Channel of the board.
    duty : float
        Duty of the heater at 100 %, 0 to 255.
    decimals : int
        Decimals of temperatures and heaters in the answers: 3, in old firmware 2.
    read_back : bool
        Whether the firmware knows `R1`; those before 1.3 do not.
    """

    pause_s: float = 0.0
    settle_s: float = 2.2
    ranges: Mapping[str, tuple[float, float]] = MappingProxyType({OUTPUT: HEATER})
    volatile_output: bool = True

    def __init__(self, channel: int, duty: float, decimals: int, *, read_back: bool) -> None:
        self._channel = channel
        self._decimals = decimals
        self._duty = duty
        self._read_back = read_back
        self._knows_duty = False

    @property
    def readable(self) -> frozenset[str]:
        """The temperature, and the heater where the firmware can report it."""
        return frozenset({PV, OUTPUT} if self._read_back else {PV})

    @property
    def writable(self) -> frozenset[str]:
        """The heater."""
        return frozenset({OUTPUT})

    def split(self, buffer: bytes) -> tuple[list[bytes], bytes]:
        """Cut into lines."""
        return split_lines(buffer)

    def enter(self) -> Steps:
        """Read the firmware version to check that the board is up and whether it knows the duty command."""
        version = yield Exchange(b"VER\n", firmware)
        self._knows_duty = version >= DUTY_SINCE
        return version

    def leave(self, found: float) -> Steps:
        """Do nothing: a write changes nothing but the output."""
        yield from ()
        return found

    def read(self, name: str) -> Steps:
        """Read the temperature or the heater."""
        if name == OUTPUT:
            return (yield self._ask("R"))
        return within((yield self._ask("T")), SENSOR)

    def write(self, name: str, value: float) -> Steps:
        """Set the heater and its duty; check that the answers and the heater match the request."""
        check_range(name, value, HEATER)
        held = check_held(name, (yield self._set("Q", value, self._decimals)), value, self._tolerance)
        if self._knows_duty:
            check_held("duty", (yield self._set("P", self._duty, DUTY_DECIMALS)), self._duty, 10.0**-DUTY_DECIMALS)
        return check_held(name, (yield self._ask("R")), value, self._tolerance) if self._read_back else held

    @property
    def _tolerance(self) -> float:
        return 10.0**-self._decimals

    def _set(self, letter: str, value: float, decimals: int) -> Exchange:
        return Exchange(f"{letter}{self._channel} {value:.{decimals}f}\n".encode(), fixed_number(decimals))

    def _ask(self, letter: str) -> Exchange:
        return Exchange(f"{letter}{self._channel}\n".encode(), fixed_number(self._decimals))


def firmware(line: bytes) -> float | None:
    """Return the major version of the firmware; 0 for another make of board, None for any other line."""
    match = re.match(rb"TCLAB FIRMWARE (\d+)\.", line.upper())
    if match:
        return float(match.group(1))
    return 0.0 if b"TCLAB" in line.upper() else None


def read_tclab(options: Options) -> TcLab:
    """Take the options: `channel` = 1 or 2, `duty` = 200.0 (100.0 of channel 2), `decimals` = 3, `read_back` = true."""
    channel = options.choice("channel", (1, 2), 1)
    duty = options.number("duty", DUTIES[channel], low=1.0, high=255.0)
    decimals = options.integer("decimals", 3, low=1, high=6)
    return TcLab(channel, duty, decimals, read_back=options.flag("read_back", default=True))
