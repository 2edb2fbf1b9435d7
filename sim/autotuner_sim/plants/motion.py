"""Exact motion of a linear plant while its input is constant.

    x' = A x + B u,   y = C x,   u constant for the span `h`

with all time constants in s and `u`, `y` as deviations from rest. Each kind is solved in its own closed form:

    Lag          y' = p y + b u                           one real pole (stable, integrating or unstable)
    LagPair      x1' = p1 x1 + b u,  x2' = p2 x2 + g x1   two real poles, p1 <= p2 <= 0
    Oscillator   y'' + 2 s y' + w0^2 y = w0^2 K u         a complex pair, as a damped rotation

and three or more lags in `lag_chain`. Divided differences of `e^{ph}` are taken by `expm1`, so that equal and nearly
equal poles lose no digits.

Invariants:

1. A motion keeps no state: `move` takes one and returns one, so any span is one step from its start.
2. `turning_points` misses none, because it solves `y' = 0` on the slopes `v = A x + B u`, which decay to zero and do
   not vanish in the rounding of `y`. Between two neighbours `y` is monotone, so it crosses a level there at most once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Iterator

State = tuple[float, ...]

SETTLED = 40.0
"""Time constants after which a mode has decayed under the rounding of a double (e^-40 is 4e-18)."""
_LARGEST_EXPONENT = 700.0
"""Largest exponent that does not overflow a double (e^709 is 8e307), rounded down."""


class Motion(Protocol):
    """A linear plant without its dead time, moved over spans of constant input."""

    @property
    def rest(self) -> State:
        """The state at rest with input 0."""

    @property
    def time_scale_s(self) -> float:
        """Sum of the finite time constants, s; 0 for a pure integrator."""

    def move(self, x: State, u: float, h: float) -> State:
        """Return the state after `h` seconds of input `u`."""

    def output(self, x: State) -> float:
        """Return the PV of a state."""

    def turning_points(self, x: State, u: float, span: float) -> Iterator[float]:
        """Yield the times in (0, span) at which the PV turns, s, ascending."""


def _exp(exponent: float) -> float:
    """Return e^x, held at a huge value where an unstable plant has long left every bound."""
    return math.exp(min(exponent, _LARGEST_EXPONENT))


def _integral_of_exp(pole: float, h: float) -> float:
    """Return the integral of `e^{pole s}` for `s` from 0 to `h`, accurate for any pole."""
    return h if pole == 0.0 else math.expm1(min(pole * h, _LARGEST_EXPONENT)) / pole


@dataclass(frozen=True, slots=True)
class Lag:
    """One real pole: `y' = pole y + gain u`."""

    pole: float
    gain: float

    @property
    def rest(self) -> State:
        """The state at rest with input 0."""
        return (0.0,)

    @property
    def time_scale_s(self) -> float:
        """The time constant, s; 0 for an integrator."""
        return 1.0 / abs(self.pole) if self.pole else 0.0

    def move(self, x: State, u: float, h: float) -> State:
        """Return the state after `h` seconds of input `u`."""
        return (_exp(self.pole * h) * x[0] + self.gain * u * _integral_of_exp(self.pole, h),)

    def output(self, x: State) -> float:
        """Return the PV of a state."""
        return x[0]

    def turning_points(self, x: State, u: float, span: float) -> Iterator[float]:  # noqa: ARG002 - the port's signature
        """Yield nothing: one exponential is monotone."""
        return iter(())


@dataclass(frozen=True, slots=True)
class LagPair:
    """Two real poles in a row, the faster first: `x1' = p1 x1 + b u`, `x2' = p2 x2 + g x1`, `y = c1 x1 + c2 x2`."""

    p1: float
    p2: float
    b: float
    g: float
    c1: float
    c2: float

    @property
    def rest(self) -> State:
        """The state at rest with input 0."""
        return (0.0, 0.0)

    @property
    def time_scale_s(self) -> float:
        """Sum of the finite time constants, s."""
        return sum(1.0 / abs(pole) for pole in (self.p1, self.p2) if pole)

    def move(self, x: State, u: float, h: float) -> State:
        """Return the state after `h` seconds of input `u`."""
        fast, slow = _exp(self.p1 * h), _exp(self.p2 * h)
        through = slow * _integral_of_exp(self.p1 - self.p2, h)
        integral_of_through = (through - _integral_of_exp(self.p2, h)) / self.p1
        x1, x2 = x
        return (
            fast * x1 + self.b * u * _integral_of_exp(self.p1, h),
            slow * x2 + self.g * (through * x1 + self.b * u * integral_of_through),
        )

    def output(self, x: State) -> float:
        """Return the PV of a state."""
        return self.c1 * x[0] + self.c2 * x[1]

    def turning_points(self, x: State, u: float, span: float) -> Iterator[float]:
        """Yield the only turning point: `y' = 0` is linear in `w = (e^{ds} - 1)/d`, `d = p1 - p2`."""
        v1 = self.p1 * x[0] + self.b * u
        v2 = self.p2 * x[1] + self.g * x[0]
        apart = self.p1 - self.p2
        slope_of_w = self.c1 * v1 * apart + self.c2 * self.g * v1
        if slope_of_w == 0.0:
            return
        w = -(self.c1 * v1 + self.c2 * v2) / slope_of_w
        if w > 0.0 and apart * w > -1.0:
            when = math.log1p(apart * w) / apart if apart else w
            if when < span:
                yield when


@dataclass(frozen=True, slots=True)
class Oscillator:
    """A complex pair `s = -decay +- j turn`, of static gain `gain`; the state is the PV and its slope, in s^-1."""

    decay: float
    turn: float
    gain: float

    @property
    def rest(self) -> State:
        """The state at rest with input 0."""
        return (0.0, 0.0)

    @property
    def time_scale_s(self) -> float:
        """Time constant of the decay and of one radian, s."""
        return 1.0 / self.decay + 1.0 / self.turn

    def move(self, x: State, u: float, h: float) -> State:
        """Return the state after `h` seconds of input `u`."""
        off, slope = x[0] - self.gain * u, x[1]
        shrink = _exp(-self.decay * h)
        cosine = shrink * math.cos(self.turn * h)
        sine = shrink * math.sin(self.turn * h) / self.turn
        stiffness = self.decay**2 + self.turn**2
        return (
            self.gain * u + cosine * off + sine * (slope + self.decay * off),
            cosine * slope - sine * (self.decay * slope + stiffness * off),
        )

    def output(self, x: State) -> float:
        """Return the PV of a state."""
        return x[0]

    def turning_points(self, x: State, u: float, span: float) -> Iterator[float]:
        """Yield the zeros of the slope, half a turn apart, until the oscillation has died."""
        off, slope = x[0] - self.gain * u, x[1]
        stiffness = self.decay**2 + self.turn**2
        if off == 0.0 and slope == 0.0:
            return
        first = math.atan2(self.turn * slope, self.decay * slope + stiffness * off) % math.pi
        end = min(span, SETTLED / self.decay)
        count = 0 if first > 0.0 else 1
        while (when := (first + count * math.pi) / self.turn) < end:
            yield when
            count += 1
