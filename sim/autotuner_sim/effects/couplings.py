"""Physics in which the PV or the time acts on the plant's input: losses, drifting gain, neighbours.

    input of the plant = delayed position + loads + sum of feed(t, u, y)

with `u` the delayed position plus loads and `y` the PV, both as deviations from rest; every law is written so that it
vanishes at rest and `K`, `T` stay the plant's values there. `SteppedPlant` evaluates them at the middle of each of its
steps, so its error falls with the square of `step_s`.

A `Bound` keeps a state of the plant where it can be: a full tank.

Inputs in output units, PV and levels in PV units, times in s, `gain` the plant's `K`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from autotuner_sim.plants.motion import State


class Coupling(Protocol):
    """A feedback on the plant's input from the PV, the input itself or the time."""

    def feed(self, t: float, u: float, y: float) -> float:
        """Return the contribution to the plant's input."""


class Bound(Protocol):
    """A limit of a state of the plant."""

    def keep(self, x: State) -> State:
        """Return the state that is allowed."""


@dataclass(frozen=True, slots=True)
class Radiation:
    """A part of the heat is lost by radiation: `T y' = K u - (1 - share) y - share ((Q + y)^4 - Q^4)/(4 Q^3)`.

    `share` is the radiated part of the loss at the rest point, `absolute` = Q the temperature there, K (Stefan,
    Boltzmann).
    """

    share: float
    absolute: float
    gain: float

    def feed(self, t: float, u: float, y: float) -> float:  # noqa: ARG002 - the port's signature
        """Return the loss beyond the linear one."""
        hot, rest = max(self.absolute + y, 0.0), self.absolute
        return -self.share * ((hot**4 - rest**4) / (4.0 * rest**3) - y) / self.gain


@dataclass(frozen=True, slots=True)
class SquareRootOutflow:
    """A tank that runs empty by its weight: `T y' = K u - 2 L (sqrt(1 + y/L) - 1)`, `L` the level at rest."""

    level: float
    gain: float

    def feed(self, t: float, u: float, y: float) -> float:  # noqa: ARG002 - the port's signature
        """Return the outflow less than the linear one."""
        outflow = 2.0 * self.level * (math.sqrt(max(1.0 + y / self.level, 0.0)) - 1.0)
        return -(outflow - y) / self.gain


@dataclass(frozen=True, slots=True)
class ConvectiveLoss:
    """Free convection: `T y' = K u - L ((1 + y/L)^p - 1)/p`, `L` the excess temperature at rest, `p` 1.25 to 1.33."""

    excess: float
    power: float
    gain: float

    def feed(self, t: float, u: float, y: float) -> float:  # noqa: ARG002 - the port's signature
        """Return the loss beyond the linear one."""
        loss = self.excess * (math.pow(max(1.0 + y / self.excess, 0.0), self.power) - 1.0) / self.power
        return -(loss - y) / self.gain


@dataclass(frozen=True, slots=True)
class Weir:
    """A vessel that spills over an edge: beyond `level` it loses `strength (y - level)^1.5` more, in PV units."""

    level: float
    strength: float
    gain: float

    def feed(self, t: float, u: float, y: float) -> float:  # noqa: ARG002 - the port's signature
        """Return the overflow."""
        return -self.strength * math.pow(max(y - self.level, 0.0), 1.5) / self.gain


@dataclass(frozen=True, slots=True)
class GainDrift:
    """A gain that changes steadily: `K (1 + rate (t - from))`, from `from_s` on."""

    rate_per_s: float
    from_s: float = 0.0

    def feed(self, t: float, u: float, y: float) -> float:  # noqa: ARG002 - the port's signature
        """Return the contribution of the changed gain."""
        return self.rate_per_s * max(t - self.from_s, 0.0) * u


@dataclass(frozen=True, slots=True)
class Fouling:
    """A gain that is lost the slower the more is lost: `K/(1 + (t - from)/tau)`."""

    tau_s: float
    from_s: float = 0.0

    def feed(self, t: float, u: float, y: float) -> float:  # noqa: ARG002 - the port's signature
        """Return the loss of input by the lost gain."""
        return (1.0 / (1.0 + max(t - self.from_s, 0.0) / self.tau_s) - 1.0) * u


@dataclass(frozen=True, slots=True)
class DirectionDynamics:
    """A first-order plant that rises with `T/ratio` and falls with `T`: `T y' = r (K u - y)`, `r` = ratio while rising.

    On a plant of higher order it quickens the drive in the same way while `K u > y`.
    """

    ratio: float
    gain: float

    def feed(self, t: float, u: float, y: float) -> float:  # noqa: ARG002 - the port's signature
        """Return the quicker drive while it rises."""
        drive = u - y / self.gain
        return (self.ratio - 1.0) * drive if drive * self.gain > 0.0 else 0.0


@dataclass(slots=True)
class Thermostat:
    """A neighbouring body with its own on-off controller, heated by the PV.

        tau x' = power on + pull y - x,   on while x is rising from -band to band,   load = push x

    `power` in the neighbour's units around its set point. The neighbour switches on its own and never reports it. It
    acts from `from_s` on.
    """

    tau_s: float
    power: float
    band: float
    pull: float
    push: float
    from_s: float = -math.inf
    _x: float = field(default=0.0, init=False)
    _on: bool = field(default=False, init=False)
    _t: float | None = field(default=None, init=False)

    def feed(self, t: float, u: float, y: float) -> float:  # noqa: ARG002 - the port's signature
        """Advance to `t`, switch, and return the contribution to the plant's input."""
        elapsed_s = 0.0 if self._t is None else t - self._t
        self._t = t
        if t < self.from_s:
            return 0.0
        towards = self.power * (0.5 if self._on else -0.5) + self.pull * y
        self._x = towards + (self._x - towards) * math.exp(-elapsed_s / self.tau_s)
        if abs(self._x) > self.band:
            self._on = self._x < 0.0
        return self.push * self._x


@dataclass(frozen=True, slots=True)
class Overflow:
    """State `index` cannot rise beyond `high`: a full tank. Where the next state is its slope, that stops too."""

    high: float
    index: int = 0
    slope: bool = False

    def keep(self, x: State) -> State:
        """Return the state that is allowed."""
        if x[self.index] <= self.high:
            return x
        kept = list(x)
        kept[self.index] = self.high
        if self.slope:
            kept[self.index + 1] = min(kept[self.index + 1], 0.0)
        return tuple(kept)
