"""Uncertainty of a model at the crossover frequency, where it matters for the design of a controller.

A controller depends on the response around the crossover frequency of the loop, taken here as

    w0: arg G(jw0)/K = -120 degrees     (w0 = 1/(sum of all times) for a process that never lags so far)

and on the relative error of `G(jw0)`, gain and phase together, not that of `K` or `T` alone: a lag far
longer than the record leaves both uncertain but determines their ratio, which is sufficient at `w0`.

    error = sqrt(tr(g C g^H)),   g = d ln G(jw0) / d parameters,   C their covariance

The cost for gains that keep their robustness over the 95 % region: loop gain and integral time are reduced by
`z error` each, and the error after a load step, `Ti/Kp`, is larger than with an exactly known process by

    loss = (1 + z error)^2 - 1,   z = 1.96
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.model.arrays import SMALLEST_DIVISOR
from autotuner.core.model.process import STRUCTURES, ProcessModel, frequency_response, sum_of_lags
from autotuner.core.quantiles import NORMAL_95

if TYPE_CHECKING:
    from autotuner.core.model.arrays import FloatArray

TURN_OVER = -2.0 * math.pi / 3.0
"""Phase at which a controller with integral action crosses over at a phase margin of 60 degrees, rad."""
STEP = 1e-6
"""Relative step of the numerical slopes: the cube root of a double's rounding, rounded down."""
TOO_VAGUE = 0.5
"""Relative standard error of the response at turn-over above which no model is given."""


def turn_over_frequency(model: ProcessModel) -> float:
    """Return `w0`, rad/s."""
    w = np.geomspace(1e-3, 1e3, 2001) / max(sum_of_lags(model) + model.D, SMALLEST_DIVISOR)
    phase = np.unwrap(np.angle(frequency_response(model, w) / model.K))
    beyond = np.flatnonzero(phase <= TURN_OVER)
    return float(w[beyond[0]] if beyond.size else w[1000])


def expected_loss(model: ProcessModel, covariance: FloatArray | None) -> float:
    """Return by which share the load error of gains for the 95 % region exceeds that of a process known exactly."""
    return math.inf if covariance is None else (1.0 + NORMAL_95 * response_error(model, covariance)) ** 2 - 1.0


def response_error(model: ProcessModel, covariance: FloatArray) -> float:
    """Return the relative standard error of `G(jw0)`.

    Parameters
    ----------
    model : ProcessModel
        The process.
    covariance : array of float, shape (P, P)
        Of its parameters, in their order.
    """
    w = np.array([turn_over_frequency(model)])
    values = model.parameters()
    kind, base = STRUCTURES[model.structure], complex(frequency_response(model, w)[0])
    slopes = []
    for name, value in values.items():
        if (name, model.structure) == ("n", "n_lags"):
            slopes.append(0.0)  # an integer parameter has no standard error
            continue
        # A step down keeps T2 <= T1 and n^2 < 4 m for every parameter but m and T1, which are stepped up.
        step = STEP * abs(value) * (1.0 if name in {"m", "T1"} else -1.0)
        other = kind(**{**values, name: value + step}) if step else model
        slopes.append((complex(frequency_response(other, w)[0]) / base - 1.0) / step if step else 0.0)  # type: ignore[arg-type]
    g = np.array(slopes)
    return float(np.sqrt(max((g @ covariance @ g.conj()).real, 0.0)))
