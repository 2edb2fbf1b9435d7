"""Process models: the results of the identification and the inputs of the design.

    G(s) = (b0 + b1 s) / (a0 + a1 s + a2 s^2 + ...) e^{-D s}

    FOPDT               K / (T s + 1)
    SOPDT overdamped    K / ((T1 s + 1)(T2 s + 1)),  T1 >= T2
    SOPDT underdamped   K / (m s^2 + n s + 1),       n^2 < 4 m
    integrating         K / (s (T s + 1))
    unstable            K / (T s - 1)
    inverse response    K (1 - Z s) / ((T1 s + 1)(T2 s + 1)),  Z > 0
      , underdamped     K (1 - Z s) / (m s^2 + n s + 1),       n^2 < 4 m
    n equal lags        K / (T s + 1)^n,  n = 2, 3, ...
    third order         K / ((T1 s + 1)(T2 s + 1)(T3 s + 1)),  T1 >= T2 >= T3
      , underdamped     K / ((m s^2 + n s + 1)(T s + 1)),      n^2 < 4 m

`K` static gain (PV/output; PV/(output s) when integrating), `D` dead time, `T`, `T1`, `T2`, `T3`, `Z` time constants,
all in s; `m` s^2, `n` s, but the `n` of equal lags is their number. Thesis eqs. 3.1, 3.7, 3.15; the others are the
textbook forms (Astrom and Hagglund, Advanced PID Control, 2006).

Invariants: a model is a frozen value; everything else is derived from it; a model that cannot exist cannot be
made.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, ClassVar, Protocol, runtime_checkable

import numpy as np

from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.model.arrays import ComplexArray, FloatArray


@dataclass(frozen=True, slots=True)
class Rational:
    """The delay-free part: ascending coefficients of numerator `b` (2) and denominator `a` (3 or more)."""

    b: tuple[float, float]
    a: tuple[float, ...]

    def poles_polynomial(self) -> tuple[float, ...]:
        """Return the denominator without the zeros at its end."""
        order = max(k for k, value in enumerate(self.a) if value != 0.0)
        return self.a[: order + 1]


@runtime_checkable
class ProcessModel(Protocol):
    """Interface of every process model."""

    structure: ClassVar[str]

    @property
    def K(self) -> float:
        """Static gain, PV/output; PV/(output s) for an integrating process."""

    @property
    def D(self) -> float:
        """Dead time, s."""

    def rational(self) -> Rational:
        """Return the delay-free part as polynomial coefficients."""

    def parameters(self) -> dict[str, float]:
        """Return the parameters by name, in the order of the formula."""


class _Parameters:
    """Shared by all models: checks and the mapping view of the fields."""

    __slots__ = ()
    structure: ClassVar[str]
    positive: ClassVar[tuple[str, ...]] = ()
    not_negative: ClassVar[tuple[str, ...]] = ("D",)

    def __post_init__(self) -> None:
        for name, value in self.parameters().items():
            _require(math.isfinite(value), name, value, "must be a finite number")
        _require(
            self.parameters()["K"] != 0.0, "K", 0.0, "must not be zero: a process without gain cannot be controlled"
        )
        for name in self.positive:
            _require(getattr(self, name) > 0.0, name, getattr(self, name), "must be positive")
        for name in self.not_negative:
            _require(getattr(self, name) >= 0.0, name, getattr(self, name), "must not be negative")

    def parameters(self) -> dict[str, float]:
        """Return the parameters by name, in the order of the formula."""
        return {f.name: float(getattr(self, f.name)) for f in fields(self)}  # type: ignore[arg-type]


def _require(holds: bool, name: str, value: float, requirement: str) -> None:  # noqa: FBT001
    if not holds:
        raise InputError(requirement, field=f"model.{name}", value=value, remedy=f"Give a physical value for {name}.")


@dataclass(frozen=True, slots=True)
class Fopdt(_Parameters):
    """First order plus dead time, `K e^{-Ds} / (T s + 1)`."""

    structure: ClassVar[str] = "fopdt"
    positive: ClassVar[tuple[str, ...]] = ("T",)
    K: float
    T: float
    D: float

    def rational(self) -> Rational:
        """Return the delay-free part as polynomial coefficients."""
        return Rational((self.K, 0.0), (1.0, self.T, 0.0))


@dataclass(frozen=True, slots=True)
class SopdtOverdamped(_Parameters):
    """Two real lags plus dead time, `K e^{-Ds} / ((T1 s + 1)(T2 s + 1))`; `T1 >= T2`."""

    structure: ClassVar[str] = "sopdt_overdamped"
    positive: ClassVar[tuple[str, ...]] = ("T1",)
    not_negative: ClassVar[tuple[str, ...]] = ("T2", "D")
    K: float
    T1: float
    T2: float
    D: float

    def __post_init__(self) -> None:
        _Parameters.__post_init__(self)
        _require(self.T1 >= self.T2, "T2", self.T2, "must not exceed T1")

    def rational(self) -> Rational:
        """Return the delay-free part as polynomial coefficients."""
        return Rational((self.K, 0.0), (1.0, self.T1 + self.T2, self.T1 * self.T2))


@dataclass(frozen=True, slots=True)
class SopdtUnderdamped(_Parameters):
    """A damped oscillation plus dead time, `K e^{-Ds} / (m s^2 + n s + 1)`; `n^2 < 4 m`."""

    structure: ClassVar[str] = "sopdt_underdamped"
    positive: ClassVar[tuple[str, ...]] = ("m", "n")
    K: float
    m: float
    n: float
    D: float

    def __post_init__(self) -> None:
        _Parameters.__post_init__(self)
        _require(self.n**2 < 4.0 * self.m, "n", self.n, "must be under 2 sqrt(m), else the process is overdamped")

    def rational(self) -> Rational:
        """Return the delay-free part as polynomial coefficients."""
        return Rational((self.K, 0.0), (1.0, self.n, self.m))


@dataclass(frozen=True, slots=True)
class Integrating(_Parameters):
    """An integrator with lag and dead time, `K e^{-Ds} / (s (T s + 1))`; `T` may be 0."""

    structure: ClassVar[str] = "integrating"
    not_negative: ClassVar[tuple[str, ...]] = ("T", "D")
    K: float
    T: float
    D: float

    def rational(self) -> Rational:
        """Return the delay-free part as polynomial coefficients."""
        return Rational((self.K, 0.0), (0.0, 1.0, self.T))


@dataclass(frozen=True, slots=True)
class UnstableFopdt(_Parameters):
    """One unstable pole plus dead time, `K e^{-Ds} / (T s - 1)`."""

    structure: ClassVar[str] = "unstable_fopdt"
    positive: ClassVar[tuple[str, ...]] = ("T",)
    K: float
    T: float
    D: float

    def rational(self) -> Rational:
        """Return the delay-free part as polynomial coefficients."""
        return Rational((self.K, 0.0), (-1.0, self.T, 0.0))


@dataclass(frozen=True, slots=True)
class InverseResponse(_Parameters):
    """Two real lags, a right-half-plane zero and dead time, `K (1 - Z s) e^{-Ds} / ((T1 s + 1)(T2 s + 1))`."""

    structure: ClassVar[str] = "inverse_response"
    positive: ClassVar[tuple[str, ...]] = ("T1", "Z")
    not_negative: ClassVar[tuple[str, ...]] = ("T2", "D")
    K: float
    T1: float
    T2: float
    Z: float
    D: float

    def rational(self) -> Rational:
        """Return the delay-free part as polynomial coefficients."""
        return Rational((self.K, -self.K * self.Z), (1.0, self.T1 + self.T2, self.T1 * self.T2))


@dataclass(frozen=True, slots=True)
class InverseResponseUnderdamped(_Parameters):
    """A pair of poles off the real axis, a right-half-plane zero and dead time; three lags and a zero are near to it.

    `K (1 - Z s) e^{-Ds} / (m s^2 + n s + 1)`; `n^2 < 4 m`.
    """

    structure: ClassVar[str] = "inverse_response_underdamped"
    positive: ClassVar[tuple[str, ...]] = ("m", "n", "Z")
    K: float
    m: float
    n: float
    Z: float
    D: float

    def __post_init__(self) -> None:
        _Parameters.__post_init__(self)
        _require(self.n**2 < 4.0 * self.m, "n", self.n, "must be under 2 sqrt(m), else the poles are two lags")

    def rational(self) -> Rational:
        """Return the delay-free part as polynomial coefficients."""
        return Rational((self.K, -self.K * self.Z), (1.0, self.n, self.m))


MOST_LAGS = 20
"""Most equal lags of a model; a process of more is a dead time to every controller."""


@dataclass(frozen=True, slots=True)
class NLags(_Parameters):
    """Equal lags in series plus dead time, `K e^{-Ds} / (T s + 1)^n`."""

    structure: ClassVar[str] = "n_lags"
    positive: ClassVar[tuple[str, ...]] = ("T",)
    K: float
    T: float
    n: float
    D: float

    def __post_init__(self) -> None:
        _Parameters.__post_init__(self)
        whole = self.n == round(self.n) and 2 <= self.n <= MOST_LAGS
        _require(whole, "n", self.n, f"must be a whole number from 2 to {MOST_LAGS}")

    def rational(self) -> Rational:
        """Return the delay-free part as polynomial coefficients."""
        n = round(self.n)
        return Rational((self.K, 0.0), tuple(math.comb(n, k) * self.T**k for k in range(n + 1)))


@dataclass(frozen=True, slots=True)
class ThirdOrder(_Parameters):
    """Three real lags plus dead time, `K e^{-Ds} / ((T1 s + 1)(T2 s + 1)(T3 s + 1))`; `T1 >= T2 >= T3`."""

    structure: ClassVar[str] = "third_order"
    positive: ClassVar[tuple[str, ...]] = ("T1", "T2", "T3")
    K: float
    T1: float
    T2: float
    T3: float
    D: float

    def __post_init__(self) -> None:
        _Parameters.__post_init__(self)
        _require(self.T1 >= self.T2, "T2", self.T2, "must not exceed T1")
        _require(self.T2 >= self.T3, "T3", self.T3, "must not exceed T2")

    def rational(self) -> Rational:
        """Return the delay-free part as polynomial coefficients."""
        return Rational((self.K, 0.0), _with_lag((1.0, self.T1 + self.T2, self.T1 * self.T2), self.T3))


@dataclass(frozen=True, slots=True)
class ThirdOrderUnderdamped(_Parameters):
    """A damped oscillation, a lag and dead time, `K e^{-Ds} / ((m s^2 + n s + 1)(T s + 1))`; `n^2 < 4 m`."""

    structure: ClassVar[str] = "third_order_underdamped"
    positive: ClassVar[tuple[str, ...]] = ("m", "n", "T")
    K: float
    m: float
    n: float
    T: float
    D: float

    def __post_init__(self) -> None:
        _Parameters.__post_init__(self)
        _require(self.n**2 < 4.0 * self.m, "n", self.n, "must be under 2 sqrt(m), else the poles are three lags")

    def rational(self) -> Rational:
        """Return the delay-free part as polynomial coefficients."""
        return Rational((self.K, 0.0), _with_lag((1.0, self.n, self.m), self.T))


def _with_lag(a: tuple[float, float, float], T: float) -> tuple[float, float, float, float]:
    return a[0], a[1] + T * a[0], a[2] + T * a[1], T * a[2]


STRUCTURES: dict[str, type[_Parameters]] = {
    kind.structure: kind
    for kind in (
        Fopdt,
        SopdtOverdamped,
        SopdtUnderdamped,
        Integrating,
        UnstableFopdt,
        InverseResponse,
        InverseResponseUnderdamped,
        NLags,
        ThirdOrder,
        ThirdOrderUnderdamped,
    )
}
"""All model classes by the name that files and interfaces use."""


def second_order(K: float, m: float, n: float, D: float) -> SopdtOverdamped | SopdtUnderdamped:
    """Return the overdamped or underdamped model of `K e^{-Ds} / (m s^2 + n s + 1)`, whichever it is.

    `T1,2 = n/2 +- sqrt(n^2/4 - m)` (DESIGN of the method, thesis eqs. 3.13 and 3.14).
    """
    discriminant = n * n / 4.0 - m
    if discriminant < 0.0:
        return SopdtUnderdamped(K, m, n, D)
    T1 = n / 2.0 + math.sqrt(discriminant)
    return SopdtOverdamped(K, T1, min(m / T1, T1), D)


def second_order_with_zero(
    K: float, m: float, n: float, Z: float, D: float
) -> InverseResponse | InverseResponseUnderdamped:
    """Return the model of `K (1 - Z s) e^{-Ds} / (m s^2 + n s + 1)` with two lags or a pair, whichever it is."""
    if n * n / 4.0 < m:
        return InverseResponseUnderdamped(K, m, n, Z, D)
    T1 = n / 2.0 + math.sqrt(n * n / 4.0 - m)
    return InverseResponse(K, T1, min(m / T1, T1), Z, D)


def third_order(K: float, m: float, n: float, T: float, D: float) -> ThirdOrder | ThirdOrderUnderdamped:
    """Return the model of `K e^{-Ds} / ((m s^2 + n s + 1)(T s + 1))` with three lags or a pair, whichever it is."""
    if n * n / 4.0 < m:
        return ThirdOrderUnderdamped(K, m, n, T, D)
    T1 = n / 2.0 + math.sqrt(n * n / 4.0 - m)
    shortest, middle, longest = sorted((T1, min(m / T1, T1), T))
    return ThirdOrder(K, longest, middle, shortest, D)


def sum_of_lags(model: ProcessModel) -> float:
    """Return the sum of all times of a process but its dead time, s."""
    if isinstance(model, NLags):
        return model.n * model.T
    values = model.parameters()
    return sum(values.get(name, 0.0) for name in ("T", "T1", "T2", "T3", "Z", "a1")) + math.sqrt(values.get("m", 0.0))


def frequency_response(model: ProcessModel, frequency_rad_s: FloatArray) -> ComplexArray:
    """Return `G(jw)` at the given angular frequencies (rad/s), with the exact dead time.

    Parameters
    ----------
    model : ProcessModel
        The process.
    frequency_rad_s : array of float, any shape
        Angular frequencies in rad/s.
    """
    s = 1j * np.asarray(frequency_rad_s, dtype=np.float64)
    r = model.rational()
    denominator = np.polyval(r.poles_polynomial()[::-1], s)
    response: ComplexArray = (r.b[0] + s * r.b[1]) / denominator * np.exp(-s * model.D)
    return response


def model_to_dict(model: ProcessModel) -> dict[str, str | float]:
    """Return `{"structure": ..., parameter: value, ...}`, JSON-ready."""
    return {"structure": model.structure, **model.parameters()}


def model_from_dict(values: Mapping[str, object], structure: str | None = None) -> ProcessModel:
    """Make a model from named values.

    Parameters
    ----------
    values : mapping
        Parameters by name; ``structure`` names the class. Without it the class follows from the names given.
    structure : str, optional
        Overrides ``values["structure"]``.

    Raises
    ------
    InputError
        Unknown structure, missing, surplus, non-numeric or unphysical parameter; names the field.
    """
    given = {name: value for name, value in values.items() if name != "structure"}
    kind = _class_of(structure or values.get("structure"), frozenset(given))
    names = [f.name for f in fields(kind)]  # type: ignore[arg-type]
    if surplus := sorted(set(given) - set(names)):
        raise InputError(
            f"is not a parameter of {kind.structure}",
            field=f"model.{surplus[0]}",
            value=given[surplus[0]],
            remedy=f"Use {', '.join(names)}.",
        )
    model = kind(**{name: _number(given, name) for name in names})
    assert isinstance(model, ProcessModel)  # noqa: S101 - narrows the type; every class in STRUCTURES satisfies it
    return model


def _class_of(structure: object, names: frozenset[str]) -> type[_Parameters]:
    if structure is None:
        by_names = {frozenset(f.name for f in fields(kind)): kind for kind in reversed(STRUCTURES.values())}  # type: ignore[arg-type]
        if names in by_names:
            return by_names[names]
    elif isinstance(structure, str) and structure in STRUCTURES:
        return STRUCTURES[structure]
    raise InputError(
        "is not a known structure",
        field="model.structure",
        value=structure,
        remedy=f"Use one of {', '.join(STRUCTURES)}.",
    )


def _number(values: Mapping[str, object], name: str) -> float:
    value = values.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError("must be a number", field=f"model.{name}", value=value, remedy=f"Give {name} as a number.")
    return float(value)
