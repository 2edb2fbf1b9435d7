"""Limit cycles in recordings, against the simulator's exact ones; and recordings that hold none."""

import math

import numpy as np
import pytest

from autotuner.core.recording import Recording
from autotuner.core.signals.limit_cycle import measure_limit_cycle, relay_switches
from autotuner.core.signals.static_gain import gain_from_cycles
from autotuner_sim.plants import Fopdt, SopdtOverdamped, SopdtUnderdamped
from autotuner_sim.relay import Relay

PLANTS = [
    Fopdt(2.0, 10.0, 1.5),
    Fopdt(1.0, 1.0, 8.0),
    SopdtOverdamped(1.0, 10.0, 2.0, 4.0),
    SopdtUnderdamped(1.0, 9.0, 2.4, 1.0),
]


@pytest.mark.parametrize("plant", PLANTS, ids=str)
@pytest.mark.parametrize("levels", [(-1.0, 1.0), (-1.0, 2.0), (-3.0, 1.0)])
def test_noise_free_cycle_equals_the_exact_one(record_relay, cycle_of, plant, levels):
    low, high = levels
    exact = cycle_of(plant, Relay(low, high))
    dt = exact.Pu / 400.0
    found = measure_limit_cycle(record_relay(plant, dt, low=low, high=high, switches=13))
    assert found is not None
    # A sampled relay switches up to one sample late, as if the dead time were longer by as much; a period grows by up
    # to four times that, and the PV moves by up to 2 pi A/400 in it.
    assert exact.Pu - 1e-6 < found.Pu < exact.Pu + 4.0 * dt
    assert found.high_s == pytest.approx(exact.high_s, abs=3.0 * dt)
    assert pytest.approx(exact.A, rel=0.02) == found.A
    assert pytest.approx(exact.A1, rel=0.02) == found.A1
    assert found.relay_fundamental == pytest.approx(exact.relay_fundamental, rel=0.01)
    assert (found.h, found.bias) == pytest.approx(((high - low) / 2.0, (high + low) / 2.0))
    assert found.hysteresis < 0.08 * exact.A
    assert found.cycles >= 3
    assert (found.lowest, found.highest) == pytest.approx((exact.lowest, exact.highest), abs=0.05 * exact.A)


def test_ratio_of_the_fundamentals_is_the_processs_gain_at_the_measured_period(record_relay):
    plant = Fopdt(2.0, 10.0, 3.0)
    found = measure_limit_cycle(record_relay(plant, 0.02, low=-1.0, high=2.0, switches=15))
    gain = abs(plant.transfer(2j * math.pi / found.Pu))
    assert found.Ku_fundamental == pytest.approx(1.0 / gain, rel=2e-3)
    assert found.Ku == 4.0 * found.h / (math.pi * found.A)


def test_noise_is_averaged_and_its_scatter_reported(record_relay, cycle_of):
    plant, relay = Fopdt(2.0, 10.0, 3.0), Relay(-1.0, 2.0, hysteresis=0.1)
    exact = cycle_of(plant, relay)
    found = [
        measure_limit_cycle(record_relay(plant, 0.05, switches=15, hysteresis=0.1, sigma=0.03, seed=seed))
        for seed in range(20)
    ]
    # Noise of 0.03 on an amplitude of about 1.3: the highest of hundreds of samples alone would be 3 sigma too high.
    assert np.mean([cycle.A for cycle in found]) == pytest.approx(exact.A, rel=0.02)
    scatter = np.std([cycle.A for cycle in found]) / exact.A
    reported = np.mean([cycle.relative_error["A"] for cycle in found])
    assert scatter / 2.5 < reported < 2.5 * scatter


def test_transient_and_rest_do_not_count(record_relay):
    plant = SopdtOverdamped(1.0, 10.0, 4.0, 2.0)
    record = record_relay(plant, 0.05, low=0.0, high=1.0, reference=0.3, switches=14)
    found = measure_limit_cycle(record)
    switches = record.t[relay_switches(record.output)]
    assert found.start_s > switches[1]
    assert found.end_s == switches[-1]


def test_switches_are_those_of_the_longest_stretch_between_two_levels():
    output = np.array([0, 0, 5, 5, 1, 1, 5, 5, 1, 1, 5, 5, 2, 2, 3, 3], dtype=float)
    assert relay_switches(output).tolist() == [4, 6, 8, 10]


def random_binary(seed, n, hold):
    return np.repeat(np.random.default_rng(seed).integers(0, 2, n // hold).astype(float), hold)


@pytest.mark.parametrize("seed", range(8))
def test_a_random_binary_sequence_is_no_relay_test(record, seed):
    output = random_binary(seed, 1200, 20)
    assert measure_limit_cycle(record(Fopdt(1.0, 5.0, 1.0), 0.1, lambda k, _: output[k], 1200)) is None


def test_steps_and_closed_loops_are_no_relay_tests(record):
    plant = Fopdt(1.0, 5.0, 1.0)
    assert measure_limit_cycle(record(plant, 0.1, lambda k, _: float(k > 50), 600)) is None
    assert measure_limit_cycle(record(plant, 0.1, lambda k, _: float(50 < k < 300), 600)) is None
    assert measure_limit_cycle(record(plant, 0.1, lambda _, pv: 2.0 * (1.0 - pv), 600)) is None


def test_a_few_samples_a_cycle_show_no_amplitude():
    n = 40
    square = np.arange(n) % 4 < 2
    assert measure_limit_cycle(Recording(np.arange(n, dtype=float), square.astype(float), np.sin(np.arange(n)))) is None


def test_gain_from_the_asymmetry_of_the_relay(record_relay):
    record = record_relay(Fopdt(-3.0, 10.0, 2.0), 0.02, low=-1.0, high=2.0, switches=11)
    gain = gain_from_cycles(record, measure_limit_cycle(record))
    assert pytest.approx(-3.0, rel=0.01) == gain.K


def test_a_relay_symmetric_about_the_rest_shows_no_gain(record_relay):
    record = record_relay(Fopdt(3.0, 10.0, 2.0), 0.02, low=-1.0, high=1.0, switches=11)
    assert gain_from_cycles(record, measure_limit_cycle(record)) is None


def test_without_a_rest_there_is_no_gain_from_cycles(record_relay):
    record = record_relay(Fopdt(3.0, 10.0, 2.0), 0.02, low=-1.0, high=2.0, switches=11)
    cycle = measure_limit_cycle(record)
    assert gain_from_cycles(record.window(cycle.start_s + 0.001, cycle.end_s), cycle) is None
