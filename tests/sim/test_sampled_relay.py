"""Relay tests by noisy samples of the PV, against a loop over the exact state at every sample."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotuner_sim import Fopdt, Relay, SopdtOverdamped, SopdtUnderdamped, symmetric_relay
from autotuner_sim.relay import Knot, RelayRun
from autotuner_sim.relay.batch import relay_test, relay_tests, run_relay_tests, run_sampled_relay_tests

DT = 0.03


def samples(batch, dt):
    """Samples of the switches of each test, as far as it went."""
    return [np.rint(row[np.isfinite(row)] / dt).astype(int).tolist() for row in batch.switches_s]


@st.composite
def cases(draw):
    """A plant of either sign, a relay, noise and a sample time."""
    K, T = draw(st.floats(0.2, 5.0)) * draw(st.sampled_from([1.0, -1.0])), draw(st.floats(0.5, 10.0))
    dt = T * 10.0 ** draw(st.floats(-2.3, -0.5))
    D = draw(st.one_of(st.floats(0.02, 6.0).map(lambda ratio: ratio * T), st.sampled_from([0.0, dt, 20.0 * dt])))
    damping = draw(st.sampled_from([0.1, 0.5, 0.97]))
    plant = draw(
        st.sampled_from(
            [Fopdt(K, T, D), SopdtOverdamped(K, T, damping * T, D), SopdtUnderdamped(K, T * T, 2.0 * damping * T, D)]
        )
    )
    reference, dead_zone = draw(st.sampled_from([0.0, 0.2, -0.3])), draw(st.sampled_from([0.0, 0.05, 0.3]))
    relay = Relay(-1.0, 1.3, reference * abs(K), dead_zone * abs(K), direct=K > 0.0)
    sigma = draw(st.sampled_from([0.0005, 0.01, 0.1, 0.4])) * abs(K)
    noise = np.random.default_rng(draw(st.integers(0, 10**6))).normal(0.0, sigma, 2500)
    return plant, relay, noise, dt


@settings(max_examples=60)
@given(cases())
def test_switches_are_those_of_a_loop_over_all_samples(by_every_sample, case):
    plant, relay, noise, dt = case
    batch = run_sampled_relay_tests(relay_test(plant, relay), noise, dt, switches=30)
    assert (batch.starts_high[0], samples(batch, dt)[0]) == by_every_sample(*case, 30)


def test_a_long_test_with_little_noise(by_every_sample):
    rng = np.random.default_rng(6)
    for plant in (
        Fopdt(2.0, 10.0, 3.3),
        SopdtOverdamped(2.0, 10.0, 1.0, 3.3),
        SopdtUnderdamped(2.0, 25.0, 2.0, 3.3),
    ):
        case = plant, Relay(-1.0, 1.5, hysteresis=0.1), rng.normal(0.0, 0.02, 12_000), 0.01
        batch = run_sampled_relay_tests(relay_test(*case[:2]), *case[2:], switches=30)
        assert len(samples(batch, 0.01)[0]) >= 8
        assert (True, samples(batch, 0.01)[0]) == by_every_sample(*case, 10_000)


def plants_of(kind, count, seed):
    """Random tests of one kind, their plants and relays; times from 3 to 300 samples, dead times of 1 to 2,000."""
    rng = np.random.default_rng(seed)
    T, part = 10.0 ** rng.uniform(-1.0, 1.0, count), rng.uniform(0.05, 0.95, count)
    D = T * 10.0 ** rng.uniform(-1.5, 0.8, count)
    K = rng.uniform(0.2, 5.0, count) * rng.choice([1.0, -1.0], count)
    reference, dead_zone = 0.1 * np.abs(K) * rng.uniform(-1.0, 1.0, count), 0.05 * np.abs(K)
    plant_of = {
        "first order": lambda k, t, _p, d: Fopdt(k, t, d),
        "real poles": lambda k, t, p, d: SopdtOverdamped(k, t, p * t, d),
        "ringing": lambda k, t, p, d: SopdtUnderdamped(k, t * t, 2.0 * p * t, d),
    }[kind]
    numbers = zip(*(column.tolist() for column in (K, T, part, D, reference, dead_zone)), strict=True)
    pairs = [(plant_of(k, t, p, d), Relay(-1.0, 1.3, r, z, direct=k > 0.0)) for k, t, p, d, r, z in numbers]
    return relay_tests(*np.hstack([np.array(relay_test(*pair)) for pair in pairs])), pairs


KINDS = ["first order", "real poles", "ringing"]


@settings(max_examples=12)
@given(st.sampled_from(KINDS), st.integers(0, 10**6), st.sampled_from([-4.0, -2.0, -0.5]))
def test_each_test_reads_its_own_part_of_the_noise_at_its_own_scale(by_every_sample, kind, seed, exponent):
    tests, pairs = plants_of(kind, 6, seed)
    rng = np.random.default_rng(seed + 1)
    noise, scale, starts = rng.normal(size=2500), np.abs(tests.K) * 10.0**exponent, rng.integers(0, 2500, 6)
    batch = run_sampled_relay_tests(tests, noise, DT, scale=scale, starts=starts, switches=12)
    found = samples(batch, DT)
    for i, (plant, relay) in enumerate(pairs):
        expected = by_every_sample(plant, relay, scale[i] * np.roll(noise, -starts[i]), DT, 12)
        assert (bool(batch.starts_high[i]), found[i]) == expected


def course_of(plant, relay, starts_high, switches_s):
    """The exact run that a relay's switches lead to."""
    motion, times = plant.motion(), [0.0, *switches_s]
    levels = [relay.level(is_high=starts_high == (k % 2 == 0)) for k in range(len(times))]
    knots = [Knot(0.0, motion.rest, 0.0)]
    for t, level in zip(times, levels, strict=True):
        last = knots[-1]
        knots.append(Knot(t + plant.D, motion.move(last.state, last.u, t + plant.D - last.t), level))
    return RelayRun(plant, relay, np.array(times), np.array(levels), tuple(knots), times[-1])


