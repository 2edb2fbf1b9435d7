"""Plants given by polynomials: a further lag, a right half-plane zero, a slow mode in parallel with a fast one.

    G(s) = (b0 + b1 s + ...)/(a0 + a1 s + ...) e^{-Ds},   x' = A x + B u,   y = C x

in the controllable form, moved by the exponential of `[[A, B], [0, 0]] h` (Van Loan, IEEE Transactions on Automatic
Control 23, 1978). Any strictly proper plant; coefficients ascending in powers of s. It knows no turning points, so it
serves `SteppedPlant`, not the exact relay runs.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import scipy

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from autotuner_sim.plants.motion import State


@lru_cache(maxsize=64)
def _matrix(a: tuple[float, ...]) -> NDArray[np.float64]:
    order = len(a) - 1
    matrix = np.zeros((order + 1, order + 1))
    matrix[np.arange(order - 1), np.arange(1, order)] = 1.0
    matrix[order - 1, :order] = -np.array(a[:-1]) / a[-1]
    matrix[order - 1, order] = 1.0 / a[-1]
    return matrix


@lru_cache(maxsize=4096)
def _transition(a: tuple[float, ...], h: float) -> NDArray[np.float64]:
    transition: NDArray[np.float64] = scipy.linalg.expm(_matrix(a) * h)
    return transition[:-1]


@dataclass(frozen=True, slots=True)
class RationalMotion:
    """The motion of a rational plant without its dead time."""

    b: tuple[float, ...]
    a: tuple[float, ...]

    @property
    def rest(self) -> State:
        """The state at rest with input 0."""
        return (0.0,) * (len(self.a) - 1)

    @property
    def time_scale_s(self) -> float:
        """Sum of the time constants, s; 0 for an integrator."""
        return self.a[1] / self.a[0] if self.a[0] else 0.0

    def move(self, x: State, u: float, h: float) -> State:
        """Return the state after `h` seconds of input `u`."""
        return tuple((_transition(self.a, h) @ (*x, u)).tolist())

    def output(self, x: State) -> float:
        """Return the PV of a state."""
        return sum(b * value for b, value in zip(self.b, x, strict=False))

    def turning_points(self, x: State, u: float, span: float) -> Iterator[float]:
        """Refuse: they are not needed."""
        raise NotImplementedError(
            "a rational plant is stepped; use one of autotuner_sim.plants.linear for exact relay runs"
        )


@dataclass(frozen=True, slots=True)
class RationalPlant:
    """A strictly proper plant by its coefficients, ascending in powers of s, plus dead time."""

    structure: ClassVar[str] = "rational"
    b: tuple[float, ...]
    a: tuple[float, ...]
    D: float

    def __post_init__(self) -> None:
        if not 1 <= len(self.b) < len(self.a) or self.a[-1] == 0.0:
            raise ValueError(f"rational.a must be of higher order than b (got b {self.b}, a {self.a}).")
        if not self.D >= 0.0:
            raise ValueError(f"rational.D must not be negative (got {self.D!r}).")

    @property
    def K(self) -> float:
        """Static gain, PV/output; PV/(output s) when integrating."""
        return self.b[0] / (self.a[0] or self.a[1])

    def motion(self) -> RationalMotion:
        """Return the exact motion of the plant without its dead time."""
        return RationalMotion(self.b, self.a)

    def transfer(self, s: complex) -> complex:
        """Return `G(s)`, dead time included."""
        value = np.polyval(self.b[::-1], s) / np.polyval(self.a[::-1], s) * np.exp(-self.D * s)
        return complex(value)

    def times(self, b: tuple[float, ...], a: tuple[float, ...]) -> RationalPlant:
        """Return the plant in series with `b/a`."""
        return RationalPlant(_product(self.b, b), _product(self.a, a), self.D)

    def beside(self, other_b: tuple[float, ...], a: tuple[float, ...]) -> RationalPlant:
        """Return the plant plus `other_b/a` after the same dead time."""
        first, second = _product(self.b, a), _product(other_b, self.a)
        return RationalPlant(
            tuple(np.polynomial.polynomial.polyadd(first, second).tolist()), _product(self.a, a), self.D
        )


def _product(one: tuple[float, ...], other: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(np.polynomial.polynomial.polymul(one, other).tolist())
