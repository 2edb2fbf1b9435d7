"""A load that comes while a model is judged is told from a model that is wrong; noise at rest that remembers itself."""

import numpy as np
import pytest

from autotuner.application.analysis.late_load import late_load
from autotuner.application.analysis.parts_of_record import undisturbed
from autotuner.core.identification import identify
from autotuner.core.identification.held_out import wander_at_rest
from autotuner.core.model.process import Fopdt
from autotuner.core.recording import Recording
from autotuner.core.signals.quiet import largest_wander

K, T, D, DT, NOISE = 2.0, 10.0, 1.5, 0.25, 0.05
TAIL_S, LOAD_S, SIZE = 60.0, 90.0, 3.0


def step_at(t, at_s, gain=K):
    """Return the closed form of a lag's answer to a unit step that arrives at `at_s`."""
    return gain * -np.expm1(-np.maximum(t - at_s, 0.0) / T)


def a_record(*, load=0.0, at_s=LOAD_S, gain_in_tail=K):
    """Return a rest, a step of 10, and a tail of -6, in closed form; the tail's gain may be another one."""
    t = np.arange(0.0, 120.0, DT)
    output = np.where(t < 10.0, 40.0, np.where(t < TAIL_S, 50.0, 44.0))
    pv = 50.0 + 10.0 * step_at(t, 10.0 + D) - 6.0 * step_at(t, TAIL_S + D, gain_in_tail)
    pv += load * step_at(t, at_s) + np.random.default_rng(3).normal(0.0, NOISE, t.size)
    return Recording(t, output, pv, settings={"segments": {"relay": 10.0, "tail": TAIL_S}})


def test_a_load_in_the_tail_is_found_with_its_size_and_moment():
    found = late_load(Fopdt(K, T, D), a_record(load=SIZE), TAIL_S, NOISE)
    assert found.size == pytest.approx(SIZE, rel=0.02)
    assert found.at_s == pytest.approx(LOAD_S, abs=0.5)
    assert found.error.held_out == pytest.approx(NOISE, rel=0.15)


@pytest.mark.parametrize("gain", [0.5 * K, 0.8 * K, 1.2 * K, 2.0 * K])
def test_a_gain_that_is_another_one_in_the_tail_is_no_load(gain):
    """Its misfit looks like a load that comes as the answer to the move does."""
    assert late_load(Fopdt(K, T, D), a_record(gain_in_tail=gain), TAIL_S, NOISE) is None


def test_a_wrong_gain_is_not_excused_by_a_load_either():
    assert late_load(Fopdt(K, T, D), a_record(load=SIZE, gain_in_tail=0.7 * K), TAIL_S, NOISE) is None


def test_a_load_that_comes_before_the_answer_was_seen_proves_nothing():
    assert late_load(Fopdt(K, T, D), a_record(load=SIZE, at_s=TAIL_S + D + 1.0), TAIL_S, NOISE) is None


def coloured(rng, count, memory):
    """Return noise of standard deviation 1 that each sample remembers to `memory`."""
    values = [rng.standard_normal()]
    for _ in range(count - 1):
        values.append(memory * values[-1] + np.sqrt(1.0 - memory**2) * rng.standard_normal())
    return np.array(values)


def test_what_coloured_noise_wanders_at_rest_is_bounded_from_above():
    """An upper end of 95 %: of 400 rests of 50 samples few have less than the true 1, the median is of its order."""
    rng, t = np.random.default_rng(5), np.arange(50.0)
    found = np.array([largest_wander(t, 20.0 + coloured(rng, 50, 0.7)) for _ in range(400)])
    seen = found[found > 0.0]
    assert seen.size > 0.9 * found.size
    assert np.mean(seen < 1.0) < 0.15
    assert 1.0 < np.median(seen) < 1.6


def test_white_noise_and_a_still_pv_do_not_wander():
    rng, t = np.random.default_rng(6), np.arange(50.0)
    found = [largest_wander(t, rng.standard_normal(50)) for _ in range(400)]
    assert np.mean(np.array(found) > 0.0) < 0.05
    assert largest_wander(t, np.full(50, 20.0)) == 0.0
    assert largest_wander(np.array([]), np.array([])) == 0.0  # a record that begins with the relay
    assert largest_wander(t, 20.0 + 0.1 * t) == 0.0


def test_only_the_rest_before_the_relay_counts():
    record = a_record()
    assert wander_at_rest(record) == 0.0
    wandering = record.pv + np.where(record.t < 10.0, 0.3 * np.sin(record.t / 2.0), 0.0)
    assert wander_at_rest(Recording(record.t, record.output, wandering, settings=record.settings)) > 0.2
    assert wander_at_rest(Recording(record.t, record.output, wandering)) == 0.0


def test_a_load_at_the_end_of_the_rest_is_not_taken_for_noise():
    """A PV that falls within the last eight of fifty samples; noise that wanders as far through all fifty is noise."""
    rng, t = np.random.default_rng(7), np.arange(50.0)
    rests = 0.1 * rng.standard_normal((100, 50)) - 4.0 * -np.expm1(-np.maximum(t - 42.0, 0.0) / 8.0)
    assert np.mean([largest_wander(t, rest) > 0.3 for rest in rests]) < 0.05


@pytest.mark.parametrize("last", [
    {"return": 90.0},
    pytest.param({"staircase": 90.0}, marks=pytest.mark.long),
    pytest.param({"staircase": 60.0, "return": 119.9}, marks=pytest.mark.long),
])  # fmt: skip
def test_a_part_without_a_load_is_searched_where_a_check_was_cut_short(last):
    """There is no tail then: the part after it judges the model, or the one before that where it is too short."""
    t = np.arange(0.0, 120.0, DT)
    output = np.where(t < 10.0, 40.0, 40.0 + 10.0 * (t // 8.0 % 2.0))
    moves = np.flatnonzero(np.diff(output)) + 1
    pv = 50.0 + sum((output[k] - output[k - 1]) * step_at(t, t[k] + D) for k in moves)
    pv += 30.0 * step_at(t, 18.0) + np.random.default_rng(3).normal(0.0, NOISE, t.size)
    record = Recording(t, output, pv, settings={"segments": {"relay": 10.0, "half_relay": 50.0, **last}})
    found, error = undisturbed(record, "fopdt", identify(record, "fopdt"))
    assert pytest.approx((K, T, D), rel=0.05) == (found.model.K, found.model.T, found.model.D)
    assert error.held_out == pytest.approx(NOISE, rel=0.2)
