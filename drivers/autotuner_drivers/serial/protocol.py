"""Interface of a serial protocol: commands in bytes, parsers of answers, and the steps that read and write a signal.

Invariants of this module and of the protocols built on it:

1. Pure: a protocol sees bytes and numbers, never a port or a clock. Its steps are generators that yield an `Exchange`
and are sent the value of its answer, so a whole dialogue can be tested by hand.
2. Steps restart from the first after a missing answer or a `DeniedError`. Without a checksum, a refusal by the device
cannot be distinguished from a command damaged on the line.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, Protocol, runtime_checkable

from autotuner.errors import DeviceRefusedError

NO_RANGES: Final[Mapping[str, tuple[float, float]]] = MappingProxyType({})


class DeniedError(DeviceRefusedError):
    """The device refused the command or holds a different value, perhaps because the line damaged the command."""


@dataclass(frozen=True, slots=True)
class Exchange:
    """One command.

    Attributes
    ----------
    request : bytes
        Bytes of the command.
    meaning : callable, optional
        Parser of an answer: returns the value, or None for a message that does not answer this command. None for a
        command without an answer.
    acts : bool
        Whether the signal takes effect with this exchange instead of the first one of the steps.
    """

    request: bytes
    meaning: Callable[[bytes], float | None] | None = None
    acts: bool = False


Steps = Generator[Exchange, float, float]
"""Exchanges in order; returns the value that was read or written."""

Split = Callable[[bytes], tuple[list[bytes], bytes]]
"""Splits received bytes into complete messages and a remainder."""


class LineProtocol(Protocol):
    """Operations that a protocol implements for the driver."""

    pause_s: float
    """Silence that the device needs between two commands, s."""
    settle_s: float
    """Silence of the device after the opening of its port, s."""
    volatile_output: bool
    """Whether the device may drop the output after a command that it did not understand."""
    ranges: Mapping[str, tuple[float, float]]
    """Lowest and highest value of the signals with limits."""

    @property
    def readable(self) -> frozenset[str]:
        """Names of the signals that can be read."""

    @property
    def writable(self) -> frozenset[str]:
        """Names of the signals that can be written."""

    def split(self, buffer: bytes) -> tuple[list[bytes], bytes]:
        """Split received bytes into complete messages and a remainder."""

    def enter(self) -> Steps:
        """Check that the device is present; return the state that `leave` needs."""

    def leave(self, found: float) -> Steps:
        """Restore settings other than the signals that writing has changed; `found` is the result of `enter`."""

    def read(self, name: str) -> Steps:
        """Read a signal."""

    def write(self, name: str, value: float) -> Steps:
        """Set a signal."""


@runtime_checkable
class Stepped(Protocol):
    """A protocol that sends values with a fixed number of decimals."""

    def step(self, name: str) -> float:
        """Return the resolution of transmitted values of a signal; 0 where unknown."""


def split_lines(buffer: bytes) -> tuple[list[bytes], bytes]:
    """Split at carriage returns and line feeds; skip empty lines."""
    *lines, remainder = re.split(rb"[\r\n]", buffer)
    return [line.strip() for line in lines if line.strip()], remainder


def number(text: bytes) -> float | None:
    """Parse a message that is a number as a whole; None for any other message."""
    return float(text) if _NUMBER.fullmatch(text.strip()) else None


def fixed_number(decimals: int) -> Callable[[bytes], float | None]:
    """Return a parser of numbers with exactly `decimals` decimals."""
    pattern = re.compile(rb"[-+]?\d+\.\d{%d}" % decimals)
    return lambda text: float(text) if pattern.fullmatch(text) else None


_NUMBER: Final = re.compile(rb"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")


def within(value: float, valid: tuple[float, float]) -> float:
    """Return the value, or NaN outside of `valid`, where a sensor is broken."""
    return value if valid[0] <= value <= valid[1] else math.nan


def check_held(name: str, held: float, requested: float, tolerance: float) -> float:
    """Return the value that the device holds after a write; raise `DeniedError` when it differs from the request."""
    if not abs(held - requested) <= tolerance:
        raise DeniedError(
            f"was set to {requested:g}, but the device holds {held:g}",
            field=name,
            value=requested,
            remedy="Check the device's limits and its mode: many refuse an output while their own controller is on.",
        )
    return held


def check_range(name: str, value: float, limits: tuple[float, float]) -> None:
    """Raise `DeviceRefusedError` for a value that the device would clip."""
    if not limits[0] <= value <= limits[1]:
        raise DeviceRefusedError(
            f"is outside of the device's range, {limits[0]:g} to {limits[1]:g}",
            field=name,
            value=value,
            remedy="Set the loop's limits within that range.",
        )


def nothing(value: float = math.nan) -> Steps:
    """Do nothing."""
    yield from ()
    return value
