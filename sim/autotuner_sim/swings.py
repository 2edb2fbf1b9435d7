"""Relay tests in closed form, swing by swing, as long as one switch at a time is on its way.

With `L = K u` where the PV is heading, `z = y - L`, `v = y'`, `w0^2 = 1/m`, `s = n/(2 m)`, `d^2 = s^2 - w0^2`,

    z(t) = c z0 + o (v0 + s z0),   v(t) = c v0 - o (s v0 + w0^2 z0),   c = e^{-st} cosh dt,   o = e^{-st} sinh(dt)/d

(cosine and sine for `d^2 < 0`). After an arrival the PV turns at `tm` and comes back to the threshold `y_s`:

    q = v0/(s v0 + w0^2 z0) = tanh(d tm)/d,   E = z(tm) = e^{-s tm} (z0 + (v0 + s z0) q)/sqrt(1 - d^2 q^2)
    E g(tau) = y_s - L,   g = c + s o,   g' = -w0^2 o

and `D` later the switch arrives in turn. `g` falls from 1, its slope steepest at `tau_i = atanh(d/s)/d`; on either side
of `tau_i` an iteration that is kept on that side converges from anywhere: Halley's, since `g'' = -w0^2 (c - s o)` costs
nothing more. From rest the first arrival counts as a turn. `K` PV/output, `D`, `n`, times s, `m` s^2.

`batch` goes this way where its quick one is in doubt. Rules of this file: written once, for single numbers and for
arrays of plants alike; where the PV turns again before a switch arrives, the shape says so by `turns_again_s`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

Real = TypeVar("Real", float, NDArray[np.float64])

_LEAST = 1e-100
"""Stands for 0 where a quotient of two vanishing numbers is meant; relative to the decay."""


@dataclass(frozen=True, slots=True)
class Functions(Generic[Real]):
    """The functions of one kind of number."""

    exp: Callable[[Real], Real]
    expm1: Callable[[Real], Real]
    log1p: Callable[[Real], Real]
    sqrt: Callable[[Real], Real]
    sin: Callable[[Real], Real]
    cos: Callable[[Real], Real]
    atan: Callable[[Real], Real]


ARRAYS: Functions[NDArray[np.float64]] = Functions(np.exp, np.expm1, np.log1p, np.sqrt, np.sin, np.cos, np.arctan)


@dataclass(frozen=True, slots=True)
class Shape(Generic[Real]):
    """The free motion of a second-order plant.

    Attributes
    ----------
    s, stiffness, square : float or array
        `s`, `w0^2` and `d^2`.
    steepest_s, steepest_share : float or array
        `tau_i`, s, and `g` there.
    turns_again_s : float or array
        Time from one turn to the next, s.
    motion : callable
        From `t` to `c` and `o`.
    turn_s : callable
        From `q` to `tm`.
    """

    s: Real
    stiffness: Real
    square: Real
    steepest_s: Real
    steepest_share: Real
    turns_again_s: Real
    motion: Callable[[Real], tuple[Real, Real]]
    turn_s: Callable[[Real], Real]


def creeping(f: Functions[Real], m: Real, n: Real) -> Shape[Real]:
    """Return the motion of two real poles, `m y'' + n y' + y = 0`."""
    s: Real = n / (2.0 * m)
    stiffness: Real = 1.0 / m
    square: Real = s * s - stiffness
    d: Real = f.sqrt(abs(square)) + _LEAST * s
    slow: Real = stiffness / (s + d)
    slow_pole: Real = -slow
    apart: Real = -2.0 * d
    scale: Real = 1.0 / apart

    def motion(t: Real) -> tuple[Real, Real]:
        decay = f.exp(slow_pole * t)
        o: Real = decay * f.expm1(apart * t) * scale
        return decay - d * o, o

    def turn_s(q: Real) -> Real:
        result: Real = f.log1p(2.0 * d * q / (1.0 - d * q)) / (2.0 * d)
        return result

    steepest_s: Real = f.log1p(2.0 * d / slow) / (2.0 * d)
    c, o = motion(steepest_s)
    return Shape(s, stiffness, square, steepest_s, c + s * o, s * math.inf, motion, turn_s)


def ringing(f: Functions[Real], m: Real, n: Real) -> Shape[Real]:
    """Return the motion of a complex pair of poles, `m y'' + n y' + y = 0`."""
    s: Real = n / (2.0 * m)
    stiffness: Real = 1.0 / m
    square: Real = s * s - stiffness
    d: Real = f.sqrt(1e-16 * stiffness - square)  # a double pole may come here by rounding: d must not vanish

    def motion(t: Real) -> tuple[Real, Real]:
        decay = f.exp(-s * t)
        return decay * f.cos(d * t), decay * f.sin(d * t) / d

    def turn_s(q: Real) -> Real:
        result: Real = f.atan(d * q) / d
        return result

    steepest_s: Real = f.atan(d / s) / d
    c, o = motion(steepest_s)
    return Shape(s, stiffness, square, steepest_s, c + s * o, math.pi / d, motion, turn_s)


def swings(
    f: Functions[Real],
    shape: Shape[Real],
    D: Real,
    ends: tuple[Real, Real],
    thresholds: tuple[Real, Real],
    back_at: Callable[[Shape[Real], Real, Real], Real],
) -> Iterator[tuple[Real, Real, Real]]:
    """Yield the swings of a relay test from rest, without end.

    Parameters
    ----------
    f : Functions
        Functions of the kind of number.
    shape : Shape
        The plant's free motion.
    D : float or array
        Dead time, s.
    ends : tuple
        Where the PV is heading at the first level and at the other.
    thresholds : tuple
        PV at which the first level ends, and the other.
    back_at : callable
        Solves `g(tau) = share`, given the shape, the share and a start.

    Yields
    ------
    tuple
        Time of the switch and `tau`, s, and the PV at the turn that follows.
    """
    s, stiffness, square = shape.s, shape.stiffness, shape.square
    c, o = shape.motion(D)
    taus = [shape.steepest_s, shape.steepest_s]
    turned_s, excess, k = D, -ends[0], 0
    while True:
        tau = taus[k] = back_at(shape, (thresholds[k] - ends[k]) / excess, taus[k])
        switch_s = turned_s + tau
        z, v = thresholds[k] - ends[k], -excess * stiffness * shape.motion(tau)[1]
        z, v = c * z + o * (v + s * z) + ends[k] - ends[1 - k], c * v - o * (s * v + stiffness * z)
        k = 1 - k
        q = v / (s * v + stiffness * z)
        wait_s = shape.turn_s(q)
        excess = f.exp(-s * wait_s) * (z + (v + s * z) * q) / f.sqrt(1.0 - square * q * q)
        turned_s = switch_s + D + wait_s
        yield switch_s, tau, ends[k] + excess
