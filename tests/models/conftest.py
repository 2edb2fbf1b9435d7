"""Shared by the tests of the trained corrections: relay records of simulated plants, and a correction trained small."""

import math

import numpy as np
import pytest

from autotuner.core.recording import Recording
from autotuner_models.learned.artefacts import save
from autotuner_models.learned.draw import STRUCTURES, rows_of
from autotuner_models.learned.training import assembled, train, train_classifier
from autotuner_sim import Relay, find_limit_cycle
from autotuner_sim.stepped import SteppedPlant

REST = 50


def relay_record(plant, half_periods=8, per_period=100, decibels=math.inf, seed=0, high=1.5):
    """Return the record of a relay from rest, levels -1 and `high`, that ends at a switch."""
    cycle = find_limit_cycle(plant, Relay(-1.0, 1.0, direct=plant.K > 0.0))
    sigma = cycle.peak / math.sqrt(2.0) * 10.0 ** (-decibels / 20.0)
    dt, rng, device, rows = cycle.period_s / per_period, np.random.default_rng(seed), SteppedPlant(plant), []
    is_high, switched = True, -1
    while switched < half_periods:
        k = len(rows)
        device.advance(k * dt)
        pv = device.pv + sigma * rng.standard_normal()
        was, error = is_high, math.copysign(1.0, plant.K) * pv
        if k > REST and abs(error) > 3.0 * sigma:
            is_high = error < 0.0
        switched += is_high != was
        device.output = 0.0 if k < REST else high if is_high else -1.0
        rows.append((k * dt, device.output, pv))
    return Recording(*np.array(rows).T, settings={"noise_sigma": sigma})


@pytest.fixture(scope="session")
def record():
    """The maker of records."""
    return relay_record


@pytest.fixture(scope="session")
def small(tmp_path_factory):
    """A folder with files as `autotuner train` writes them, of networks that have seen next to nothing."""
    rows = {name: rows_of(name, 256, (3, i, 0)) for i, name in enumerate(STRUCTURES)}
    trained = {name: train(part, 3, compare=False) for name, part in rows.items()}
    classifier, arrays, domain, right = train_classifier({name: part.shape for name, part in rows.items()}, 3)
    objects = {name: one.pipelines for name, one in trained.items()} | {"classes": classifier}
    folder = tmp_path_factory.mktemp("learned")
    save(folder, assembled(trained, arrays, domain), objects, {"seed": 3, "metrics": {"classes": right}})
    return folder
