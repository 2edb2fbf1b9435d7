"""Influence of a model's covariance on its gains.

With parameters `theta` of covariance `C`, a sensitivity `M(theta)` of the loop with given gains has its 95 % worst
value (to first order) at

    theta + z C g / sqrt(g' C g),   g = dM/dtheta,   z = 1.96

the point of the confidence region in the direction that matters (the most probable point of structural reliability;
Hasofer and Lind, J. Eng. Mech. 100, 1974). Limits that hold there hold for about 97.5 % of the models.

The gains move with the model through the design, `d log gain = J d theta`, so their 95 % interval is
`gain exp(+-z sqrt(J C J'))`.

Invariants: a shifted model stays physical; shifts that would turn a sign are cut.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.design.gains import controller_response
from autotuner.core.design.optimisation.gain_limits import largest_gains
from autotuner.core.design.rules.reduction import Coefficients
from autotuner.core.design.rules.ultimate import ultimate_point
from autotuner.core.model.process import (
    frequency_response,
    model_from_dict,
    second_order,
    second_order_with_zero,
    third_order,
)
from autotuner.core.quantiles import NORMAL_95
from autotuner.errors import InputError

if TYPE_CHECKING:
    from autotuner.core.design.gains import PidGains
    from autotuner.core.design.requirements import Requirements
    from autotuner.core.model.arrays import FloatArray, IntArray
    from autotuner.core.model.process import ProcessModel

SMALLEST_SHARE = 0.2
"""A shifted parameter that must be positive keeps at least this share of its value."""
STEP_SIGMAS = 0.1
"""Step of the numerical gradient of a sensitivity, in standard deviations."""
LARGEST_EXPONENT = 50.0
"""Largest exponent of an interval's factor: `e^50` is any value, and overflows nothing."""
TOLERANCE = 2e-4
"""Excess over a limit of sensitivity that is rounding of the frequency grid."""
NEAR = 0.97
"""Share of its limit from which a peak counts: the model's error may lift it over."""
GAINS = ("Kp", "Ti", "Td", "Tf")


@dataclass(frozen=True, slots=True)
class Interval:
    """A 95 % interval."""

    low: float
    high: float


def checked_covariance(model: ProcessModel, covariance: FloatArray) -> FloatArray:
    """Return the covariance as a symmetric array.

    Raises
    ------
    InputError
        Wrong shape, a value that is not finite, or not positive semidefinite.
    """
    C = np.asarray(covariance, dtype=np.float64)
    count = len(model.parameters())
    symmetric = C.shape == (count, count) and bool(np.all(np.isfinite(C)))
    if symmetric:
        scale = np.sqrt(np.abs(np.diag(C)))
        scale[scale == 0.0] = 1.0
        unit = (C + C.T) / 2.0 / np.outer(scale, scale)
        symmetric = bool(np.linalg.eigvalsh(unit)[0] > -1e-6)
    if not symmetric:
        raise InputError(
            f"must be a finite, positive semidefinite {count} x {count} matrix in the order "
            f"{', '.join(model.parameters())}",
            field="covariance",
            value=C.tolist(),
            remedy="Take it from the identification, or leave it out.",
        )
    return (C + C.T) / 2.0


def shifted(model: ProcessModel, shift: FloatArray) -> ProcessModel:
    """Return the model with its parameters moved, kept physical."""
    given = model.parameters()
    may_vanish = {"D"} if "T3" in given else {"D", "T2"}
    values = {
        name: max(0.0, value + float(change)) if name in may_vanish else _of_its_sign(value, float(change))
        for (name, value), change in zip(given.items(), shift, strict=True)
    }
    if {"m", "Z"} <= values.keys():
        return second_order_with_zero(values["K"], values["m"], values["n"], values["Z"], values["D"])
    if isinstance(model, Coefficients):
        return Coefficients(**values)
    if {"m", "T"} <= values.keys():
        return third_order(values["K"], values["m"], values["n"], values["T"], values["D"])
    if "m" in values:
        return second_order(values["K"], values["m"], values["n"], values["D"])
    lags = [name for name in ("T1", "T2", "T3") if name in values]
    values.update(zip(lags, sorted((values[name] for name in lags), reverse=True), strict=True))
    return model_from_dict(values, model.structure)


def _of_its_sign(value: float, change: float) -> float:
    return math.copysign(max(abs(value) * SMALLEST_SHARE, abs(value) + math.copysign(1.0, value) * change), value)


