"""What is known of a serial port before it is opened."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from autotuner_drivers.options import Options

PSEUDO_TERMINALS: Final = Path("/dev/pts")


@dataclass(frozen=True, slots=True)
class SerialSettings:
    """A serial port and its frame: `baudrate` Bd, `bytesize` 7 or 8 bits, `parity` N, E or O, `stopbits` 1 or 2."""

    port: str
    baudrate: int
    bytesize: int
    parity: str
    stopbits: int

    def arguments(self) -> dict[str, Any]:
        """Return the frame as pyserial and pymodbus name it.

        A pseudo-terminal carries whole bytes: it has no parity bit, and refuses settings that ask for one.
        """
        frame = {"baudrate": self.baudrate, "stopbits": self.stopbits, "bytesize": self.bytesize, "parity": self.parity}
        if PSEUDO_TERMINALS in Path(self.port).resolve().parents:
            frame |= {"bytesize": 8, "parity": "N"}
        return frame


def read_serial(
    options: Options, *, baudrate: int, parity: str, bytesize: int = 8, bytesizes: tuple[int, ...] = (7, 8)
) -> SerialSettings:
    """Take a serial port out of a driver's options; the arguments are the protocol's usual frame."""
    return SerialSettings(
        options.text("serial_port"),
        options.integer("baudrate", baudrate, low=50, high=4_000_000),
        options.choice("bytesize", bytesizes, bytesize),
        options.choice("parity", ("N", "E", "O"), parity),
        options.choice("stopbits", (1, 2), 1),
    )
