"""Records that a sensor, a line or a person spoilt: a right result with its warning, or a refusal by name."""

import math

import numpy as np
import pytest

from autotuner.core.identification import identify
from autotuner.core.recording import Recording
from autotuner_sim.plants import Fopdt

PLANT = Fopdt(2.0, 10.0, 3.0)
SIGMA = 0.005


@pytest.fixture(scope="module")
def clean(record_relay):
    return record_relay(PLANT, 0.1, sigma=SIGMA, seed=1, hysteresis=3.0 * SIGMA, low=-1.0, high=2.0)


def spoilt(clean, pv):
    return identify(Recording(clean.t, clean.output, pv))


def is_the_plant(found, within=0.02):
    assert found.structure == "fopdt"
    for name, value in found.model.parameters().items():
        assert value == pytest.approx(getattr(PLANT, name), rel=within), name


def test_a_saturated_sensor(clean):
    top = clean.pv.min() + 0.6 * np.ptp(clean.pv)
    found = spoilt(clean, np.minimum(clean.pv, top))
    is_the_plant(found)
    assert any("saturated" in warning for warning in found.warnings)
    assert any("were left out" in warning for warning in found.warnings)


@pytest.mark.one_of(2)
@pytest.mark.parametrize("step", [0.4, 0.8])
def test_a_coarse_pv_that_settles_under_each_level_is_not_saturated(record_relay, step):
    """A dead time of five lags: the PV rests at both ends of the oscillation, in one digit of the sensor."""
    record = record_relay(Fopdt(2.0, 1.0, 5.0), 0.05, sigma=SIGMA, seed=1, hysteresis=3.0 * SIGMA, low=-1.0, high=2.0)
    coarse = np.round(record.pv / step) * step
    found = identify(Recording(record.t, record.output, coarse), "fopdt")
    assert pytest.approx(2.0, abs=step) == found.model.K
    assert not any("saturated" in warning for warning in found.warnings)


def test_a_sensor_that_freezes(clean):
    half = clean.pv.size // 2
    found = spoilt(clean, np.where(np.arange(clean.pv.size) < half, clean.pv, clean.pv[half]))
    is_the_plant(found)
    assert any("frozen" in warning for warning in found.warnings)


def test_a_rest_without_noise_is_no_frozen_sensor(record_relay):
    found = identify(record_relay(PLANT, 0.1, low=-1.0, high=2.0))
    is_the_plant(found, 1e-6)
    assert found.warnings == ()


def test_a_step_that_settles_without_noise_is_no_saturated_sensor(record):
    settled = record(Fopdt(2.0, 5.0, 5.0), 1.0, lambda k, _: float(k >= 50), 400)
    found = identify(settled)
    assert found.model.parameters() == pytest.approx({"K": 2.0, "T": 5.0, "D": 5.0}, rel=1e-6)
    assert found.warnings == ()


def test_a_process_that_really_rests_at_both_ends_keeps_these_samples(record_relay):
    quick = Fopdt(1.0, 0.2, 10.0)
    found = identify(record_relay(quick, 0.05, quantum=0.01, low=-1.0, high=2.0))
    assert pytest.approx(1.0, rel=2e-3) == found.model.K
    assert not any("left out" in warning for warning in found.warnings)


@pytest.mark.parametrize(("row", "reading"), [(7, 32767.0), (20, 100.0), (33, -3276.7), (3, 10.0), (1, 2.0), (45, 0.0)])
def test_a_broken_reading_now_and_then(clean, row, reading):
    """An int16 register cannot hold NaN: it reads 32767, and the fit is told without those samples."""
    found = spoilt(clean, np.where(np.arange(clean.pv.size) % 50 == row, reading, clean.pv))
    is_the_plant(found)
    assert found.fit.fit_percent > 95.0


def test_columns_the_wrong_way_round(clean):
    assert identify(Recording(clean.t, clean.pv, clean.output)).verdict.code == "columns_swapped"


def test_a_resolution_that_shows_next_to_nothing(clean):
    found = spoilt(clean, np.round(clean.pv / np.ptp(clean.pv) * 2.0))
    assert found.verdict.code == "pv_too_coarse"


@pytest.mark.parametrize("size", [1e-50, 1e-9, 1e9, 1e50])
def test_any_size_of_numbers(clean, size):
    found = identify(Recording(clean.t, clean.output / size, clean.pv * size))
    assert pytest.approx(PLANT.K * size**2, rel=0.02) == found.model.K
    assert pytest.approx(PLANT.T, rel=0.02) == found.model.T


def test_a_pv_that_something_else_moves_is_said_first(clean):
    other = 0.2 * np.sin(2.0 * math.pi * clean.t / 7.0)
    found = spoilt(clean, clean.pv + other)
    assert "is not explained" in found.warnings[0]
