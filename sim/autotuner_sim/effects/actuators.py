"""Actuators: limits, steps, curves, those that are slow or unequal by direction, and those that scan rarely.

Each curve passes through the rest point with slope 1, so that the plant's `K` is its gain there. Commands and
positions in output units, times in s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from autotuner_sim.effects.protocols import require_positive


@dataclass(slots=True)
class Saturation:
    """A position that cannot leave `low` to `high`, whatever is commanded."""

    moves_by_itself: ClassVar[bool] = False
    low: float
    high: float

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise ValueError(f"Saturation.high must exceed low = {self.low} (got {self.high}). Give two distinct ends.")

    def rest(self, output: float) -> None:
        """Do nothing: it has no memory."""

    def act(self, command: float, elapsed_s: float) -> float:  # noqa: ARG002 - the port's signature
        """Return the new position for the command."""
        return min(max(command, self.low), self.high)


@dataclass(slots=True)
class RateLimit:
    """A position that moves by at most `rate_per_s`, in the steps of the plant's `actuator_scan_s`."""

    moves_by_itself: ClassVar[bool] = True
    rate_per_s: float
    _position: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        require_positive(self, "rate_per_s", self.rate_per_s)

    def rest(self, output: float) -> None:
        """Stand still at `output`."""
        self._position = output

    def act(self, command: float, elapsed_s: float) -> float:
        """Return the new position for the command, `elapsed_s` after the last call."""
        travel = self.rate_per_s * elapsed_s
        self._position = min(max(command, self._position - travel), self._position + travel)
        return self._position


@dataclass(slots=True)
class OutputQuantisation:
    """A position that knows only multiples of `step`, counted from rest."""

    moves_by_itself: ClassVar[bool] = False
    step: float
    _origin: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        require_positive(self, "step", self.step)

    def rest(self, output: float) -> None:
        """Put `output` on the grid."""
        self._origin = output

    def act(self, command: float, elapsed_s: float) -> float:  # noqa: ARG002 - the port's signature
        """Return the new position for the command."""
        return self._origin + self.step * round((command - self._origin) / self.step)


@dataclass(slots=True)
class SoftSaturation:
    """A limit that is approached: `x = high - s ln(1 + e^{(high - u)/s})` (softplus); within `s` of `high` it bends.

    Shifted so that the rest point is kept.
    """

    moves_by_itself: ClassVar[bool] = False
    high: float
    softness: float
    _shift: float = field(default=0.0, init=False)

    def rest(self, output: float) -> None:
        """Keep `output` where it is."""
        self._shift = 0.0
        self._shift = output - self.act(output, 0.0)

    def act(self, command: float, elapsed_s: float) -> float:  # noqa: ARG002 - the port's signature
        """Return the new position for the command."""
        return self._shift + self.high - self.softness * float(np.logaddexp(0.0, (self.high - command) / self.softness))


@dataclass(slots=True)
class _Curve:
    """A static curve `f`, moved and stretched to slope 1 at rest."""

    moves_by_itself: ClassVar[bool] = False
    _u0: float = field(default=0.0, init=False)
    _f0: float = field(default=0.0, init=False)
    _slope: float = field(default=1.0, init=False)

    def curve(self, u: float) -> float:
        """Return `f(u)`."""
        raise NotImplementedError

    def rest(self, output: float) -> None:
        """Keep `output` where it is."""
        step = 1e-4
        self._u0, self._f0 = output, self.curve(output)
        self._slope = (self.curve(output + step) - self.curve(output - step)) / (2.0 * step)

    def act(self, command: float, elapsed_s: float) -> float:  # noqa: ARG002 - the port's signature
        """Return the new position for the command."""
        return self._u0 + (self.curve(command) - self._f0) / self._slope


@dataclass(slots=True)
class EqualPercentage(_Curve):
    """A valve of rangeability `R`: `f = R^{u/span - 1}`."""

    rangeability: float = 30.0
    span: float = 100.0

    def curve(self, u: float) -> float:
        """Return `f(u)`."""
        return float(self.rangeability ** (u / self.span - 1.0))


@dataclass(slots=True)
class PowerLaw(_Curve):
    """A heater on a voltage: `f = (u/span)^p`; `p` = 2 is power over voltage."""

    power: float = 2.0
    span: float = 100.0

    def curve(self, u: float) -> float:
        """Return `f(u)`."""
        return float(max(u / self.span, 0.0) ** self.power)


@dataclass(slots=True)
class DirectionGain:
    """Heating unlike cooling: above the neutral point the position moves `ratio` times as far.

    `softness` > 0 blends the two over `softness` output units: `x = u0 + d + (ratio - 1) s ln((1 + e^{d/s})/2)`.
    """

    moves_by_itself: ClassVar[bool] = False
    ratio: float
    softness: float = 0.0
    _u0: float = field(default=0.0, init=False)

    def rest(self, output: float) -> None:
        """Let `output` be the neutral point."""
        self._u0 = output

    def act(self, command: float, elapsed_s: float) -> float:  # noqa: ARG002 - the port's signature
        """Return the new position for the command."""
        d = command - self._u0
        if self.softness == 0.0:
            return self._u0 + (self.ratio * d if d > 0.0 else d)
        bend = float(np.logaddexp(0.0, d / self.softness)) - math.log(2.0)
        return self._u0 + d + (self.ratio - 1.0) * self.softness * bend


