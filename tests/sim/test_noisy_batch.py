"""Relay tests by noisy samples of many plants at once, against a loop over all samples and the exact course."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotuner_sim import (
    Fopdt,
    Relay,
    SopdtOverdamped,
    SopdtUnderdamped,
    noisy_batch,
    noisy_relay,
    relay_tests,
)

DT = 0.03


def plants_of(kind, count, seed):
    """Random tests of one kind, their plants and relays; times from 3 to 300 samples, dead times of 1 to 2,000."""
    rng = np.random.default_rng(seed)
    T, part = 10.0 ** rng.uniform(-1.0, 1.0, count), rng.uniform(0.05, 0.95, count)
    D = T * 10.0 ** rng.uniform(-1.5, 0.8, count)
    K = rng.uniform(0.2, 5.0, count) * rng.choice([1.0, -1.0], count)
    reference, dead_zone = 0.1 * np.abs(K) * rng.uniform(-1.0, 1.0, count), 0.05 * np.abs(K)
    of_kind = {
        "first order": (0.0 * T, T, lambda k, t, _p, d: Fopdt(k, t, d)),
        "real poles": (part * T**2, (1.0 + part) * T, lambda k, t, p, d: SopdtOverdamped(k, t, p * t, d)),
        "ringing": (T**2, 2.0 * part * T, lambda k, t, p, d: SopdtUnderdamped(k, t * t, 2.0 * p * t, d)),
    }
    m, n, plant = of_kind[kind]
    numbers = [column.tolist() for column in (K, T, part, D, reference, dead_zone)]
    plants = [plant(k, t, p, d) for k, t, p, d, _, _ in zip(*numbers, strict=True)]
    relays = [Relay(-1.0, 1.3, r, z, direct=k > 0.0) for k, _, _, _, r, z in zip(*numbers, strict=True)]
    return relay_tests(K, m, n, D, -1.0, 1.3, reference, dead_zone), plants, relays


@settings(max_examples=12)
@given(
    st.sampled_from(["first order", "real poles", "ringing"]),
    st.integers(0, 10**6),
    st.sampled_from([-4.0, -2.0, -0.5]),
)
def test_switches_are_those_of_a_loop_over_all_samples(by_every_sample, kind, seed, exponent):
    tests, plants, relays = plants_of(kind, 6, seed)
    rng = np.random.default_rng(seed + 1)
    noise, scale, starts = rng.normal(size=2500), np.abs(tests.K) * 10.0**exponent, rng.integers(0, 2500, 6)
    batch = noisy_batch(tests, noise, DT, scale=scale, starts=starts, switches=12)
    for i, (plant, relay) in enumerate(zip(plants, relays, strict=True)):
        high, found = by_every_sample(plant, relay, scale[i] * np.roll(noise, -starts[i]), DT, 12)
        assert bool(batch.starts_high[i]) == high
        assert batch.switches[i].tolist() == found + [-1] * (12 - len(found))


@pytest.mark.parametrize("kind", ["first order", "real poles", "ringing"])
def test_hundreds_of_tests_are_those_run_alone_with_amplitude_and_period_of_their_course(kind):
    tests, plants, relays = plants_of(kind, 300, 7)
    rng = np.random.default_rng(8)
    noise, scale = rng.normal(size=20_000), np.abs(tests.K) * 10.0 ** rng.uniform(-4.0, -0.5, 300)
    starts = rng.integers(0, noise.size, 300)
    batch = noisy_batch(tests, noise, DT, scale=scale, starts=starts, switches=10)
    for i, (plant, relay) in enumerate(zip(plants, relays, strict=True)):
        alone = noisy_relay(plant, relay, float(scale[i]) * np.roll(noise, -starts[i]), DT, 10)
        assert batch.switches[i].tolist() == [*alone.switches, *[-1] * (10 - len(alone.switches))]
        if len(alone.switches) == 10:
            lowest, highest = alone.course().extremes(alone.switches_s[-3], alone.switches_s[-1])
            assert batch.peak[i] == pytest.approx((highest - lowest) / 2.0, rel=1e-9)
            assert batch.period_s[i] == pytest.approx(alone.period_s)


@pytest.mark.parametrize("D", [0.0, 0.004, DT, 10.0 * DT, 90.0])
@pytest.mark.parametrize("kind", ["first order", "real poles", "ringing"])
def test_dead_times_of_none_part_of_a_sample_and_more_than_the_noise_lasts(kind, D):
    tests, plants, relays = plants_of(kind, 1, 3)
    noise = np.random.default_rng(4).normal(size=2000)
    batch = noisy_batch(tests._replace(D=np.array([D])), noise, DT, scale=0.01, switches=30)
    alone = noisy_relay(dataclasses.replace(plants[0], D=D), relays[0], 0.01 * noise, DT, 30)
    assert batch.switches[0].tolist() == [*alone.switches, *[-1] * (30 - len(alone.switches))]


def test_plants_of_all_kinds_stay_in_their_places():
    parts = [plants_of(kind, 20, k)[0] for k, kind in enumerate(("real poles", "first order", "ringing"))]
    mixed = relay_tests(*(np.stack(columns).T.ravel() for columns in zip(*parts, strict=True)))
    noise = np.random.default_rng(2).normal(size=9000)
    batch = noisy_batch(mixed, noise, DT, scale=0.01, switches=6)
    for k, part in enumerate(parts):
        apart = noisy_batch(part, noise, DT, scale=0.01, switches=6)
        assert batch.switches[k::3].tolist() == apart.switches.tolist()
        assert batch.peak[k::3].tolist() == pytest.approx(apart.peak.tolist(), nan_ok=True)


def test_what_ends_before_its_last_switch_has_no_period():
    batch = noisy_batch(relay_tests(1.0, 0.0, 10.0, [2.0, 2.0], hysteresis=[0.1, 3.0]), np.zeros(3000), 0.1, switches=5)
    assert batch.switches[0].min() > 0
    assert batch.switches[1].tolist() == [-1] * 5
    assert np.isnan(batch.period_s).tolist() == [False, True]
    assert np.isnan(batch.peak).tolist() == [False, True]


@pytest.mark.parametrize("noise", [[], [[0.0]], [math.nan]])
def test_noise_that_is_none_is_refused(noise):
    with pytest.raises(ValueError, match="row of finite numbers"):
        noisy_batch(relay_tests(1.0, 0.0, 10.0, 2.0), noise, 0.1)


@pytest.mark.parametrize(("wrong", "words"), [({"sample_time_s": 0.0}, "sample_time_s"), ({"switches": 2}, "switches")])
def test_numbers_that_are_none_are_refused(wrong, words):
    with pytest.raises(ValueError, match=words):
        noisy_batch(relay_tests(1.0, 0.0, 10.0, 2.0), [0.0], **{"sample_time_s": 0.1, **wrong})
