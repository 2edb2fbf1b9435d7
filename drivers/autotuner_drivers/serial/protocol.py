"""What a serial protocol is: commands in bytes, answers with a meaning, and the steps of reading and writing a signal.

Invariants of this module and of the protocols built on it:

1. Pure: a protocol sees bytes and numbers, never a port or a clock. Its steps are generators that yield an `Exchange`
   and are sent the value of its answer, so a whole dialogue can be tested by hand.
2. Steps are repeated from the first when an exchange got no answer, or when they raise `DeniedError`: without a
   checksum it is unknown whether the device refused what was sent, or what the line made of it.
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
    """The device refused, or holds something else, perhaps because the line damaged the command."""


@dataclass(frozen=True, slots=True)
class Exchange:
    """One command.

    Attributes
    ----------
    request : bytes
        What is sent.
    meaning : callable, optional
        Returns the value of a message, or None when the message is no answer to this command. Without it the device
        does not answer the command.
    acts : bool
        Whether the signal takes effect by this exchange, and not by the first one of its steps.
    """

    request: bytes
    meaning: Callable[[bytes], float | None] | None = None
    acts: bool = False


Steps = Generator[Exchange, float, float]
"""Exchanges in order; returns the value read, or written."""

Split = Callable[[bytes], tuple[list[bytes], bytes]]
"""Cuts what has arrived into whole messages and a rest."""


class LineProtocol(Protocol):
    """What a protocol offers to the driver."""

    pause_s: float
    """Silence that the device needs between two commands, s."""
    settle_s: float
    """Silence of the device after its port was opened, s."""
    volatile_output: bool
    """Whether the device may drop the output when it did not understand a command."""
    ranges: Mapping[str, tuple[float, float]]
    """Lowest and highest value of the signals that have such limits."""

    @property
    def readable(self) -> frozenset[str]:
        """Names of the signals that can be read."""

    @property
    def writable(self) -> frozenset[str]:
        """Names of the signals that can be written."""

    def split(self, buffer: bytes) -> tuple[list[bytes], bytes]:
        """Cut what has arrived into whole messages and a rest."""

    def enter(self) -> Steps:
        """Make the acquaintance of the device; return what `leave` has to know."""

    def leave(self, found: float) -> Steps:
        """Put back what writing has changed beside the signals; `found` is what `enter` returned."""

    def read(self, name: str) -> Steps:
        """Read a signal."""

    def write(self, name: str, value: float) -> Steps:
        """Set a signal."""


@runtime_checkable
class Stepped(Protocol):
    """A protocol that sends its values with so many decimals, and states how many."""

    def step(self, name: str) -> float:
        """Return the step of the values that are sent for a signal; 0 where it is not known."""


def split_lines(buffer: bytes) -> tuple[list[bytes], bytes]:
    """Cut at carriage returns and line feeds; empty lines are none."""
    *lines, rest = re.split(rb"[\r\n]", buffer)
    return [line.strip() for line in lines if line.strip()], rest


def number(text: bytes) -> float | None:
    """Return the number that a whole message is, None when it is none."""
    return float(text) if _NUMBER.fullmatch(text.strip()) else None


def fixed_number(decimals: int) -> Callable[[bytes], float | None]:
    """Return the meaning of a message that is a number with so many decimals, neither more nor fewer."""
    pattern = re.compile(rb"[-+]?\d+\.\d{%d}" % decimals)
    return lambda text: float(text) if pattern.fullmatch(text) else None


_NUMBER: Final = re.compile(rb"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")


def within(value: float, valid: tuple[float, float]) -> float:
    """Return the value, or NaN when it is one that a broken sensor gives."""
    return value if valid[0] <= value <= valid[1] else math.nan


def check_held(name: str, held: float, wanted: float, tolerance: float) -> float:
    """Return the value that the device holds after a write; raise `DeniedError` when it is another one."""
    if not abs(held - wanted) <= tolerance:
        raise DeniedError(
            f"was set to {wanted:g}, but the device holds {held:g}",
            field=name,
            value=wanted,
            remedy="Check the device's limits and its mode: many take no output while their own controller is on.",
        )
    return held


def check_range(name: str, value: float, limits: tuple[float, float]) -> None:
    """Raise `DeviceRefusedError` for a value that the device would clip."""
    if not limits[0] <= value <= limits[1]:
        raise DeviceRefusedError(
            f"is outside of what the device takes, {limits[0]:g} to {limits[1]:g}",
            field=name,
            value=value,
            remedy="Set the loop's limits within that range.",
        )


def nothing(value: float = math.nan) -> Steps:
    """Do nothing."""
    yield from ()
    return value
