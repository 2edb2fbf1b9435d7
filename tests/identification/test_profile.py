"""Profile likelihood against a brute-force profile of the textbook step response, and against the paraboloid."""

import math

import numpy as np
import pytest
import scipy.optimize
import scipy.stats

from autotuner.core.estimation.data import data_of
from autotuner.core.estimation.intervals.profile_likelihood import FURTHEST, _distances
from autotuner.core.estimation.least_squares import fit
from autotuner.core.identification import identify
from autotuner.core.model.structures import FOPDT
from autotuner.core.recording import Recording

STEP_S, SIGMA = 1.0, 0.02


def step(T, span_s, seed, D=1.0):
    t = np.arange(0.0, span_s, 0.05)
    clean = 1.0 - np.exp(-np.maximum(t - STEP_S - D, 0.0) / T)
    return Recording(t, (t >= STEP_S) * 1.0, clean + SIGMA * np.random.default_rng(seed).standard_normal(t.size))


def least_squares_at(recording, T, delays, K=None):
    """Sum of squares of a step response with this T (and K), offset and dead time free; nothing of ours."""
    sums = []
    for D in delays:
        answer = 1.0 - np.exp(-np.maximum(recording.t - STEP_S - D, 0.0) / T)
        known = 0.0 if K is None else K * answer
        columns = np.column_stack([np.ones_like(answer)] + ([answer] if K is None else []))
        left = recording.pv - known
        left = left - columns @ np.linalg.lstsq(columns, left, rcond=None)[0]
        sums.append(float(left @ left))
    return min(sums)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_ends_are_where_the_brute_force_profile_says(seed):
    recording = step(40.0, 15.0, seed)
    candidate = fit(data_of(recording), FOPDT)
    errors, model = candidate.uncertainty(), candidate.model
    assert candidate.white
    assert candidate.solution.problem.background == ("offset",)
    assert {"K", "T"} <= set(errors.profiled)
    n = recording.t.size
    quantile = scipy.stats.t.ppf(0.975, n - 4)
    delays = np.linspace(max(model.D - 0.8, 0.0), model.D + 0.8, 161)
    least = least_squares_at(recording, model.T, delays)
    for T in errors.interval95["T"]:
        risen = least_squares_at(recording, T, delays) - least
        assert np.sqrt(risen / (least / (n - 4))) == pytest.approx(quantile, rel=0.05)
    for K in errors.interval95["K"]:
        found = scipy.optimize.minimize(
            lambda x, K=K: least_squares_at(recording, math.exp(x[0]), [x[1]], K),
            [math.log(model.T * K / model.K), model.D],
            method="Nelder-Mead",
            options={"xatol": 1e-5, "fatol": 1e-9},
        )
        assert np.sqrt((found.fun - least) / (least / (n - 4))) == pytest.approx(quantile, rel=0.05)


def test_the_long_side_is_longer_than_the_short_one():
    errors = fit(data_of(step(40.0, 15.0, 0)), FOPDT).uncertainty()
    estimate = fit(data_of(step(40.0, 15.0, 0)), FOPDT).model.T
    low, high = errors.interval95["T"]
    assert high / estimate > 1.3 * estimate / low


def test_where_the_sum_of_squares_is_a_paraboloid_nothing_changes():
    found = identify(step(3.0, 15.0, 0), "fopdt").estimates["least_squares"]
    assert found.evidence["profile_likelihood"] == []


def test_a_dead_time_near_zero_keeps_its_sign():
    errors = fit(data_of(step(40.0, 15.0, 3, D=0.02)), FOPDT).uncertainty()
    low, high = errors.interval95["D"]
    assert low == 0.0
    assert 0.02 < high < 1.0


@pytest.mark.parametrize("value", [2.0, -2.0])
def test_an_interval_of_a_gain_that_includes_zero_has_an_end_beyond_any_factor(value):
    down, up = _distances("K", value, tuple(sorted((-0.5 * value, 3.0 * value))))
    assert down == -FURTHEST
    assert up == pytest.approx(math.log(3.0))


def test_without_profiles_the_model_is_the_same_and_intervals_are_those_of_the_covariance():
    """A lag ten times as long as the record: its interval is far from symmetric."""
    with_ends, without = (identify(step(20.0, 8.0, 0), "fopdt", profile=profile) for profile in (True, False))
    assert without.model == with_ends.model
    assert with_ends.estimates["least_squares"].evidence["profile_likelihood"]
    assert not without.estimates["least_squares"].evidence["profile_likelihood"]
