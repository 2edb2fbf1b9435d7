"""From the learned correction's coordinates without unit to process models in theirs.

    T = (wT) Pu/2 pi,  D = (wD) Pu/2 pi,  m = (mw^2) (Pu/2 pi)^2,  K = r A1/U1   (over Pu/2 pi when integrating)

Standard errors follow by the derivative: that of a logarithm is relative.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from autotuner.core.process import Fopdt, Integrating, SopdtOverdamped, SopdtUnderdamped
from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.core.arrays import FloatArray
    from autotuner.core.identification.relay_wave import RelayWaves
    from autotuner.core.process import ProcessModel


def model_of(structure: str, values: FloatArray, wave: RelayWaves, sign: float) -> ProcessModel | None:
    """Return the process, or None where the structure has none with these coordinates."""
    unit_s = float(wave.Pu[0]) / (2.0 * math.pi)
    K = sign * math.exp(values[-1]) * float(wave.A1[0] / wave.U1[0])
    D = max(float(values[-2]), 0.0) * unit_s
    try:
        return _MODELS[structure](K, D, [float(v) for v in values[:-2]], unit_s)
    except InputError:
        return None


def intervals(structure: str, values: FloatArray, errors: FloatArray, model: ProcessModel) -> dict[str, float]:
    """Return the errors of the parameters, in their units, from those of the coordinates."""
    parameters = model.parameters()
    unit_s = parameters["D"] / float(values[-2]) if values[-2] > 0.0 else 0.0
    found = {"K": abs(parameters["K"]) * float(errors[-1]), "D": unit_s * float(errors[-2])}
    names = [name for name in parameters if name not in {"K", "D"}]
    if structure == "integrating":
        return found | {"T": (parameters["T"] + unit_s) * float(errors[0])}
    return found | {name: parameters[name] * float(error) for name, error in zip(names, errors, strict=False)}


def _overdamped(K: float, D: float, lags: list[float], unit_s: float) -> ProcessModel:
    """Return it with the longer lag first; nearly equal ones may come out in the other order."""
    T1, T2 = sorted((math.exp(v) * unit_s for v in lags), reverse=True)
    return SopdtOverdamped(K, T1, T2, D)


def _underdamped(K: float, D: float, pair: list[float], unit_s: float) -> ProcessModel:
    return SopdtUnderdamped(K, math.exp(pair[0]) * unit_s**2, math.exp(pair[1]) * unit_s, D)


_MODELS: dict[str, Callable[[float, float, list[float], float], ProcessModel]] = {
    "fopdt": lambda K, D, lag, unit_s: Fopdt(K, math.exp(lag[0]) * unit_s, D),
    "sopdt_overdamped": _overdamped,
    "sopdt_underdamped": _underdamped,
    "integrating": lambda K, D, lag, unit_s: Integrating(K / unit_s, max(math.expm1(lag[0]), 0.0) * unit_s, D),
}
