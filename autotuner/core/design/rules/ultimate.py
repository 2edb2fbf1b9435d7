"""Ultimate point of a process: oscillation under proportional control.

    arg G(j wu) = -pi,   Ku = 1/|G(j wu)|,   Pu = 2 pi / wu

solved on the exact frequency response, dead time included, as one equation in the continuous phase. Process classes of
`autotuner.core.model.process`; `Ku` output/PV with the sign of `K`, `Pu` s.

An unstable process has its phase at -180 degrees already at w = 0; the definition takes the upper crossover, which
exists for D < T.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy

from autotuner.core.model.process import NLags, UnstableFopdt, frequency_response, sum_of_lags
from autotuner.errors import InputError

if TYPE_CHECKING:
    from autotuner.core.model.process import ProcessModel


@dataclass(frozen=True, slots=True)
class UltimatePoint:
    """Ultimate gain (output/PV, sign of the process gain) and ultimate period (s).

    Raises
    ------
    InputError
        `Ku` zero or not finite, `Pu` not positive and finite.
    """

    Ku: float
    Pu: float

    def __post_init__(self) -> None:
        if not math.isfinite(self.Ku) or self.Ku == 0.0:
            raise InputError(
                "must be a finite number other than zero",
                field="ultimate.Ku",
                value=self.Ku,
                remedy="Repeat the relay test.",
            )
        if not 0.0 < self.Pu < math.inf:
            raise InputError(
                "must be a positive number", field="ultimate.Pu", value=self.Pu, remedy="Repeat the relay test."
            )


def ultimate_point(model: ProcessModel) -> UltimatePoint | None:
    """Return the ultimate point of a model, or None where its phase never crosses -180 degrees."""
    lower, upper = _bracket(model)
    if upper is None:
        return None
    wu = float(scipy.optimize.brentq(lambda w: phase(model, w) + math.pi, lower, upper, xtol=1e-15 * lower, rtol=1e-14))
    gain = float(np.abs(frequency_response(model, np.array([wu])))[0])
    return UltimatePoint(math.copysign(1.0 / gain, model.K), 2.0 * math.pi / wu)


def phase(model: ProcessModel, frequency_rad_s: float) -> float:
    """Return the continuous phase of `G(jw)/sign(K)` in rad, from its value at `w -> 0`.

    Every factor's own phase is continuous and is added: poles of the denominator, the zero, the dead time.
    """
    w, r = frequency_rad_s, model.rational()
    numerator = math.atan2(r.b[1] * w * math.copysign(1.0, r.b[0]), abs(r.b[0]))
    return numerator - _phase_of_poles(model, r.poles_polynomial(), w) - w * model.D


def _phase_of_poles(model: ProcessModel, a: tuple[float, ...], w: float) -> float:
    """Return the phase of the denominator: lag by lag from order 3 on, where it turns by more than a half circle."""
    if isinstance(model, NLags):
        return model.n * math.atan(model.T * w)
    if len(a) <= 3:
        return math.atan2(a[1] * w, a[0] - (a[2] if len(a) == 3 else 0.0) * w * w)
    return float(sum(np.angle(1.0 - 1j * w / pole) for pole in np.roots(a[::-1])))


def _bracket(model: ProcessModel) -> tuple[float, float | None]:
    """Return frequencies between which the phase crosses -180 degrees once, from above."""
    scale = 1.0 / (sum_of_lags(model) + model.D)
    lower = 1e-9 * scale
    if isinstance(model, UnstableFopdt):
        if model.D >= model.T or model.D == 0.0:
            return lower, None
        # The phase -pi + atan(wT) - wD rises to its maximum at this frequency and falls from there on.
        lower = math.sqrt(1.0 / (model.T * model.D) - 1.0 / model.T**2)
    if phase(model, lower) <= -math.pi:
        return lower, None
    upper = scale
    for _ in range(200):
        if upper > lower and phase(model, upper) < -math.pi:
            return lower, upper
        upper *= 2.0
        if not math.isfinite(upper * upper):
            break
    return lower, None
