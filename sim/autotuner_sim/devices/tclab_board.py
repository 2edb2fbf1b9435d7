"""A board that speaks the protocol of the Arduino Temperature Control Lab, around one simulated heater or two.

    T1 T2         23.154            temperature, degC
    T1B T2B       4 bytes           the same, little-endian float32, without an end of line
    Q1 x  Q2 x    40.500            set heater, %, clipped to 0..100; returns the value set
    Q1B x Q2B x   4 bytes           the same in binary; firmware 2.0.1's Q2B sets heater 1
    R1 R2         40.500            heater as set
    P1 x  P2 x    200.00            duty of the heater at 100 %, 0..255; 200 and 100 at the start
    SCAN          four lines        T1 T2 Q1 Q2
    LED x         50.00
    VER           TCLab Firmware 2.0.1 Arduino Uno
    A, X          Start, Stop       both switch the heaters off
    other         the word in capitals, and both heaters go off

A carriage return or a line feed ends a command; empty lines are ignored; case does not matter; text instead of a
number reads as 0. Opening the port resets the board: heaters off, 2 s of silence. There is no watchdog. Source:
firmware, version 2.0.1.

Invariants: bytes in, bytes out; the caller passes the time. The plant's output is that of
heater 1 at the duty of 200, that of the second plant, where there is one, heater 2 at the duty of 100. Without it
heater 2 warms nothing, and its sensor reads the temperature at the start.
"""

from __future__ import annotations

import re
import struct
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner_sim.stepped import SteppedPlant

VERSION: Final = b"TCLab Firmware 2.0.1 Arduino Uno"
DUTIES: Final = (200.0, 100.0)
SILENCE_S: Final = 2.0
"""Time for which the board ignores input after a reset, s: an Arduino's boot loader waits for a program."""
SENSOR: Final = (-50.0, 279.0)


class TclabBoard:
    """The board.

    Parameters
    ----------
    plant : SteppedPlant
        Heater 1 and its sensor; the board advances it.
    second : SteppedPlant, optional
        Heater 2 and its sensor.
    """

    def __init__(self, plant: SteppedPlant, second: SteppedPlant | None = None) -> None:
        self._plant, self._second = plant, second
        self._ambient = plant.pv
        self._buffer = b""
        self._heaters = [0.0, 0.0]
        self._duties = list(DUTIES)
        self._deaf_until_s = plant.t
        self.misunderstood = 0

    def advance(self, t: float) -> None:
        """Go on to time `t`, s."""
        for plant in self._plants:
            plant.advance(t)

    @property
    def _plants(self) -> tuple[SteppedPlant, ...]:
        return (self._plant,) if self._second is None else (self._plant, self._second)

    def reset(self) -> None:
        """Start again, as when a master opens the port."""
        self._buffer = b""
        self._duties = list(DUTIES)
        self._deaf_until_s = self._plant.t + SILENCE_S
        self._heat(0.0, 0.0)

    def receive(self, piece: bytes) -> bytes:
        """Receive bytes from a master and return the board's answer."""
        if self._plant.t < self._deaf_until_s:
            return b""
        *lines, self._buffer = re.split(rb"[\r\n]", self._buffer + piece)
        return b"".join(self._answer(line.strip()) for line in lines if line.strip())

    def _answer(self, line: bytes) -> bytes:
        word, _, text = line.partition(b" ")
        word = word.upper()
        command = _COMMANDS.get(word)
        if command is None:
            self.misunderstood += 1
            self._heat(0.0, 0.0)
            return word + b"\r\n"
        return command(self, _number(text))

    def temperature(self, channel: int) -> float:
        """Return a reading, degC, as far as the sensor reaches."""
        plants = self._plants
        reading = plants[channel].measure() if channel < len(plants) else self._ambient
        return min(max(reading, SENSOR[0]), SENSOR[1])

    def set_heater(self, channel: int, percent: float) -> float:
        """Set a heater, clipped to 0..100 %; return the value set."""
        self._heaters[channel] = min(max(percent, 0.0), 100.0)
        self._heat(*self._heaters)
        return self._heaters[channel]

    def set_duty(self, channel: int, duty: float) -> float:
        """Set the duty at 100 %, clipped to 0..255; return the value set."""
        self._duties[channel] = min(max(duty, 0.0), 255.0)
        self._heat(*self._heaters)
        return self._duties[channel]

    def heater(self, channel: int) -> float:
        """Return a heater as set, %."""
        return self._heaters[channel]

    def stop(self) -> None:
        """Switch both heaters off."""
        self._heat(0.0, 0.0)

    def _heat(self, first: float, second: float) -> None:
        self._heaters[:] = first, second
        for plant, heater, duty, usual in zip(self._plants, (first, second), self._duties, DUTIES, strict=False):
            plant.output = heater * duty / usual


def _number(text: bytes) -> float:
    try:
        return float(text)
    except ValueError:
        return 0.0


def _line(value: float, decimals: int = 3) -> bytes:
    return f"{value:.{decimals}f}\r\n".encode()


def _scan(board: TclabBoard) -> bytes:
    values = (board.temperature(0), board.temperature(1), board.heater(0), board.heater(1))
    return b"".join(_line(value) for value in values)


def _stopped(board: TclabBoard, answer: bytes) -> bytes:
    board.stop()
    return answer


_COMMANDS: Final[dict[bytes, Callable[[TclabBoard, float], bytes]]] = {
    b"T1": lambda board, _: _line(board.temperature(0)),
    b"T2": lambda board, _: _line(board.temperature(1)),
    b"T1B": lambda board, _: struct.pack("<f", board.temperature(0)),
    b"T2B": lambda board, _: struct.pack("<f", board.temperature(1)),
    b"Q1": lambda board, value: _line(board.set_heater(0, value)),
    b"Q2": lambda board, value: _line(board.set_heater(1, value)),
    b"Q1B": lambda board, value: struct.pack("<f", board.set_heater(0, value)),
    b"Q2B": lambda board, value: struct.pack("<f", board.set_heater(0, value)),
    b"R1": lambda board, _: _line(board.heater(0)),
    b"R2": lambda board, _: _line(board.heater(1)),
    b"P1": lambda board, value: _line(board.set_duty(0, value), 2),
    b"P2": lambda board, value: _line(board.set_duty(1, value), 2),
    b"SCAN": lambda board, _: _scan(board),
    b"LED": lambda _, value: _line(min(max(value, 0.0), 100.0), 2),
    b"VER": lambda _board, _value: VERSION + b"\r\n",
    b"A": lambda board, _: _stopped(board, b"Start\r\n"),
    b"X": lambda board, _: _stopped(board, b"Stop\r\n"),
}
