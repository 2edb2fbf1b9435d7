"""The static gain from a whole record with the learned correction, where the relay does not determine it.

    S(K) = sum of (pv - simulated PV of the learned model for K)^2

The learned correction has one model for each static gain. The first swings and the check after the relay distinguish
them. `S` is computed on a logarithmic grid, then on a finer one about its minimum. The vertex of a parabola
through the lowest three points is the gain, its curvature the error:

    var(log K) = 2 S/(n_e S''),   n_e = n / inflation of the residual

Invariant: a gain at the edge of the grid, or an undetermined one, is rejected.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.estimation.simulation import simulate_fit
from autotuner.core.identification.learned.correction import SURE, by_wave, sigma_of
from autotuner.core.identification.limit_cycle.relay_harmonics import wave_of
from autotuner.core.signals.noise import inflation

if TYPE_CHECKING:
    from autotuner.core.identification.learned.correction import LearnedModels
    from autotuner.core.identification.limit_cycle.relay_harmonics import RelayWaves
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.recording import Recording

LOWEST, HIGHEST, STEPS = 1.02, 40.0, 16
"""Range of the static gain, in amplitude of the PV over that of the output, and points of the grid over it."""
FINER = (-0.5, -0.25, 0.25, 0.5)
"""Points about the lowest one, in steps of the grid."""


def gain_by_record(
    relay: Recording, shown: Recording, structure: str | None, models: LearnedModels, sign: float
) -> tuple[float, float] | None:
    """Return the static gain and its standard error, PV/output; None where the record does not show it.

    Parameters
    ----------
    relay : Recording
        Part of the record for the learned correction.
    shown : Recording
        What the models are compared on: `relay`, and the check after it where there is one.
    structure : str or None
        Structure wanted; the likeliest when None.
    models : LearnedModels
        What was trained.
    sign : float
        A number of the sign of the process's gain.
    """
    wave = wave_of(relay, sigma_of(relay), math.copysign(1.0, sign))
    if wave is None:
        return None
    search = _Search(wave, shown, structure, models, math.copysign(1.0, sign))
    grid = np.linspace(math.log(LOWEST), math.log(HIGHEST), STEPS)
    step = float(grid[1] - grid[0])
    left = {float(x): search.residual(float(x)) for x in grid}
    lowest = _lowest(left)
    left |= {lowest + part * step: search.residual(lowest + part * step) for part in FINER}
    found = _vertex(left)
    if found is None or found[1] > SURE:
        return None
    K = math.copysign(math.exp(found[0]), sign) * search.scale
    return K, abs(K) * found[1]


class _Search:
    """The residual of the learned model by the logarithm of its gain."""

    def __init__(
        self, wave: RelayWaves, shown: Recording, structure: str | None, models: LearnedModels, sign: float
    ) -> None:
        self._wave, self._shown, self._structure, self._models, self._sign = wave, shown, structure, models, sign
        self.scale = float(wave.A1[0] / wave.U1[0])

    def residual(self, x: float) -> FloatArray | None:
        """Return measured minus simulated PV, or None where the correction has no model."""
        gain = self._sign * math.exp(x) * self.scale
        estimate = by_wave(self._wave, self._structure, (gain, 0.0), self._models, self._sign)
        if estimate.model is None:
            return None
        left: FloatArray = self._shown.pv - simulate_fit(estimate.model, self._shown)
        return left


def _sum(left: FloatArray | None) -> float:
    return math.inf if left is None else float(left @ left)


def _lowest(left: dict[float, FloatArray | None]) -> float:
    return min(left, key=lambda x: _sum(left[x]))


def _vertex(left: dict[float, FloatArray | None]) -> tuple[float, float] | None:
    """Return the vertex of the parabola through the lowest point and its neighbours, and its standard error."""
    places = sorted(left)
    k = places.index(_lowest(left))
    if not 0 < k < len(places) - 1:
        return None
    x = np.array(places[k - 1 : k + 2])
    S = np.array([_sum(left[place]) for place in x.tolist()])
    best = left[places[k]]
    if best is None or not np.all(np.isfinite(S)):
        return None
    curvature, slope, _ = np.polyfit(x - x[1], S, 2)
    if curvature <= 0.0:
        return None
    variance = float(S[1]) / best.size * inflation(best) / float(curvature)
    return float(x[1] - slope / (2.0 * curvature)), math.sqrt(variance)
