"""Waits and parallelograms that are drawn by hand, with their travels known, with and without noise."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotuner import Recording
from autotuner.core.diagnosis.record.dataset import dataset_of
from autotuner.core.diagnosis.record.waiting import Waiting, waiting, waiting_of

REST = 40
NOTHING = Waiting(sticks=False, follows=False)


def parallelogram(turns=8, travel=2.0, jump=5.0, rest=REST, rise=2):
    """The output travels to and fro evenly; the PV rests, and jumps in `rise` samples as the output turns."""
    ramp = np.linspace(-travel / 2.0, travel / 2.0, rest + rise)
    u = np.concatenate([ramp if k % 2 else ramp[::-1] for k in range(turns)])
    level = np.concatenate([np.full(rest + rise, jump / 2.0 if k % 2 else -jump / 2.0) for k in range(turns)])
    y = np.convolve(np.append(np.full(rise - 1, level[0]), level), np.full(rise, 1.0 / rise), mode="valid")
    return u, y


def noise(size, sigma, seed=7):
    return sigma * np.random.default_rng(seed).standard_normal(size)


@pytest.mark.parametrize("sigma", [0.0, 0.05, 0.3])
@pytest.mark.parametrize(("travel", "jump"), [(2.0, 5.0), (0.3, 40.0), (80.0, 1.5)])
def test_a_parallelogram_is_a_valve_that_sticks(travel, jump, sigma):
    """Noise of up to 6 % of the jump; each wait is as long as the travel of the output between two jumps."""
    u, y = parallelogram(travel=travel, jump=jump)
    found = waiting(u, y + noise(y.size, sigma * jump / 5.0), sigma * jump / 5.0)
    assert found.sticks
    assert not found.follows
    assert len(found.travels) == 5
    assert found.travels == pytest.approx([travel] * 5, rel=0.15)


def test_travels_of_unequal_waits_are_their_quantiles():
    """Travels of 2 to 6, one wait of each and a rest of the same length, whose quarters are themselves."""
    u, y, at = [0.0], [0.0], 0.0
    for k, travel in enumerate([2.0, 3.0, 4.0, 5.0, 6.0]):
        sign = -1.0 if k % 2 else 1.0
        u += (at + sign * np.linspace(0.0, travel, REST)).tolist()
        y += [3.0 * (k % 2)] * REST
        at += sign * travel
    found = waiting(np.array(u), np.array(y), 0.0)
    assert found.sticks
    assert found.travels == pytest.approx((2.0, 3.0, 4.0, 5.0, 6.0), rel=0.1)


@given(st.floats(1e-3, 1e3), st.floats(1e-3, 1e3), st.floats(-100.0, 100.0), st.floats(-100.0, 100.0), st.booleans())
@settings(max_examples=25, deadline=None)
def test_a_valve_in_other_units_sticks_as_much(of_output, of_pv, output0, pv0, turned):
    """Other ranges of output and PV, and a valve that closes: the travels are in the units of the output."""
    u, y = parallelogram(turns=6)
    sign = -1.0 if turned else 1.0
    one, other = waiting(u, y, 0.0), waiting(sign * of_output * u + output0, of_pv * y + pv0, 0.0)
    assert (other.sticks, other.follows) == (one.sticks, one.follows) == (True, False)
    assert other.travels == pytest.approx([of_output * t for t in one.travels], rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("lag", [0, 1, 3])
def test_a_pv_that_travels_along_does_not_wait(lag):
    u, _ = parallelogram()
    assert not waiting(u, 3.0 * np.roll(u, lag), 0.0).sticks


def test_a_pv_that_rests_where_the_output_rests_does_not_wait():
    """Steps that the PV answers within a sample: between them nothing travels."""
    u = np.repeat([0.0, 1.0, -1.0, 2.0, 0.0, 1.0], 60)
    assert not waiting(u, 2.0 * np.roll(u, 1), 0.0).sticks


def test_a_rest_of_which_most_of_the_travel_lies_outside_is_no_wait():
    """The PV rests while the output makes a sixth of its travel, and follows the rest of it: less than 0.6."""
    one = np.concatenate((np.linspace(0.0, 0.5, 40), np.linspace(0.5, 3.0, 40)))
    follows = np.concatenate((np.zeros(40), np.linspace(0.0, 2.5, 40)))
    u = np.concatenate([one if k % 2 else one[::-1] for k in range(8)])
    y = np.concatenate([follows if k % 2 else follows[::-1] for k in range(8)])
    assert not waiting(u, y, 0.0).sticks


def test_one_level_alone_is_no_sticking():
    """The PV comes back to one level between spikes: it has to wait at levels that lie apart."""
    u, y = parallelogram()
    assert waiting(u, y, 0.0).sticks
    turns = np.arange(y.size) % (REST + 2)
    peaks = np.where(turns < 4, 5.0, 0.0)
    leaves = np.where(np.arange(y.size) // (REST + 2) % 3 == 0, u, 0.0)  # and travels along in a third of the time
    assert not waiting(u, peaks + 3.0 * leaves, 0.0).sticks


@pytest.mark.parametrize("u", [np.zeros(400), np.full(400, 55.0)])
def test_an_output_that_stands_shows_nothing(u):
    _, y = parallelogram(turns=10)
    assert waiting(u, y[:400], 0.0) == NOTHING


def test_a_pv_slower_than_a_third_of_the_record_shows_nothing():
    u, _ = parallelogram()
    assert not waiting(u, np.linspace(0.0, 1.0, u.size), 0.0).sticks


@pytest.mark.parametrize(("sigma", "follows"), [(0.0, True), (0.1, True), (3.0, False)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_pv_follows_where_its_moves_correlate(sign, sigma, follows):
    """Moves of a tenth: r = 1/sqrt(1 + 2 sigma^2/step^2) is 0.98 for 0.1 beside steps of 0.66, and 0.15 for 3."""
    u = 4.0 * np.sin(np.arange(1200) / 50.0)
    y = sign * 2.0 * u + noise(u.size, sigma)
    assert waiting(u, y, sigma).follows is follows


def test_too_few_moves_tell_nothing():
    """Nine moves of more than 0.08 of the range are too few."""
    u = np.repeat(np.arange(10.0), 30)
    assert not waiting(u, u, 0.0).follows
    u = np.repeat(np.arange(11.0), 30)
    assert waiting(u, u, 0.0).follows


def recording(u, y, **told):
    return Recording(np.arange(float(u.size)), 50.0 + u, 100.0 + y, settings=told)


def test_single_wild_readings_do_not_hide_a_wait():
    u, y = parallelogram()
    y = y + noise(y.size, 0.02)
    y[20::45] += 30.0
    found = waiting_of(dataset_of(recording(u, y)))
    assert found.sticks
    assert max(found.travels) == pytest.approx(2.0, rel=0.15)


def test_the_experiment_of_a_tuning_shows_no_valve():
    u, y = parallelogram()
    assert waiting_of(dataset_of(recording(u, y))).sticks
    assert waiting_of(dataset_of(recording(u, y, segments={"relay": 5.0, "tail": 250.0}))) == NOTHING


@pytest.mark.parametrize(("levels", "seen"), [(8, False), (40, True)])
def test_a_compressed_record_shows_small_moves_of_a_controller(levels, seen):
    """The same record, whose output is stored in steps of an eighth or a fortieth of its travel.

    Moves are fewer than three samples in ten; those of a fortieth are smaller than a twentieth of the range.
    """
    u, y = parallelogram(turns=8, rest=180)
    stored = np.round(u / 2.0 * levels) / levels * 2.0
    assert waiting_of(dataset_of(recording(stored, y))).sticks is seen