def worst_models(
    model: ProcessModel, gains: PidGains, covariance: FloatArray, w: FloatArray, limits: Requirements
) -> tuple[ProcessModel, ...]:
    """Return the models of the 95 % region on which the peaks of the sensitivities are highest, to first order.

    The height of a peak changes with the model as the sensitivity at its frequency does, so each peak has its own
    gradient and its own worst model.
    """
    curves = _shares(model, gains, w, limits)
    rows, columns = _high_peaks(curves)
    gradient = np.zeros((rows.size, covariance.shape[0]))
    for i, sigma in enumerate(np.sqrt(np.diag(covariance))):
        if sigma == 0.0:
            continue
        step = np.zeros(covariance.shape[0])
        step[i] = STEP_SIGMAS * sigma
        forward, backward = (_shares(shifted(model, move), gains, w[columns], limits) for move in (step, -step))
        gradient[:, i] = (forward - backward)[rows, np.arange(rows.size)] / (2.0 * STEP_SIGMAS * sigma)
    spread = np.sqrt(np.einsum("ij,jk,ik->i", gradient, covariance, gradient))
    return tuple(
        shifted(model, NORMAL_95 * (covariance @ g) / length)
        for g, length in zip(gradient, spread, strict=True)
        if length > 0.0
    )


def outside_limits(model: ProcessModel, gains: PidGains, w: FloatArray, limits: Requirements) -> bool:
    """Return whether a sensitivity of the loop exceeds its limit."""
    return bool(np.max(_shares(model, gains, w, limits)) > 1.0 + TOLERANCE)


def _high_peaks(curves: FloatArray) -> tuple[IntArray, IntArray]:
    """Return row and column of the local maxima of two curves that are near their limit of 1 (or of the highest)."""
    inner = (curves[:, 1:-1] >= curves[:, :-2]) & (curves[:, 1:-1] > curves[:, 2:])
    rows, columns = np.nonzero(inner & (curves[:, 1:-1] > NEAR * min(1.0, float(np.max(curves)))))
    return rows, columns + 1


def _shares(model: ProcessModel, gains: PidGains, w: FloatArray, limits: Requirements) -> FloatArray:
    """Return `|S|` and `|T|`, each as a share of its limit, shape (2, N)."""
    loop = controller_response(gains, w) * frequency_response(model, w)
    S = 1.0 / np.abs(1.0 + loop)
    return np.stack((S / limits.Ms, np.abs(loop) * S / limits.Mt))


def gain_intervals(
    model: ProcessModel, gains: PidGains, covariance: FloatArray, w: FloatArray, limits: Requirements
) -> dict[str, Interval]:
    """Return 95 % intervals of the gains that are not zero.

    The times are taken to move with the ultimate period, and `Kp` with them and with the limits on the moved model.
    """
    names = [name for name in GAINS if 0.0 < abs(getattr(gains, name)) < math.inf]
    here = _moved_gains(model, model, gains, w, limits)
    J = np.zeros((len(names), covariance.shape[0]))
    for i, sigma in enumerate(np.sqrt(np.diag(covariance))):
        step = np.zeros(covariance.shape[0])
        step[i] = STEP_SIGMAS * sigma
        moved = _moved_gains(model, shifted(model, step), gains, w, limits) if sigma > 0.0 else here
        if here is not None and moved is not None:
            change = [math.log(getattr(moved, name) / getattr(here, name)) for name in names]
            J[:, i] = np.array(change) / (step[i] or 1.0)
    spread = np.sqrt(np.einsum("ij,jk,ik->i", J, covariance, J))
    factors = np.exp(np.minimum(NORMAL_95 * spread, LARGEST_EXPONENT))
    values = [getattr(gains, name) for name in names]
    return {
        name: Interval(*sorted((float(value / factor), float(value * factor))))
        for name, value, factor in zip(names, values, factors, strict=True)
    }


def _moved_gains(
    model: ProcessModel, moved: ProcessModel, gains: PidGains, w: FloatArray, limits: Requirements
) -> PidGains | None:
    """Return the controller of the moved model: times in proportion to its ultimate period, gain by the limits."""
    before, after = ultimate_point(model), ultimate_point(moved)
    if before is None or after is None:
        return None
    ratio = after.Pu / before.Pu
    shape = replace(gains, Kp=1.0, Ti=gains.Ti * ratio, Td=gains.Td * ratio, Tf=gains.Tf * ratio)
    unit = math.copysign(1.0, model.K) * controller_response(shape, w)
    edges = largest_gains(unit * frequency_response(moved, w), limits.Ms, limits.Mt)
    nearest = min(edges, key=lambda k: abs(math.log(k / abs(gains.Kp))), default=None)
    return None if nearest is None else replace(shape, Kp=math.copysign(nearest, model.K))