@pytest.mark.parametrize("kind", KINDS)
def test_amplitudes_and_periods_are_those_of_the_exact_course(kind):
    tests, pairs = plants_of(kind, 300, 7)
    rng = np.random.default_rng(8)
    noise, scale = rng.normal(size=20_000), np.abs(tests.K) * 10.0 ** rng.uniform(-4.0, -0.5, 300)
    batch = run_sampled_relay_tests(tests, noise, DT, scale=scale, starts=rng.integers(0, 20_000, 300), switches=10)
    complete = np.flatnonzero(np.isfinite(batch.period_s))
    assert complete.size > 250
    for i in complete:
        course = course_of(*pairs[i], bool(batch.starts_high[i]), batch.switches_s[i].tolist())
        lowest, highest = course.extremes(*batch.switches_s[i][[-3, -1]])
        assert (batch.lowest[i], batch.highest[i]) == pytest.approx(
            (lowest, highest), rel=1e-9, abs=1e-12 * abs(tests.K[i])
        )
        assert batch.period_s[i] == batch.switches_s[i][-1] - batch.switches_s[i][-3]


@pytest.mark.parametrize("D", [0.0, 0.004, DT, 10.0 * DT, 90.0])
@pytest.mark.parametrize("kind", KINDS)
def test_dead_times_of_none_part_of_a_sample_and_more_than_the_noise_lasts(by_every_sample, kind, D):
    _, pairs = plants_of(kind, 1, 3)
    plant, relay = dataclasses.replace(pairs[0][0], D=D), pairs[0][1]
    noise = 0.01 * np.random.default_rng(4).normal(size=2000)
    batch = run_sampled_relay_tests(relay_test(plant, relay), noise, DT, switches=30)
    assert (batch.starts_high[0], samples(batch, DT)[0]) == by_every_sample(plant, relay, noise, DT, 30)


@pytest.mark.parametrize("plant", [Fopdt(1.0, 10.0, 2.0), SopdtUnderdamped(1.0, 100.0, 8.0, 4.0)])
def test_without_noise_it_is_nearly_the_exact_test(plant):
    tests, dt = relay_test(plant, symmetric_relay(hysteresis=0.05)), 1e-3
    sampled, exact = run_sampled_relay_tests(tests, np.zeros(300_000), dt, switches=6), run_relay_tests(tests, 6)
    late = sampled.switches_s - exact.switches_s
    assert np.all(late > 0.0)
    assert np.all(late < 40.0 * dt)  # each switch is late by up to a sample, and the next ones follow
    assert sampled.period_s == pytest.approx(exact.period_s, abs=4.0 * dt)


def test_what_ends_before_its_last_switch_has_no_period():
    tests = relay_tests(1.0, 0.0, 10.0, [2.0, 2.0], hysteresis=[0.1, 3.0])
    batch = run_sampled_relay_tests(tests, np.zeros(3000), 0.1, switches=5)
    assert np.isfinite(batch.switches_s).tolist() == [[True] * 5, [False] * 5]
    assert np.isnan(batch.period_s).tolist() == [False, True]
    assert np.isnan(batch.peak).tolist() == [False, True]


@pytest.mark.parametrize("noise", [[], [[0.0]], [math.nan], [0.0, math.inf]])
def test_noise_that_is_none_is_refused(noise):
    with pytest.raises(ValueError, match="row of finite numbers"):
        run_sampled_relay_tests(relay_tests(1.0, 0.0, 10.0, 2.0), noise, 0.1)


@pytest.mark.parametrize(("wrong", "words"), [({"sample_time_s": 0.0}, "sample_time_s"), ({"switches": 2}, "switches")])
def test_numbers_that_are_none_are_refused(wrong, words):
    with pytest.raises(ValueError, match=words):
        run_sampled_relay_tests(relay_tests(1.0, 0.0, 10.0, 2.0), [0.0], **{"sample_time_s": 0.1, **wrong})
