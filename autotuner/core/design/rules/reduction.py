"""Simpler models of a model, for rules that are stated for those.

The half rule: of the lags `T1 >= T2`, half of the one that is dropped goes to the lag that is kept and half to the dead
time; a right-half-plane zero goes to the dead time whole.

    T = T1 + T2/2,   D = D0 + T2/2 + T3 + ... (+ Z)

to two lags likewise, `T2 + T3/2` kept.
(Skogestad, J. Process Control 13, 2003, section 2.) A pair of damping 0.6 or more is taken for two lags of `sqrt(m)`,
which keeps its gain at the frequencies where a loop crosses over.

Merged lags: two lags that a record cannot distinguish.

    K (1 - Z s) e^{-Ds} / ((T1 s + 1)(T2 s + 1)) = K (1 - Z s) e^{-Ds} / (m s^2 + n s + 1),   n = T1 + T2,   m = T1 T2

Where the lags are nearly equal, their errors are not quadratic: the record determines `n` and `m`, and beyond
equal lags the same process rings. So a covariance is that of `(K, m, n, Z, D)` there, and the models of its region
may be of either kind.

`K` PV/output, `m` s^2, `n`, `T1`, `T2`, `Z`, `D` s; `Z` is 0, and no parameter, without an inverse response.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from autotuner.core.model.process import (
    Fopdt,
    InverseResponse,
    InverseResponseUnderdamped,
    NLags,
    Rational,
    SopdtOverdamped,
    SopdtUnderdamped,
    ThirdOrder,
    ThirdOrderUnderdamped,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.process import ProcessModel

LEAST_DAMPING = 0.6
"""Damping ratio from which two poles are close enough to a double real pole for the rules of two lags."""


def half_rule(model: SopdtOverdamped | InverseResponse) -> Fopdt:
    """Return the first-order model with dead time of two real lags, by the half rule."""
    two_lags = zero_as_dead_time(model) if isinstance(model, InverseResponse) else model
    half = two_lags.T2 / 2.0
    return Fopdt(two_lags.K, two_lags.T1 + half, two_lags.D + half)


def _lags_of(model: NLags | ThirdOrder) -> list[float]:
    """Return the lags, the longest first."""
    return [model.T] * round(model.n) if isinstance(model, NLags) else [model.T1, model.T2, model.T3]


def two_lags_of_many(model: NLags | ThirdOrder) -> SopdtOverdamped:
    """Return the two longest lags with half of the third, which goes to the dead time too; the rest is dead time."""
    first, second, *rest = _lags_of(model)
    half, dropped = (rest[0] / 2.0, sum(rest[1:])) if rest else (0.0, 0.0)
    second += half
    return SopdtOverdamped(model.K, max(first, second), min(first, second), model.D + half + dropped)


def one_lag_of_many(model: NLags | ThirdOrder) -> Fopdt:
    """Return the longest lag with half of the next, which goes to the dead time too; the rest is dead time."""
    first, second, *rest = _lags_of(model)
    return Fopdt(model.K, first + second / 2.0, model.D + second / 2.0 + sum(rest))


def zero_as_dead_time(model: InverseResponse) -> SopdtOverdamped:
    """Return the model with its right-half-plane zero taken for dead time."""
    return SopdtOverdamped(model.K, model.T1, model.T2, model.D + model.Z)


def two_equal_lags(model: SopdtUnderdamped) -> SopdtOverdamped | None:
    """Return two lags of `sqrt(m)` for a pair that is damped well enough to pass for them, else None."""
    T = math.sqrt(model.m)
    return SopdtOverdamped(model.K, T, T, model.D) if model.n >= 2.0 * LEAST_DAMPING * T else None


def _lags_of_a_pair_with_zero(model: InverseResponseUnderdamped) -> SopdtOverdamped | None:
    return two_equal_lags(SopdtUnderdamped(model.K, model.m, model.n, model.D + model.Z))


def _half_rule_of_a_pair_with_zero(model: InverseResponseUnderdamped) -> Fopdt | None:
    lags = _lags_of_a_pair_with_zero(model)
    return None if lags is None else half_rule(lags)


def _half_rule_of_a_pair(model: SopdtUnderdamped) -> Fopdt | None:
    lags = two_equal_lags(model)
    return None if lags is None else half_rule(lags)


_REDUCTIONS: dict[type, dict[type, tuple[Callable[..., ProcessModel | None], str]]] = {
    Fopdt: {
        SopdtOverdamped: (half_rule, "the half rule"),
        InverseResponse: (half_rule, "the half rule, the zero taken for dead time"),
        SopdtUnderdamped: (_half_rule_of_a_pair, "the half rule, the damped pair taken for two equal lags"),
        InverseResponseUnderdamped: (
            _half_rule_of_a_pair_with_zero,
            "the half rule, the zero taken for dead time and the damped pair for two equal lags",
        ),
        NLags: (one_lag_of_many, "the half rule"),
        ThirdOrder: (one_lag_of_many, "the half rule"),
    },
    SopdtOverdamped: {
        Fopdt: (lambda m: SopdtOverdamped(m.K, m.T, 0.0, m.D), ""),
        InverseResponse: (zero_as_dead_time, "taking the zero for dead time"),
        SopdtUnderdamped: (two_equal_lags, "taking the damped pair for two equal lags"),
        InverseResponseUnderdamped: (
            _lags_of_a_pair_with_zero,
            "taking the zero for dead time and the damped pair for two equal lags",
        ),
        NLags: (two_lags_of_many, "the half rule"),
        ThirdOrder: (two_lags_of_many, "the half rule"),
    },
}


def reduce_to(kind: type, model: ProcessModel) -> tuple[ProcessModel | None, str]:
    """Return the model as an instance of `kind`, and how it was reduced ("" when nothing was lost).

    Returns
    -------
    model : ProcessModel or None
        None without a sound reduction.
    how : str
        For a warning: the name of the reduction.
    """
    if isinstance(model, kind):
        return model, ""
    reduction = _REDUCTIONS.get(kind, {}).get(type(model))
    return (reduction[0](model), reduction[1]) if reduction else (None, "")


@dataclass(frozen=True, slots=True)
class MergedLags:
    """Two lags by their sum and product, whatever the damping."""

    structure: ClassVar[str] = "merged_lags"
    K: float
    m: float
    n: float
    D: float
    Z: float = 0.0

    def rational(self) -> Rational:
        """Return the delay-free part as polynomial coefficients."""
        return Rational((self.K, -self.K * self.Z), (1.0, self.n, self.m))

    def parameters(self) -> dict[str, float]:
        """Return the parameters by name, in the order of the formula."""
        zero = {"Z": self.Z} if self.Z else {}
        return {"K": self.K, "m": self.m, "n": self.n, **zero, "D": self.D}


@dataclass(frozen=True, slots=True)
class Coefficients:
    """A process of third order by the coefficients of its denominator, whatever its poles."""

    structure: ClassVar[str] = "coefficients"
    K: float
    a1: float
    a2: float
    a3: float
    D: float

    def rational(self) -> Rational:
        """Return the delay-free part as polynomial coefficients."""
        return Rational((self.K, 0.0), (1.0, self.a1, self.a2, self.a3))

    def parameters(self) -> dict[str, float]:
        """Return the parameters by name, in the order of the formula."""
        return {"K": self.K, "a1": self.a1, "a2": self.a2, "a3": self.a3, "D": self.D}


def merged(model: SopdtOverdamped | InverseResponse) -> MergedLags:
    """Return two lags by their sum and product."""
    Z = model.Z if isinstance(model, InverseResponse) else 0.0
    return MergedLags(model.K, model.T1 * model.T2, model.T1 + model.T2, model.D, Z)


def known_within(
    model: ProcessModel, covariance: FloatArray | None, pair_covariance: FloatArray | None
) -> tuple[FloatArray | None, ProcessModel | None]:
    """Return the uncertainty of a process, and the process by its parameters where those are not the model's.

    Parameters
    ----------
    model : ProcessModel
        The process.
    covariance, pair_covariance : array of float, shape (P, P), or None
        Of ``model.parameters()``, and of its merged lags; one that is not finite carries no information.
    """
    if pair_covariance is not None and isinstance(model, ThirdOrder | ThirdOrderUnderdamped):
        _, a1, a2, a3 = model.rational().a
        return _finite(pair_covariance), Coefficients(model.K, a1, a2, a3, model.D)
    if pair_covariance is not None and isinstance(model, SopdtOverdamped | InverseResponse):
        return _finite(pair_covariance), merged(model)
    return _finite(covariance), None


def _finite(covariance: FloatArray | None) -> FloatArray | None:
    return covariance if covariance is not None and bool(np.all(np.isfinite(covariance))) else None
