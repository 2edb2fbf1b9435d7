"""The free motion of thousands of second-order plants, `z'' + 2 zeta z' + z = 0`: the equations of `batch_swings`."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.float64]

_LEAST = 1e-100
_VANISHES = 40.0
"""Exponent of a decay below rounding: what is left of a swing when the PV would turn again."""


class Free(Protocol):
    """The free motion of a second-order plant."""

    @property
    def zeta(self) -> Numbers:
        """Damping."""

    @property
    def square(self) -> Numbers:
        """`d^2`."""

    @property
    def again(self) -> Numbers | float:
        """Time from one turn to the next."""

    @property
    def shrinks(self) -> Numbers | float:
        """Share that is left of a turn at the next one."""

    def motion(self, t: Numbers) -> tuple[Numbers, Numbers]:
        """Return `c` and `o`."""

    def turn(self, q: Numbers) -> Numbers:
        """Return `atanh(d q)/d`."""

    def only(self, rows: NDArray[np.intp]) -> Free:
        """Return some of the plants."""

    def each(self) -> Free:
        """Return the plants for times of shape (N, n)."""


class Creeping:
    """Two real poles."""

    again = math.inf
    shrinks = 0.0

    def __init__(self, zeta: Numbers) -> None:
        self.zeta = zeta
        self.square = zeta * zeta - 1.0
        self._d = np.sqrt(np.abs(self.square)) + _LEAST
        self._slow = -1.0 / (zeta + self._d)
        self._apart = -2.0 * self._d

    def motion(self, t: Numbers) -> tuple[Numbers, Numbers]:
        """Return `c` and `o`."""
        c: Numbers = np.exp(self._slow * t)
        o: Numbers = np.expm1(self._apart * t)
        o *= c
        o /= self._apart
        c -= self._d * o
        return c, o

    def turn(self, q: Numbers) -> Numbers:
        """Return `atanh(d q)/d`."""
        dq = self._d * q
        turn: Numbers = np.log1p(2.0 * dq / (1.0 - dq))
        turn /= -self._apart
        return turn

    def only(self, rows: NDArray[np.intp]) -> Creeping:
        """Return some of the plants."""
        return Creeping(self.zeta[rows])

    def each(self) -> Creeping:
        """Return the plants for times of shape (N, n)."""
        return Creeping(self.zeta[:, None])


class Ringing:
    """A complex pair of poles; sine and cosine by the tangent of the half angle, which NumPy has in vectors."""

    def __init__(self, zeta: Numbers) -> None:
        self.zeta = zeta
        self.square = zeta * zeta - 1.0
        self._d = np.sqrt(1e-16 - self.square)  # a double pole may come here by rounding: d must not vanish
        self._half = self._d / 2.0

    @property
    def again(self) -> Numbers:
        """Time from one turn to the next; infinite where nothing would be left of it."""
        again = math.pi / self._d
        return np.where(self.zeta * again < _VANISHES, again, math.inf)

    @property
    def shrinks(self) -> Numbers:
        """Share that is left of a turn at the next one."""
        shrinks: Numbers = np.exp(-self.zeta * math.pi / self._d)
        return shrinks

    def motion(self, t: Numbers) -> tuple[Numbers, Numbers]:
        """Return `c` and `o`."""
        c: Numbers = np.exp(-self.zeta * t)
        o: Numbers = np.tan(self._half * t)
        squared = o * o
        c /= squared + 1.0
        o *= c
        o /= self._half
        np.subtract(1.0, squared, out=squared)
        c *= squared
        return c, o

    def turn(self, q: Numbers) -> Numbers:
        """Return `atan(|d| q)/|d|`."""
        turn: Numbers = np.arctan(self._d * q)
        turn /= self._d
        return turn

    def first_turn(self, z: Numbers, v: Numbers) -> tuple[Numbers, Numbers]:
        """Return when the PV turns first, and `z` there."""
        wait = np.arctan2(self._d * v, self.zeta * v + z)
        wait += np.where(v > 0.0, 0.0, math.pi)
        wait /= self._d
        return wait, np.copysign(np.sqrt(v * v + z * (2.0 * self.zeta * v + z)), v) * np.exp(-self.zeta * wait)

    def only(self, rows: NDArray[np.intp]) -> Ringing:
        """Return some of the plants."""
        return Ringing(self.zeta[rows])

    def each(self) -> Ringing:
        """Return the plants for times of shape (N, n)."""
        return Ringing(self.zeta[:, None])
