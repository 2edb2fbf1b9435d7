"""Points of the frequency response, judged by the simulator's transfer functions."""

import math

import numpy as np
import pytest

from autotuner.core.identification import identify
from autotuner_sim import Fopdt, Integrating, SopdtOverdamped, SopdtUnderdamped

PLANTS = [
    Fopdt(1.0, 10.0, 1.0),
    Fopdt(-2.0, 10.0, 20.0),
    SopdtOverdamped(1.0, 60.0, 15.0, 5.0),
    SopdtUnderdamped(1.0, 9.0, 2.4, 3.0),
    Integrating(0.1, 5.0, 2.0),
]


def misses(found, plant):
    return np.array([abs(p.G - plant.transfer(1j * p.w)) / p.standard_error for p in found.points])


@pytest.mark.one_of(2)
@pytest.mark.parametrize("plant", PLANTS, ids=str)
def test_every_harmonic_without_noise(record_relay, plant):
    found = identify(record_relay(plant, plant.D / 12.0, switches=9))
    assert found.points[0].harmonic == 1
    assert found.points[0].w == pytest.approx(2.0 * math.pi / found.limit_cycle.Pu, rel=0.02)
    assert {point.harmonic for point in found.points} >= {1, 2, 4}
    for point in found.points:
        assert abs(point.G / plant.transfer(1j * point.w) - 1.0) < 1e-6


def test_a_symmetric_relay_has_odd_harmonics_only(record_relay):
    # An odd number of dead times in a lag of 40: the switches fall on the samples, the wave is symmetric to the last.
    found = identify(record_relay(Fopdt(1.0, 1.0, 4.0), 0.05, low=-1.0, high=1.0, switches=12))
    assert {point.harmonic for point in found.points} >= {1, 3, 5}
    assert not {point.harmonic for point in found.points} & {2, 4, 6}


@pytest.mark.parametrize("structure", ["fopdt", "sopdt_overdamped"])
def test_the_points_do_not_depend_on_the_structure(record_relay, structure):
    """A first-order model of a second-order process: its own response is off by more than the points are."""
    plant = SopdtOverdamped(1.0, 10.0, 4.0, 2.0)
    found = identify(record_relay(plant, 0.2, switches=21), structure)
    first = found.points[0]
    assert abs(first.G / plant.transfer(1j * first.w) - 1.0) < 5e-3
    assert np.median(misses(found, plant)) < 2.0 or structure != "fopdt"


@pytest.mark.long  # intervals that hold the truth are in test_least_squares
def test_the_standard_errors_are_those_that_the_points_have(record_relay):
    plant, squares = Fopdt(1.0, 10.0, 5.0), []
    for seed in range(30):
        found = identify(record_relay(plant, 0.4, sigma=0.02, seed=seed, hysteresis=0.06, switches=9), "fopdt")
        squares += [miss**2 / 2.0 for miss in misses(found, plant)[:2]]
    assert 0.7 < math.sqrt(np.mean(squares)) < 1.3


def test_they_are_in_the_json(record_relay):
    found = identify(record_relay(PLANTS[0], 0.1, switches=9))
    first = found.to_dict()["points"][0]
    assert first["gain"] == pytest.approx(abs(found.points[0].G))
    assert set(first) == {"harmonic", "w_rad_s", "real", "imag", "gain", "phase_deg", "standard_error"}
