"""Relay tests by noisy samples, event by event, against a loop over all samples."""

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
    noisy_relay,
    quick_relay,
    run_relay,
    symmetric_relay,
)


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
def test_switches_are_those_of_a_loop_over_all_samples(by_every_sample, test):
    run = noisy_relay(*test, switches=30)
    assert (run.starts_high, list(run.switches)) == by_every_sample(*test, 30)


def test_a_long_test_with_little_noise_reads_few_samples_and_misses_none(by_every_sample):
    rng = np.random.default_rng(6)
    for plant in (
        Fopdt(2.0, 10.0, 3.3),
        SopdtOverdamped(2.0, 10.0, 1.0, 3.3),
        SopdtUnderdamped(2.0, 25.0, 2.0, 3.3),
    ):
        test = plant, Relay(-1.0, 1.5, hysteresis=0.1), rng.normal(0.0, 0.02, 12_000), 0.01
        run = noisy_relay(*test)
        assert len(run.switches) >= 8
        assert (True, list(run.switches)) == by_every_sample(*test, 10_000)


@pytest.mark.parametrize("plant", [Fopdt(1.0, 10.0, 2.0), SopdtUnderdamped(1.0, 100.0, 8.0, 4.0)])
def test_without_noise_it_is_the_sampled_test_and_nearly_the_other(plant):
    relay, dt = symmetric_relay(hysteresis=0.05), 1e-3
    run, quick = noisy_relay(plant, relay, np.zeros(300_000), dt, 6), quick_relay(plant, relay, 6)
    late = np.array(run.switches_s) - quick.switches_s
    assert np.all(late > 0.0)
    assert np.all(late < 40.0 * dt)  # each switch is late by up to a sample, and the next ones follow
    assert run.period_s == pytest.approx(quick.period_s, abs=4.0 * dt)


def test_its_course_is_that_of_its_switches():
    plant, relay = SopdtOverdamped(1.5, 8.0, 2.0, 3.25), Relay(-1.0, 1.2, hysteresis=0.1)
    noise = np.random.default_rng(3).normal(0.0, 0.05, 4000)
    run = noisy_relay(plant, relay, noise, 0.1, 9)
    course = run.course()
    assert course.times_s[1:].tolist() == run.switches_s
    assert run.period_s == pytest.approx(course.times_s[-1] - course.times_s[-3])
    readings = course.pv(course.times_s) + noise[[0, *run.switches]]
    ways = np.where(course.levels == relay.high, 1.0, -1.0)[:-1]
    assert np.all(ways * readings[1:] > 0.1)
    assert course.extremes(*course.times_s[-3:-1]) != run_relay(plant, relay, 1e4, max_switches=9).extremes(40.0, 60.0)


def test_noise_may_end_before_the_first_switch_and_forbid_the_first_position():
    plant = Fopdt(1.0, 10.0, 2.0)
    assert noisy_relay(plant, symmetric_relay(hysteresis=0.5), np.zeros(50), 0.1).switches == ()
    assert not noisy_relay(plant, symmetric_relay(hysteresis=0.5), [0.6, 0.0], 0.1).starts_high
    assert noisy_relay(plant, Relay(-1.0, 1.0, hysteresis=2.0), np.zeros(9000), 0.1).switches == ()


@pytest.mark.parametrize("noise", [[], [[0.0]], [math.nan], [0.0, math.inf]])
def test_noise_that_is_none_is_refused(noise):
    with pytest.raises(ValueError, match="row of finite numbers"):
        noisy_relay(Fopdt(1.0, 10.0, 2.0), symmetric_relay(), noise, 0.1)


@pytest.mark.parametrize("sample_time_s", [0.0, -1.0, math.nan])
def test_a_sample_time_that_is_none_is_refused(sample_time_s):
    with pytest.raises(ValueError, match="sample_time_s must be positive"):
        noisy_relay(Fopdt(1.0, 10.0, 2.0), symmetric_relay(), [0.0], sample_time_s)
