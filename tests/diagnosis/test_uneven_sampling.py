"""Samples at other times than written down, told from what a model misses: signals that are written down here."""

import numpy as np
import pytest

from autotuner.core.diagnosis.search.uneven_sampling import BESIDE_ANY_MODEL, JITTER_GAIN, unevenness_of

T = np.arange(1200.0)
SLOPE = 0.3 * np.cos(T / 15.0) * (1.0 + np.sign(np.sin(T / 80.0)))
MISFIT = 0.4 * np.sin(T / 23.0) + 0.2 * np.sin(T / 9.0)


@pytest.fixture
def noise():
    return np.random.default_rng(8).normal(0.0, 1.0, (2, T.size))


@pytest.mark.parametrize("misfit", [0.0, MISFIT])
@pytest.mark.parametrize("tau_s", [0.2, 0.6])
def test_the_spread_of_the_times_is_found_whatever_the_model_misses(noise, misfit, tau_s):
    found_s, gain = unevenness_of(0.05 * noise[0] + tau_s * SLOPE * noise[1] + misfit, SLOPE)
    assert found_s == pytest.approx(tau_s, rel=0.15)
    assert gain > JITTER_GAIN


@pytest.mark.parametrize("misfit", [0.0, MISFIT])
def test_noise_that_does_not_care_for_the_slope_is_no_unevenness(noise, misfit):
    assert unevenness_of(0.1 * noise[0] + misfit, SLOPE)[1] < JITTER_GAIN / 3.0


def test_nothing_is_found_where_there_is_nothing():
    assert unevenness_of(np.zeros(T.size), SLOPE) == (0.0, 0.0)
    assert unevenness_of(MISFIT, np.zeros(T.size)) == (0.0, 0.0)


def test_a_course_that_is_missing_is_no_unevenness_though_it_grows_with_the_slope(noise):
    """The PV behind a rate limit is late where it moves: smoothly, and so by hardly anything in second differences."""
    slope = 0.3 * np.cos(T / 15.0)
    assert unevenness_of(2.0 * slope + 0.02 * noise[0], slope)[1] < BESIDE_ANY_MODEL
