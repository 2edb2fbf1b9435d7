"""The shipped correction on the thesis's plants: sampled relay records, 400 samples a period, read after 12 switches.

The thesis's regressors are given the static gain and, for second order, the dead time. Ours is given the gain alone.
The noisy set has white noise 20 dB under the oscillation in the PV that the relay sees, with a dead zone of three of
its standard deviations.
"""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.identification.learned.correction import features
from autotuner.core.identification.limit_cycle.harmonic_start import start
from autotuner_models.learned.draw import run_known
from autotuner_models.learned.experiments import Processes
from autotuner_models.shipped import provider
from autotuner_models.thesis.data_sets import DECIBELS
from autotuner_models.thesis.regressors import other_rows

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from autotuner.core.identification.learned.correction import LearnedModels
    from autotuner_models.thesis.data_sets import Plants

    Numbers = NDArray[np.float64]

PER_PERIOD, SWITCHES = 400.0, 12


@cache
def ours_on(name: str, where: str) -> tuple[Numbers, NDArray[np.bool_]]:
    """Return our estimates of a data set's targets, shape (N, 2), and which rows were answered."""
    rows = other_rows(name, where)
    decibels = DECIBELS if name == "fopdt_noise" else math.inf
    return estimates(provider(), rows.structure, rows.plants, decibels)


def estimates(
    models: LearnedModels, structure: str, plants: Plants, decibels: float
) -> tuple[Numbers, NDArray[np.bool_]]:
    """Return estimates of the targets for plants `K e^{-Ds}/(m s^2 + n s + 1)`; NaN where there is none."""
    one = np.ones(plants.K.size)
    processes = Processes(one, one, plants.n, plants.m, plants.D)
    wave, w, kept = run_known(processes, PER_PERIOD, SWITCHES, decibels, np.random.default_rng(3))
    r = wave.U1 / wave.A1
    begun = start(structure, wave, r)
    correction = models.corrections[structure]
    x = features(wave, r, np.zeros(r.size), begun)
    inside = np.array([correction.domain.beyond(row) <= 1.0 for row in x]) & begun.exists
    values, _ = correction.apply(x, begun.values)
    inside &= np.array([correction.knows(row) for row in values])
    found = np.full((plants.K.size, 2), math.nan)
    found[kept[inside]] = _targets(structure, values, w)[inside]
    return found, np.isfinite(found).all(axis=1)


def _targets(structure: str, values: Numbers, w: Numbers) -> Numbers:
    if structure == "fopdt":
        return np.stack((np.exp(values[:, 0]) / w, values[:, 1] / w), axis=1)
    first, second = np.exp(values[:, :2]).T
    if structure == "sopdt_underdamped":
        return np.stack((first / w**2, second / w), axis=1)
    return np.stack((np.maximum(first, second) / w, np.minimum(first, second) / w), axis=1)
