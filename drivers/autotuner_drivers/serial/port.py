"""A serial port: its settings, and the open port, whose blocking calls run in its own thread."""

from __future__ import annotations

import asyncio
import contextlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import serial  # type: ignore[import-untyped]  # pyserial has no type hints

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner_drivers.options import Options


PSEUDO_TERMINALS: Final = Path("/dev/pts")


@dataclass(frozen=True, slots=True)
class SerialSettings:
    """A serial port and its frame: `baudrate` Bd, `bytesize` 7 or 8, `parity` N, E or O, `stopbits` 1 or 2."""

    port: str
    baudrate: int
    bytesize: int
    parity: str
    stopbits: int

    def arguments(self) -> dict[str, Any]:
        """Return the frame as keyword arguments of pyserial and pymodbus.

        A pseudo-terminal carries whole bytes: it has no parity bit and refuses settings that request one.
        """
        frame = {"baudrate": self.baudrate, "stopbits": self.stopbits, "bytesize": self.bytesize, "parity": self.parity}
        if PSEUDO_TERMINALS in Path(self.port).resolve().parents:
            frame |= {"bytesize": 8, "parity": "N"}
        return frame


def read_serial(
    options: Options, *, baudrate: int, parity: str, bytesize: int = 8, bytesizes: tuple[int, ...] = (7, 8)
) -> SerialSettings:
    """Take a serial port from a driver's options; the arguments are the protocol's default frame."""
    return SerialSettings(
        options.text("serial_port"),
        options.integer("baudrate", baudrate, low=50, high=4_000_000),
        options.choice("bytesize", bytesizes, bytesize),
        options.choice("parity", ("N", "E", "O"), parity),
        options.choice("stopbits", (1, 2), 1),
    )


T = TypeVar("T")
WRITE_LIMIT_S: Final = 2.0
"""Longest time for a write, s, many times a request at 1,200 Bd: a longer write is blocked by flow control."""
SLICE_S: Final = 0.02
"""Longest blocking read of the thread, s, so that a cancelled call does not delay the next one."""


class SerialThread:
    """One serial port.

    Parameters
    ----------
    settings : SerialSettings
        Port and frame.
    """

    def __init__(self, settings: SerialSettings) -> None:
        self._settings = settings
        self._thread: ThreadPoolExecutor | None = None
        self._port: Any = None

    async def open(self) -> None:
        """Open the port exclusively; raise `OSError` on failure."""
        self._thread = ThreadPoolExecutor(1, thread_name_prefix=f"serial {self._settings.port}")
        try:
            await self._in_thread(self._open)
        except BaseException:
            self._end_thread()
            raise

    async def write(self, message: bytes) -> None:
        """Send bytes."""
        await self._in_thread(lambda: self._port.write(message))

    async def read(self, wait_s: float) -> bytes:
        """Return the bytes that arrive within `wait_s`, at most `SLICE_S`."""
        return await self._in_thread(lambda: self._read(min(wait_s, SLICE_S)))

    async def clear(self) -> None:
        """Discard the bytes that have arrived."""
        await self._in_thread(self._port.reset_input_buffer)

    async def close(self) -> None:
        """Close the port; never raises."""
        if self._thread is None:
            return
        with contextlib.suppress(Exception):
            await self._in_thread(self._port.close)
        self._end_thread()

    def _open(self) -> None:
        self._port = serial.serial_for_url(
            self._settings.port,
            exclusive=True,
            timeout=SLICE_S,
            write_timeout=WRITE_LIMIT_S,
            **self._settings.arguments(),
        )

    def _read(self, wait_s: float) -> bytes:
        self._port.timeout = wait_s
        first: bytes = self._port.read(1)
        rest: bytes = self._port.read(self._port.in_waiting) if first else b""
        return first + rest

    async def _in_thread(self, call: Callable[[], T]) -> T:
        if self._thread is None:
            raise ConnectionResetError("the port is closed")
        return await asyncio.get_running_loop().run_in_executor(self._thread, call)

    def _end_thread(self) -> None:
        if self._thread is not None:
            self._thread.shutdown(wait=False)
            self._thread = None
