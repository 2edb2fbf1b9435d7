"""Interfaces of effects, by their location: at the actuator, at the plant's input, on the PV, or in the sensor.

    Actuator    commanded output -> position
    Load        added to the plant's input
    Offset      added to the PV
    Sensor      PV -> reading

An effect needs no more than one of these protocols. Objects that keep a state (the position of a valve) are copied by
the plant that takes them, so that one list serves many plants.

Outputs, positions and loads in output units, PV and readings in PV units, times in s.
"""

from __future__ import annotations

import math
from typing import ClassVar, Protocol


class Actuator(Protocol):
    """An effect between the commanded output and the plant."""

    moves_by_itself: ClassVar[bool]
    """Whether the position changes between commands; the plant then needs an `actuator_scan_s`."""

    def rest(self, output: float) -> None:
        """Stand still at `output` from the beginning of time."""

    def act(self, command: float, elapsed_s: float) -> float:
        """Return the new position for the command, `elapsed_s` after the last call."""


class Load(Protocol):
    """A disturbance at the plant's input that changes in steps."""

    def load(self, t: float) -> float:
        """Return the contribution to the plant's input from `t` on."""

    def next_change_s(self, after: float) -> float:
        """Return the first time later than `after` at which it changes, infinite if none."""


class Offset(Protocol):
    """A disturbance of the PV that is known at every time."""

    def offset(self, t: float) -> float:
        """Return the contribution to the PV at `t`."""


class Sensor(Protocol):
    """An effect between the PV and its reading."""

    def read(self, pv: float, t: float) -> float:
        """Return the reading of `pv` taken at `t`."""


def require_positive(effect: object, name: str, value: float) -> None:
    """Raise `ValueError` unless a parameter of an effect is a positive number."""
    if not (value > 0.0 and math.isfinite(value)):
        raise ValueError(
            f"{type(effect).__name__}.{name} must be positive (got {value!r}). Leave the effect out to have none."
        )
