"""Laplace transform of the first transient: the transfer function at real frequencies.

    G(s) = int y e^{-s t} dt / int u e^{-s t} dt,   s = s1, 2 s1, 3 s1, 4 s1,   s1 = 15/(length of the record)

from rest at t = 0, so that `e^{-s t}` has forgotten the end of the record. Three points fix a first-order process,

    ln G1 - 2 ln G2 + ln G3 = -ln(1 + T s1) + 2 ln(1 + 2 T s1) - ln(1 + 3 T s1)             gives T, then D and K,

and a second-order one with K given: `K e^{-D s}/G(s) = 1 + n s + m s^2` at these three for some D, often for two of
them, between which the fourth point decides. `y` PV, `u` output, as
deviations from rest; s1 in 1/s. Source: Vivek and Chidambaram, Comput. Chem. Eng. 29 (2005).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import brentq

from autotuner.core.model.process import Fopdt, second_order
from autotuner.core.signals.static_gain import rest_rows
from autotuner.errors import InputError
from autotuner_models.literature.trial import FOPDT, SOPDT, SYMMETRIC, Method

if TYPE_CHECKING:
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Recording
    from autotuner_models.literature.trial import Trial

FORGOTTEN = 15.0
"""Exponent at the end of the record."""
DELAYS = 400
"""Dead times tried before they are refined."""


def estimate(trial: Trial) -> ProcessModel:
    """Return the process through the three points."""
    s, G = _points(trial.recording(SYMMETRIC))
    if np.any(G * trial.K <= 0.0):
        raise InputError("changes its sign", field="G(s)", remedy="Check that the record begins at rest.")
    return _first_order(s, G, trial.K) if trial.first_order else _second_order(s, G, trial.K)


def _points(recording: Recording) -> tuple[FloatArray, FloatArray]:
    rest = rest_rows(recording.output)
    t = recording.t[rest:] - recording.t[rest]
    y = recording.pv[rest:] - recording.pv[: rest + 1].mean()
    u = recording.output[rest:] - recording.output[0]
    s = FORGOTTEN / t[-1] * np.array([1.0, 2.0, 3.0, 4.0])
    fading = np.exp(-s[:, None] * t)
    driven = (u[:-1] * (fading[:, :-1] - fading[:, 1:])).sum(axis=1) / s
    return s, np.trapezoid(y * fading, t, axis=1) / driven


def _first_order(s: FloatArray, G: FloatArray, K: float) -> Fopdt:
    s, G = s[:3], G[:3]
    wanted = float(np.log(np.abs(G)) @ np.array([1.0, -2.0, 1.0]))

    def excess(log_T: float) -> float:
        return float(np.log1p(math.exp(log_T) * s) @ np.array([-1.0, 2.0, -1.0])) - wanted

    # The right side rises from 0 to ln(4/3) with T.
    if not excess(-30.0) < 0.0 < excess(30.0):
        raise InputError(f"of {wanted:.3g} is none of a lag", field="curvature of ln G", remedy="Reduce the noise.")
    T = math.exp(brentq(excess, -30.0, 30.0, xtol=1e-13))
    residual = np.log(np.abs(G)) + np.log1p(T * s)
    D = float(residual[0] - residual[2]) / float(s[2] - s[0])
    return Fopdt(math.copysign(math.exp(residual[0] + D * s[0]), K), T, max(D, 0.0))


def _second_order(s: FloatArray, G: FloatArray, K: float) -> ProcessModel:
    def shape(D: float) -> tuple[float, float]:
        residual = K * np.exp(-D * s) / G - 1.0
        n, m = np.linalg.solve(np.column_stack((s[:2], s[:2] ** 2)), residual[:2]).tolist()
        return n, m

    def excess(D: float, point: int = 2) -> float:
        n, m = shape(D)
        return float(K * math.exp(-D * s[point]) / G[point] - 1.0 - n * s[point] - m * s[point] ** 2)

    latest = float(math.log(K / G[0]) / s[0])
    tried = np.linspace(0.0, latest, DELAYS) if latest > 0.0 else np.zeros(0)
    signs = np.sign([excess(D) for D in tried.tolist()])
    changes = np.flatnonzero(signs[:-1] * signs[1:] < 0.0)
    roots = [float(brentq(excess, tried[i], tried[i + 1], xtol=1e-12)) for i in changes]
    possible = [D for D in roots if min(shape(D)) > 0.0]
    if not possible:
        raise InputError("fits no dead time", field="G(s)", remedy="Check the static gain, or reduce the noise.")
    D = min(possible, key=lambda D: abs(excess(D, 3)))
    n, m = shape(D)
    return second_order(K, m, n, D)


METHOD = Method(
    "laplace", "Laplace transform of the transient (Vivek and Chidambaram)", FOPDT + SOPDT, estimate, finds=("D",)
)
