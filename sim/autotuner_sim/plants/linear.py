"""Linear plants: the processes that the simulator offers.

    Fopdt              K e^{-Ds} / (T s + 1)
    SopdtOverdamped    K e^{-Ds} / ((T1 s + 1)(T2 s + 1))
    SopdtUnderdamped   K e^{-Ds} / (m s^2 + n s + 1),   n^2 < 4 m
    Integrating        K e^{-Ds} / (s (T s + 1))
    UnstableFopdt      K e^{-Ds} / (T s - 1)
    InverseResponse    K (1 - Z s) e^{-Ds} / ((T1 s + 1)(T2 s + 1))
    LagChain           K e^{-Ds} / prod(lags_i s + 1)

`K` PV per output (PV per output and second when integrating); `D`, `T`, `T1`, `T2`, `Z`, `lags` s; `m` s^2; `n` s.
Source: Astrom and Hagglund, Advanced PID Control (2006), ch. 2; the first three are those of the thesis.

Invariants: a plant is a frozen value, and one that cannot exist cannot be made; it moves nothing itself, its
`motion` does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import ClassVar, Protocol

from autotuner_sim.plants.lag_chain import LagChainMotion
from autotuner_sim.plants.motion import Lag, LagPair, Motion, Oscillator


class Plant(Protocol):
    """Interface of every plant."""

    structure: ClassVar[str]

    @property
    def K(self) -> float:
        """Gain, PV per output (PV per output and second when integrating)."""

    @property
    def D(self) -> float:
        """Dead time, s."""

    def motion(self) -> Motion:
        """Return the exact motion of the plant without its dead time."""

    def transfer(self, s: complex) -> complex:
        """Return `G(s)`, dead time included."""


class _Checked:
    """Refuses values that no plant can have."""

    __slots__ = ()
    structure: ClassVar[str]
    positive: ClassVar[tuple[str, ...]] = ()
    not_negative: ClassVar[tuple[str, ...]] = ("D",)

    def __post_init__(self) -> None:
        for field in fields(self):  # type: ignore[arg-type]
            value = getattr(self, field.name)
            for number in value if isinstance(value, tuple) else (value,):
                self._require(math.isfinite(number), field.name, value, "must be finite")
        self._require(getattr(self, "K") != 0.0, "K", 0.0, "must not be zero")  # noqa: B009 - a field of every subclass
        for name in self.positive:
            self._require(getattr(self, name) > 0.0, name, getattr(self, name), "must be positive")
        for name in self.not_negative:
            self._require(getattr(self, name) >= 0.0, name, getattr(self, name), "must not be negative")

    def _require(self, holds: bool, name: str, value: object, message: str) -> None:  # noqa: FBT001
        if not holds:
            raise ValueError(f"{self.structure}.{name} {message} (got {value!r}). Give a physical value for {name}.")


@dataclass(frozen=True, slots=True)
class Fopdt(_Checked):
    """First order plus dead time."""

    structure: ClassVar[str] = "fopdt"
    positive: ClassVar[tuple[str, ...]] = ("T",)
    K: float
    T: float
    D: float

    def motion(self) -> Motion:
        """Return the exact motion of the plant without its dead time."""
        return Lag(-1.0 / self.T, self.K / self.T)

    def transfer(self, s: complex) -> complex:
        """Return `G(s)`, dead time included."""
        return self.K * _delay(self.D, s) / (self.T * s + 1.0)


@dataclass(frozen=True, slots=True)
class SopdtOverdamped(_Checked):
    """Two real lags plus dead time; `T2` may be 0."""

    structure: ClassVar[str] = "sopdt_overdamped"
    positive: ClassVar[tuple[str, ...]] = ("T1",)
    not_negative: ClassVar[tuple[str, ...]] = ("T2", "D")
    K: float
    T1: float
    T2: float
    D: float

    def motion(self) -> Motion:
        """Return the exact motion of the plant without its dead time."""
        return chain_motion((self.T1, self.T2), self.K)

    def transfer(self, s: complex) -> complex:
        """Return `G(s)`, dead time included."""
        return self.K * _delay(self.D, s) / ((self.T1 * s + 1.0) * (self.T2 * s + 1.0))


@dataclass(frozen=True, slots=True)
class SopdtUnderdamped(_Checked):
    """A damped oscillation plus dead time; `n^2 < 4 m`."""

    structure: ClassVar[str] = "sopdt_underdamped"
    positive: ClassVar[tuple[str, ...]] = ("m", "n")
    K: float
    m: float
    n: float
    D: float

    def __post_init__(self) -> None:
        _Checked.__post_init__(self)
        self._require(self.n**2 < 4.0 * self.m, "n", self.n, "must be under 2 sqrt(m), else the plant is overdamped")

    def motion(self) -> Motion:
        """Return the exact motion of the plant without its dead time."""
        decay = self.n / (2.0 * self.m)
        return Oscillator(decay, math.sqrt(1.0 / self.m - decay**2), self.K)

    def transfer(self, s: complex) -> complex:
        """Return `G(s)`, dead time included."""
        return self.K * _delay(self.D, s) / (self.m * s * s + self.n * s + 1.0)


@dataclass(frozen=True, slots=True)
class Integrating(_Checked):
    """An integrator with lag and dead time; `T` may be 0."""

    structure: ClassVar[str] = "integrating"
    not_negative: ClassVar[tuple[str, ...]] = ("T", "D")
    K: float
    T: float
    D: float

    def motion(self) -> Motion:
        """Return the exact motion of the plant without its dead time."""
        if self.T == 0.0:
            return Lag(0.0, self.K)
        return LagPair(p1=-1.0 / self.T, p2=0.0, b=1.0 / self.T, g=1.0, c1=0.0, c2=self.K)

    def transfer(self, s: complex) -> complex:
        """Return `G(s)`, dead time included."""
        return self.K * _delay(self.D, s) / (s * (self.T * s + 1.0))


@dataclass(frozen=True, slots=True)
class UnstableFopdt(_Checked):
    """One unstable pole plus dead time; a symmetric relay holds it only for `D < T ln 2`."""

    structure: ClassVar[str] = "unstable_fopdt"
    positive: ClassVar[tuple[str, ...]] = ("T",)
    K: float
    T: float
    D: float

    def motion(self) -> Motion:
        """Return the exact motion of the plant without its dead time."""
        return Lag(1.0 / self.T, self.K / self.T)

    def transfer(self, s: complex) -> complex:
        """Return `G(s)`, dead time included."""
        return self.K * _delay(self.D, s) / (self.T * s - 1.0)


@dataclass(frozen=True, slots=True)
class InverseResponse(_Checked):
    """Two real lags, a right-half-plane zero and dead time: the PV starts the wrong way."""

    structure: ClassVar[str] = "inverse_response"
    positive: ClassVar[tuple[str, ...]] = ("T1", "T2", "Z")
    K: float
    T1: float
    T2: float
    Z: float
    D: float

    def motion(self) -> Motion:
        """Return the exact motion: with `y = K (x2 - Z x2')` and `x2' = (x1 - x2)/T2`."""
        fast, slow = sorted((self.T1, self.T2))
        share = self.Z / slow
        return LagPair(-1.0 / fast, -1.0 / slow, 1.0 / fast, 1.0 / slow, -self.K * share, self.K * (1.0 + share))

    def transfer(self, s: complex) -> complex:
        """Return `G(s)`, dead time included."""
        zero = self.K * (1.0 - self.Z * s)
        return zero * _delay(self.D, s) / ((self.T1 * s + 1.0) * (self.T2 * s + 1.0))


@dataclass(frozen=True, slots=True)
class LagChain(_Checked):
    """Any number of real lags in a row plus dead time, such as `1/(s + 1)^5`."""

    structure: ClassVar[str] = "lag_chain"
    K: float
    lags: tuple[float, ...]
    D: float

    def __post_init__(self) -> None:
        _Checked.__post_init__(self)
        self._require(bool(self.lags) and min(self.lags) > 0.0, "lags", self.lags, "must all be positive")

    def motion(self) -> Motion:
        """Return the exact motion of the plant without its dead time."""
        return chain_motion(self.lags, self.K)

    def transfer(self, s: complex) -> complex:
        """Return `G(s)`, dead time included."""
        return self.K * _delay(self.D, s) / math.prod((lag * s + 1.0 for lag in self.lags), start=1.0 + 0.0j)


def chain_motion(lags: tuple[float, ...], gain: float) -> Motion:
    """Return the motion of real lags in a row; lags of 0 s are skipped."""
    positive = tuple(sorted(lag for lag in lags if lag > 0.0))
    if len(positive) == 1:
        return Lag(-1.0 / positive[0], gain / positive[0])
    if len(positive) == 2:
        fast, slow = positive
        return LagPair(-1.0 / fast, -1.0 / slow, 1.0 / fast, 1.0 / slow, 0.0, gain)
    return LagChainMotion(positive, gain)


def _delay(D: float, s: complex) -> complex:
    turned: complex = complex(math.cos(D * s.imag), -math.sin(D * s.imag)) * math.exp(-D * s.real)
    return turned


PLANTS: dict[str, type[Plant]] = {
    kind.structure: kind
    for kind in (
        Fopdt,
        SopdtOverdamped,
        SopdtUnderdamped,
        Integrating,
        UnstableFopdt,
        InverseResponse,
        LagChain,
    )
}
"""All plants by the name that files and interfaces use."""