@dataclass(slots=True)
class UnequalLag:
    """An element that takes `up_s` to warm and `down_s` to cool: `tau x' = u - x`, `tau` by the sign of `u - x`."""

    moves_by_itself: ClassVar[bool] = True
    up_s: float
    down_s: float
    _x: float = field(default=0.0, init=False)

    def rest(self, output: float) -> None:
        """Stand still at `output`."""
        self._x = output

    def act(self, command: float, elapsed_s: float) -> float:
        """Return the new position, `elapsed_s` after the last call."""
        tau_s = self.up_s if command > self._x else self.down_s
        self._x = command + (self._x - command) * (math.exp(-elapsed_s / tau_s) if tau_s > 0.0 else 0.0)
        return self._x


@dataclass(slots=True)
class UnequalWait:
    """A burner that is purged before it fires harder: a rise of the command is followed `up_s` late, a fall at once."""

    moves_by_itself: ClassVar[bool] = True
    up_s: float
    _x: float = field(default=0.0, init=False)
    _waited_s: float = field(default=0.0, init=False)

    def rest(self, output: float) -> None:
        """Stand still at `output`."""
        self._x, self._waited_s = output, 0.0

    def act(self, command: float, elapsed_s: float) -> float:
        """Return the new position, `elapsed_s` after the last call."""
        self._waited_s = self._waited_s + elapsed_s if command > self._x else 0.0
        if command <= self._x or self._waited_s >= self.up_s * (1.0 - 1e-9):
            self._x = command
        return self._x


@dataclass(slots=True)
class SoftRateLimit:
    """A motor that slows down before it arrives: `x' = R tanh((u - x)/(R tau))`.

    Solved exactly: `sinh(e/(R tau))` of the error `e` decays with `tau`.
    """

    moves_by_itself: ClassVar[bool] = True
    rate_per_s: float
    tau_s: float
    _x: float = field(default=0.0, init=False)

    def rest(self, output: float) -> None:
        """Stand still at `output`."""
        self._x = output

    def act(self, command: float, elapsed_s: float) -> float:
        """Return the new position, `elapsed_s` after the last call."""
        reach = self.rate_per_s * self.tau_s
        scaled = (command - self._x) / reach
        if abs(scaled) > 300.0:  # the hyperbolic sine would overflow; at this distance the motor runs at full speed
            self._x += math.copysign(self.rate_per_s * elapsed_s, scaled)
        else:
            self._x = command - reach * math.asinh(math.sinh(scaled) * math.exp(-elapsed_s / self.tau_s))
        return self._x


@dataclass(slots=True)
class ActuatorHold:
    """An output card that reads the command every `period_s`; `jitter` makes the waits unequal, as a busy bus does.

    Each wait is `period_s` times a number drawn evenly from 1 - jitter to 1 + jitter.
    """

    moves_by_itself: ClassVar[bool] = True
    period_s: float
    jitter: float = 0.0
    seed: int = 0
    _x: float = field(default=0.0, init=False)
    _waited_s: float = field(default=0.0, init=False)
    _wait_s: float = field(default=0.0, init=False)
    _random: np.random.Generator = field(default_factory=np.random.default_rng, init=False)

    def rest(self, output: float) -> None:
        """Stand still at `output`."""
        self._x, self._waited_s, self._wait_s = output, 0.0, self.period_s
        self._random = np.random.default_rng(self.seed)

    def act(self, command: float, elapsed_s: float) -> float:
        """Return the position, `elapsed_s` after the last call."""
        self._waited_s += elapsed_s
        if self._waited_s >= self._wait_s * (1.0 - 1e-9):
            self._waited_s -= self._wait_s
            self._wait_s = self.period_s * (1.0 + self.jitter * float(self._random.uniform(-1.0, 1.0)))
            self._x = command
        return self._x


@dataclass(slots=True)
class TimeProportioned:
    """A heater with a relay: in every `period_s` it is fully on for the command's share of `full`, and off otherwise.

    The command takes effect at the next period. The output of a step with a switch is its mean over the step.
    """

    moves_by_itself: ClassVar[bool] = True
    period_s: float
    full: float = 100.0
    _on_s: float = field(default=0.0, init=False)
    _at_s: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        require_positive(self, "period_s", self.period_s)
        require_positive(self, "full", self.full)

    def rest(self, output: float) -> None:
        """Begin a period at `output`."""
        self._at_s, self._on_s = 0.0, self._share(output) * self.period_s

    def act(self, command: float, elapsed_s: float) -> float:
        """Return the mean position over the step, `elapsed_s` after the last call."""
        if elapsed_s <= 0.0:
            return self.full if self._at_s < self._on_s else 0.0
        remaining_s, on_s = elapsed_s, 0.0
        while remaining_s > 0.0:
            step = min(remaining_s, self.period_s - self._at_s)
            on_s += max(min(self._at_s + step, self._on_s) - self._at_s, 0.0)
            self._at_s, remaining_s = self._at_s + step, remaining_s - step
            if self._at_s >= self.period_s * (1.0 - 1e-9):
                self._at_s, self._on_s = 0.0, self._share(command) * self.period_s
        return self.full * on_s / elapsed_s

    def _share(self, command: float) -> float:
        return min(max(command / self.full, 0.0), 1.0)
