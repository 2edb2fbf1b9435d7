"""The published tests for sticking valves, on signals that are written down: sines, triangles, responses to a relay."""

import math

import numpy as np
import pytest
import scipy

from benchmarks.accuracy.diagnosis.stiction import _ultimate_gain, simulated, waits
from benchmarks.baselines.stiction_tests import TESTS, Verdict, half_cycles, straightened

N, PERIOD = 1000, 70.3
ANGLE = 2.0 * np.pi * np.arange(N) / PERIOD
SINE = np.sin(ANGLE)
TRIANGLE = scipy.signal.sawtooth(ANGLE, 0.5)


def lagged_relay(lag):
    """The response of a lag to a square wave, in cycle."""
    y, x = np.zeros(N), 0.0
    for k, u in enumerate(np.sign(SINE)):
        x += (u - x) * -math.expm1(-1.0 / lag)
        y[k] = x
    return y


SQUARE_LIKE, SAW_LIKE = lagged_relay(4.0), lagged_relay(40.0)
STICKS, FREE, OPEN = Verdict.STICKS, Verdict.FREE, Verdict.OPEN


@pytest.mark.parametrize(("name", "u", "y", "expected"), [
    ("cross-correlation", SINE, -np.cos(ANGLE), STICKS),  # a quarter of a period between them: odd
    ("cross-correlation", SINE, -SINE, FREE),  # half of one: even
    ("cross-correlation", SINE, np.sin(ANGLE + 2.4), OPEN),
    ("area ratio", TRIANGLE, SQUARE_LIKE, STICKS),
    ("area ratio", TRIANGLE, SAW_LIKE, STICKS),
    ("area ratio", SINE, SINE, FREE),
    ("area ratio", SINE, SQUARE_LIKE[::-1], FREE),  # quick up, slow down
    ("curve fit", TRIANGLE, SQUARE_LIKE, STICKS),
    ("curve fit", scipy.signal.sawtooth(ANGLE, 0.3), SQUARE_LIKE, STICKS),
    ("curve fit", SINE, SINE, FREE),
    ("relay fit", TRIANGLE, SQUARE_LIKE, STICKS),
    ("relay fit", TRIANGLE, SAW_LIKE, STICKS),
    ("relay fit", SINE, TRIANGLE, STICKS),  # the integral of a relay
    ("relay fit", SINE, SINE, FREE),
])  # fmt: skip
@pytest.mark.parametrize(("offset", "scale"), [(0.0, 1.0), (40.0, -0.02)])
def test_a_test_sees_the_shape_whatever_its_size(name, u, y, expected, offset, scale):
    slope = 1e-3 * scale * np.arange(N)
    assert TESTS[name](offset + scale * u, offset + scale * y + slope) is expected


@pytest.mark.parametrize("name", TESTS)
def test_noise_and_a_ramp_decide_nothing(name):
    noise = np.random.default_rng(1).standard_normal((2, N))
    assert TESTS[name](*noise) is OPEN
    assert TESTS[name](np.arange(float(N)), np.arange(float(N))) is OPEN


def test_half_cycles_are_those_of_a_sine():
    found = half_cycles(straightened(SINE + 0.05 * np.random.default_rng(2).standard_normal(N)))
    assert len(found) == pytest.approx(2.0 * N / PERIOD, abs=2.5)
    assert np.mean([half.size for half in found]) == pytest.approx(PERIOD / 2.0, rel=0.03)
    assert all(half.sum() > 0.0 for half in found)


def test_unequal_halves_are_regular_and_a_wandering_period_is_not():
    """A valve may stay longer on one side; a random walk crosses zero at any time."""
    assert half_cycles(straightened(scipy.signal.square(ANGLE, 0.25)))
    assert not half_cycles(straightened(np.cumsum(np.random.default_rng(3).standard_normal(N))))


@pytest.mark.parametrize(("lag", "delay"), [(5.0, 1.0), (1.0, 10.0), (40.0, 2.0)])
def test_the_ultimate_gain_of_the_simulated_loops(lag, delay):
    """At the frequency of that gain the loop's response is -1: `K e^(-jwD) = -(1 + jwT)`."""
    gain = _ultimate_gain(lag, delay)
    w = math.sqrt(gain**2 - 1.0) / lag
    assert gain * np.exp(-1j * w * delay) / (1.0 + 1j * w * lag) == pytest.approx(-1.0, abs=1e-9)


def test_the_simulated_valve_sticks_and_the_others_do_not():
    """Of a loop at rest but for its valve, the PV waits; that of a tight loop follows."""
    verdicts = [waits(simulated("sticks", seed)) for seed in range(1, 9)]
    assert STICKS in verdicts
    assert all(waits(simulated("tight", seed)) is FREE for seed in range(1, 5))
