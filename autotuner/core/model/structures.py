"""Structures for least squares, as data: searched parameters, and the resulting model.

    pv(t) = sum_j gains_j w_j(t - D)  +  background

`w` are the unit-gain responses of a motion whose shape is given by the logarithms of positive numbers (time constants,
so that they stay positive and their errors are relative). The gains are linear in the PV and are solved for, not
searched. A pair of poles has the parameters `n = T1 + T2` and `m/n = T1 T2/(T1 + T2)`, smooth at critical damping;
`m/n -> 0` is the first-order process.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from autotuner.core.model.process import (
    Fopdt,
    Integrating,
    InverseResponse,
    NLags,
    ProcessModel,
    SopdtOverdamped,
    UnstableFopdt,
    second_order,
    second_order_with_zero,
    third_order,
)
from autotuner.core.model.step_responses import (
    EqualLags,
    Integrator,
    Lag,
    LaggedIntegrator,
    Motion,
    Pair,
    PairAndLag,
    UnstableLag,
)
from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence


@dataclass(frozen=True, slots=True)
class Structure:
    """One structure.

    Attributes
    ----------
    name : str
        Stable name, also of the variants that share a model class.
    shape : tuple of str
        Names of the positive numbers that give the motion its shape, s.
    motion : callable
        Makes the motion of such numbers; the second argument is the length of the recording, s.
    model : callable
        Makes the process model of the shape, the gains and the dead time; raises `InputError` where none exists.
    gains : int
        How many response columns there are.
    stiffness : float
        Sign of the denominator's constant term: 1 settles, 0 integrates, -1 runs away.
    chosen : int
        Whole numbers that were chosen and not searched for, such as that of equal lags; each costs a parameter.
    """

    name: str
    shape: tuple[str, ...]
    motion: Callable[[Sequence[float], float], Motion]
    model: Callable[[Sequence[float], Sequence[float], float], ProcessModel]
    gains: int = 1
    stiffness: float = 1.0
    chosen: int = 0

    @property
    def size(self) -> int:
        """Number of process parameters: shape, gains and dead time."""
        return len(self.shape) + self.gains + 1


def _inverse_response(shape: Sequence[float], gains: Sequence[float], D: float) -> ProcessModel:
    return second_order_with_zero(gains[0], shape[0] * shape[1], shape[0], _zero(gains), D)


def _zero(gains: Sequence[float]) -> float:
    """Return the zero's time of the gains of a response and of its slope, s; infinite without a static gain."""
    return -gains[1] / gains[0] if gains[0] else math.inf


def _double_inverse_response(shape: Sequence[float], gains: Sequence[float], D: float) -> ProcessModel:
    return InverseResponse(gains[0], shape[0], shape[0], _zero(gains), D)


def _double_lag(shape: Sequence[float], gains: Sequence[float], D: float) -> ProcessModel:
    return SopdtOverdamped(gains[0], shape[0], shape[0], D)


FOPDT = Structure("fopdt", ("T",), lambda p, _: Lag(p[0]), lambda p, g, D: Fopdt(g[0], p[0], D))
SECOND_ORDER = Structure(
    "second_order",
    ("n", "m/n"),
    lambda p, _: Pair(p[0] * p[1], p[0]),
    lambda p, g, D: second_order(g[0], p[0] * p[1], p[0], D),
)
DOUBLE_LAG = Structure("double_lag", ("T",), lambda p, _: Pair(p[0] ** 2, 2.0 * p[0]), _double_lag)
PURE_INTEGRATOR = Structure(
    "pure_integrator", (), lambda _p, _: Integrator(), lambda _p, g, D: Integrating(g[0], 0.0, D), stiffness=0.0
)
INTEGRATING = Structure(
    "integrating",
    ("T",),
    lambda p, _: LaggedIntegrator(p[0]),
    lambda p, g, D: Integrating(g[0], p[0], D),
    stiffness=0.0,
)
UNSTABLE = Structure(
    "unstable_fopdt",
    ("T",),
    lambda p, span: UnstableLag(p[0], span),
    lambda p, g, D: UnstableFopdt(g[0], p[0], D),
    stiffness=-1.0,
)
INVERSE_RESPONSE = Structure(
    "inverse_response",
    ("n", "m/n"),
    lambda p, _: Pair(p[0] * p[1], p[0], zero=True),
    _inverse_response,
    gains=2,
)
DOUBLE_INVERSE_RESPONSE = Structure(
    "double_inverse_response",
    ("T",),
    lambda p, _: Pair(p[0] ** 2, 2.0 * p[0], zero=True),
    _double_inverse_response,
    gains=2,
)
THIRD_ORDER = Structure(
    "third_order",
    ("n", "m/n", "T"),
    lambda p, _: PairAndLag(p[0] * p[1], p[0], p[2]),
    lambda p, g, D: third_order(g[0], p[0] * p[1], p[0], p[2], D),
)


def _n_lags(n: int) -> Structure:
    return Structure(
        "n_lags", ("T",), lambda p, _: EqualLags(p[0], n), lambda p, g, D: NLags(g[0], p[0], float(n), D), chosen=1
    )


N_LAGS = tuple(_n_lags(n) for n in range(3, 9))
"""Three to eight equal lags, few first; two are a pair, and more than eight resemble fewer with a dead time."""
EQUAL_LAGS = {DOUBLE_LAG: SECOND_ORDER, DOUBLE_INVERSE_RESPONSE: INVERSE_RESPONSE}
"""The edges of two lags, fitted when the best pair lies beyond, and the pairs that they are."""

SEARCHED: dict[str, tuple[Structure, ...]] = {
    "fopdt": (FOPDT,),
    "sopdt_overdamped": (SECOND_ORDER, DOUBLE_LAG),
    "sopdt_underdamped": (SECOND_ORDER,),
    "integrating": (PURE_INTEGRATOR, INTEGRATING),
    "unstable_fopdt": (UNSTABLE,),
    "inverse_response": (INVERSE_RESPONSE, DOUBLE_INVERSE_RESPONSE),
    "inverse_response_underdamped": (INVERSE_RESPONSE,),
    "n_lags": N_LAGS,
    "third_order": (THIRD_ORDER,),
    "third_order_underdamped": (THIRD_ORDER,),
}
"""The structures that are fitted when a structure is requested by name."""


def searched(structure: str) -> tuple[Structure, ...]:
    """Return the structures to fit, by name or for ``auto``.

    Raises
    ------
    InputError
        Unknown name.
    """
    if structure == "auto":
        return (FOPDT, SECOND_ORDER, INVERSE_RESPONSE, *N_LAGS, THIRD_ORDER, PURE_INTEGRATOR, INTEGRATING, UNSTABLE)
    if structure not in SEARCHED:
        raise InputError(
            "is not a known structure",
            field="structure",
            value=structure,
            remedy=f"Use auto or one of {', '.join(SEARCHED)}.",
        )
    return SEARCHED[structure]


def log_shape(shape: Sequence[float]) -> list[float]:
    """Return the logarithms that the search moves."""
    return [math.log(value) for value in shape]
