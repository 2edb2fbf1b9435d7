"""The protocol of the Arduino Temperature Control Lab, after its firmware.

    T1            23.154        temperature, degC
    Q1 40.500     40.500        set heater, %; answers what it has set
    R1            40.500        heater as set
    VER           TCLab Firmware 2.0.1 Arduino Uno

Opening the port resets the board: 2 s of silence, heaters off. A command that it does not know switches both heaters
off and is answered by its first word in capitals, so one damaged byte in `T1` stops the heating without an error; hence
`volatile_output`. It has no watchdog: the heater stays on when its master dies.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from autotuner.ports import OUTPUT, PV
from autotuner_drivers.line_protocol import Exchange, check_held, check_range, number, split_lines, within

if TYPE_CHECKING:
    from autotuner_drivers.line_protocol import Steps
    from autotuner_drivers.options import Options

HEATER: Final = (0.0, 100.0)
SENSOR: Final = (-49.9, 278.9)
"""Readings at the ends of the converter mean a sensor that is broken or shorted."""
RESOLUTION: Final = 0.001


class TcLab:
    """One heater and its sensor.

    Parameters
    ----------
    channel : {1, 2}
        Which of the two.
    read_back : bool
        Whether the firmware knows `R1`; those before 1.3 do not.
    """

    pause_s: float = 0.0
    settle_s: float = 2.2
    volatile_output: bool = True

    def __init__(self, channel: int, *, read_back: bool) -> None:
        self._channel = channel
        self._read_back = read_back

    @property
    def readable(self) -> frozenset[str]:
        """The temperature, and the heater where it can be read back."""
        return frozenset({PV, OUTPUT} if self._read_back else {PV})

    @property
    def writable(self) -> frozenset[str]:
        """The heater."""
        return frozenset({OUTPUT})

    def split(self, buffer: bytes) -> tuple[list[bytes], bytes]:
        """Cut into lines."""
        return split_lines(buffer)

    def enter(self) -> Steps:
        """Ask for the firmware's name, which shows that the board has come up."""
        return (yield Exchange(b"VER\n", lambda line: 0.0 if b"TCLAB" in line.upper() else None))

    def leave(self, found: float) -> Steps:
        """Do nothing: writing changes nothing but the output."""
        yield from ()
        return found

    def read(self, name: str) -> Steps:
        """Read the temperature or the heater."""
        if name == OUTPUT:
            return (yield self._ask("R"))
        return within((yield self._ask("T")), SENSOR)

    def write(self, name: str, value: float) -> Steps:
        """Set the heater; what it answers, and what it holds, must be what was sent."""
        check_range(name, value, HEATER)
        answered = yield Exchange(f"Q{self._channel} {value:.3f}\n".encode(), number)
        held = check_held(name, answered, value, RESOLUTION)
        return check_held(name, (yield self._ask("R")), value, RESOLUTION) if self._read_back else held

    def _ask(self, letter: str) -> Exchange:
        return Exchange(f"{letter}{self._channel}\n".encode(), number)


def read_tclab(options: Options) -> TcLab:
    """Take the protocol's options: `channel` = 1 or 2, `read_back` = true."""
    return TcLab(options.choice("channel", (1, 2), 1), read_back=options.flag("read_back", default=True))
