"""Protocol of the Lake Shore 335 and 336 temperature controllers, similar to SCPI.

    KRDG? A       +295.150      temperature, K; CRDG? in degC
    RDGST? A      000           status of the reading; not 0: no reading
    MOUT 1,40.00                set the manual output, %; a write has no answer
    MOUT? 1       +40.00
    RANGE 1,3                   switch the heater on, ranges 1 to 3, 0 is off
    RANGE? 1      3
    SETP 1,300 / SETP? 1        set point

Source: Lake Shore Model 335 user's manual, chapter 6. Commands are 50 ms apart. A write is confirmed by a query. The
first write of an output switches the heater on afterwards; the heater is switched off at the end if it was found off.
"""

from __future__ import annotations

import math
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from autotuner.ports import OUTPUT, PV, SET_POINT
from autotuner_drivers.serial.protocol import Exchange, check_held, check_range, number, split_lines

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner_drivers.options import Options
    from autotuner_drivers.serial.protocol import Steps

HEATER: Final = (0.0, 100.0)
SETTINGS: Final = {OUTPUT: ("MOUT", 2), SET_POINT: ("SETP", 3)}
"""Command and decimals by signal."""
READINGS: Final = {"celsius": "CRDG", "kelvin": "KRDG"}


class LakeShore:
    """One input and one output of the controller.

    Parameters
    ----------
    sensor : str
        Input, such as ``A``.
    output : int
        Output, 1 or 2.
    unit : {"celsius", "kelvin"}
        Unit of the PV.
    heater_range : {1, 2, 3}
        Range in which the heater is switched on.
    """

    pause_s: float = 0.05
    settle_s: float = 0.0
    ranges: Mapping[str, tuple[float, float]] = MappingProxyType({OUTPUT: HEATER})
    volatile_output: bool = False

    def __init__(self, sensor: str, output: int, unit: str, heater_range: int) -> None:
        self._sensor, self._output, self._reading, self._range = sensor, output, READINGS[unit], heater_range

    @property
    def readable(self) -> frozenset[str]:
        """Temperature, output, set point."""
        return frozenset({PV, OUTPUT, SET_POINT})

    @property
    def writable(self) -> frozenset[str]:
        """Output and set point."""
        return frozenset(SETTINGS)

    def split(self, buffer: bytes) -> tuple[list[bytes], bytes]:
        """Cut into lines."""
        return split_lines(buffer)

    def enter(self) -> Steps:
        """Query the identity and the state of the heater."""
        yield Exchange(b"*IDN?\r\n", lambda line: 0.0 if line.startswith(b"LSCI") else None)
        return (yield self._ask("RANGE"))

    def leave(self, found: float) -> Steps:
        """Switch the heater off if it was found off."""
        if found == 0.0:
            yield self._set("RANGE", "0")
        return found

    def read(self, name: str) -> Steps:
        """Read a signal; the output is 0 while the heater is off."""
        if name == PV:
            status = yield Exchange(f"RDGST? {self._sensor}\r\n".encode(), number)
            reading = yield Exchange(f"{self._reading}? {self._sensor}\r\n".encode(), number)
            return reading if status == 0.0 else math.nan
        value = yield self._ask(SETTINGS[name][0])
        is_off = name == OUTPUT and (yield self._ask("RANGE")) == 0.0
        return 0.0 if is_off else value

    def write(self, name: str, value: float) -> Steps:
        """Set a signal, confirm it, and switch the heater on for an output."""
        command, decimals = SETTINGS[name]
        if name == OUTPUT:
            check_range(name, value, HEATER)
        yield self._set(command, f"{value:.{decimals}f}")
        held = check_held(name, (yield self._ask(command)), value, 0.6 * 10.0**-decimals)
        if name == OUTPUT and (yield self._ask("RANGE")) == 0.0:
            yield replace(self._set("RANGE", str(self._range)), acts=True)  # the output has no effect before this
            check_held("heater_range", (yield self._ask("RANGE")), self._range, 0.0)
        return held

    def _ask(self, command: str) -> Exchange:
        return Exchange(f"{command}? {self._output}\r\n".encode(), number)

    def _set(self, command: str, value: str) -> Exchange:
        return Exchange(f"{command} {self._output},{value}\r\n".encode())


def read_lakeshore(options: Options) -> LakeShore:
    """Take the protocol's options: `sensor` = "A", `output_number` = 1, `unit` = "celsius", `heater_range` = 3."""
    return LakeShore(
        options.choice("sensor", ("A", "B", "C", "D"), "A"),
        options.choice("output_number", (1, 2), 1),
        options.choice("unit", tuple(READINGS), "celsius"),
        options.choice("heater_range", (1, 2, 3), 3),
    )
