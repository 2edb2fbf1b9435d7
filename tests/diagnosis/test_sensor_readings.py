"""Spikes, frozen values, grids and jumps of a reading, against readings whose faults are written down here."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotuner.core.diagnosis.record.sensor import Grid, frozen, grid_of, spikes_of, visible_jumps

N = 400
NOISE = np.random.default_rng(12).normal(0.0, 1.0, N)
SCALES = st.floats(1e-3, 1e3)
OFFSETS = st.floats(-1e3, 1e3)


def with_run(first, values):
    """White noise of 1 with other readings put over it."""
    residual = NOISE.copy()
    residual[first : first + len(values)] += values
    return residual


def rows_of(mask):
    return np.flatnonzero(mask).tolist()


def walking(n=N, step=0.1, seed=3):
    """A reading that moves by 0.5 to 1.5 steps at each sample."""
    return np.cumsum(step * np.random.default_rng(seed).uniform(0.5, 1.5, n))


# ------------------------------------------------------------------------------------------------------------ spikes


def test_noise_alone_has_no_spikes():
    assert not spikes_of(NOISE, 1.0).any()


@pytest.mark.parametrize("count", [1, 2, 5, 7])
def test_a_burst_of_up_to_half_a_window_is_found_sample_by_sample(count):
    """The running median of 15 samples is the noise where at most 7 of them are off."""
    assert rows_of(spikes_of(with_run(200, [50.0] * count), 1.0)) == list(range(200, 200 + count))


def test_a_longer_burst_is_a_level():
    assert not spikes_of(with_run(200, [50.0] * 12), 1.0).any()


def test_spikes_to_both_sides_are_found():
    residual = with_run(100, [60.0])
    residual[300] -= 60.0
    assert rows_of(spikes_of(residual, 1.0)) == [100, 300]


def test_a_step_does_not_come_back_and_is_no_spike():
    residual = NOISE + 50.0 * (np.arange(N) > 200)
    assert not spikes_of(residual, 1.0).any()


def test_the_first_reading_may_be_wild():
    assert rows_of(spikes_of(with_run(0, [50.0]), 1.0)) == [0]


@pytest.mark.parametrize(("back", "expected"), [(46.0, [200]), (8.0, [])])
def test_a_reading_that_comes_back_by_less_than_half_is_no_spike(back, expected):
    """A jump by 50 that ends at another level: there and back by 46, and by 8 only."""
    residual = 0.1 * NOISE + np.where(np.arange(N) > 200, 50.0 - back, 0.0)
    residual[200] = 50.0
    assert rows_of(spikes_of(residual, 0.1)) == expected


def test_the_record_may_end_before_the_reading_comes_back():
    residual = NOISE + 50.0 * (np.arange(N) >= N - 3)
    assert rows_of(spikes_of(residual, 1.0)) == [N - 3, N - 2, N - 1]


@pytest.mark.parametrize(("size", "count"), [(8.0, 0), (10.5, 6)])
def test_the_tail_of_the_noise_is_no_fault(size, count):
    """Of a reading that goes up and down by 1, half of it is off its median by 1; spikes by 9 of that are another."""
    residual = np.tile([0.0, 0.5, 1.0, 0.5, 0.0, -0.5, -1.0, -0.5], N // 8)
    spread = 1.4826 * float(np.median(np.abs(residual)))
    at = np.flatnonzero(residual == 0.0)[8::16]
    residual[at] = spread * size
    assert np.count_nonzero(spikes_of(residual, 0.0)) == (at.size if count else 0)


@pytest.mark.parametrize(("apart", "found"), [(20, True), (12, True), (9, True), (8, False)])
def test_single_outliers_are_found_up_to_an_eighth_of_the_samples(apart, found):
    """Of one sample in 9, 11 %, and not of one in 8: above 12 % they are not isolated."""
    off = np.arange(N) % apart == apart // 2
    residual = 0.1 * NOISE + np.where(off, np.where(np.arange(N) % 3, 50.0, -40.0), 0.0)
    assert spikes_of(residual, 0.1).tolist() == (off & found).tolist()


@pytest.mark.parametrize(("count", "found"), [(4, True), (6, False)])
def test_many_outliers_are_not_isolated(count, found):
    """Bursts of 4 in 40 samples are a tenth, of 6 more than the 12 % that may be."""
    residual = 1e-3 * NOISE
    off = np.arange(N) % 40 >= 40 - count
    residual[off] += 50.0
    assert spikes_of(residual, 1e-3).tolist() == (off & found).tolist()


@pytest.mark.parametrize(("motion", "expected"), [(0.0, [200]), (30.0, [200]), (36.0, [])])
def test_a_process_that_moves_as_far_made_it(motion, expected):
    """A jump of 50 counts from one and a half times the most that the process moves: 45 and 54."""
    residual = 1e-3 * NOISE
    residual[200] = 50.0
    assert rows_of(spikes_of(residual, 1e-3, motion)) == expected


def test_a_few_samples_show_no_spikes():
    residual = np.zeros(14)
    residual[7] = 1e6
    assert not spikes_of(residual, 1.0).any()


@given(SCALES, OFFSETS, st.sampled_from([-1.0, 1.0]))
@settings(max_examples=40, deadline=None)
def test_spikes_are_the_same_in_other_units(scale, offset, sign):
    residual = with_run(120, [40.0, 45.0])
    residual[300] -= 55.0
    other = sign * scale * (residual + offset)
    assert rows_of(spikes_of(other, scale)) == [120, 121, 300]


# ------------------------------------------------------------------------------------------------------------ frozen


def frozen_from(first, equal):
    pv = walking()
    pv[first : first + equal] = pv[first]
    return pv


@pytest.mark.parametrize(("equal", "found"), [(8, False), (9, True), (40, True)])
def test_a_frozen_reading_is_found_from_its_first_repetition(equal, found):
    """Nine equal readings are eight repetitions."""
    seen = rows_of(frozen(frozen_from(150, equal), 20))
    assert seen == (list(range(151, 150 + equal)) if found else [])


def test_a_reading_that_stands_still_before_the_output_moves_is_at_rest():
    assert not frozen(frozen_from(150, 40), 200).any()


@pytest.mark.parametrize(("back", "found"), [(3.0, False), (6.0, True)])
def test_a_reading_that_goes_on_without_a_jump_was_at_rest(back, found):
    """The jump at the end counts from 4 usual moves, here of 0.1 each."""
    pv = np.arange(N) * 0.1
    pv[150:170] = pv[150]
    pv[170:] = pv[150] + 0.1 * back + 0.1 * np.arange(N - 170)
    assert bool(frozen(pv, 20).any()) is found


def test_a_reading_that_ends_frozen_shows_no_jump():
    pv = walking()
    pv[-50:] = pv[-50]
    assert not frozen(pv, 20).any()


def test_the_end_of_a_range_is_no_frozen_sensor():
    """The PV creeps up, rests at the end of its range and falls at once; a rest below the end is a frozen sensor."""
    climb = np.concatenate((0.1 * np.arange(100) + 1e-3 * NOISE[:100] ** 2, np.full(15, 9.99)))
    pv = np.tile(np.minimum(climb, 9.99), 4)
    assert not frozen(pv, 0).any()
    pv[-1] = 20.0
    assert np.count_nonzero(frozen(pv, 0)) == 14 + 14 + 14 + 13


def test_a_sensor_that_repeats_its_readings_anyway_is_coarse():
    pv = np.repeat(walking(N // 2), 2)
    pv[150:180] = pv[150]
    assert not frozen(pv, 20).any()


@given(SCALES, st.sampled_from([-1.0, 1.0]))
@settings(max_examples=30, deadline=None)
def test_a_frozen_reading_is_the_same_in_other_units(scale, sign):
    assert rows_of(frozen(sign * scale * frozen_from(150, 20), 20)) == list(range(151, 170))


# -------------------------------------------------------------------------------------------------------------- grid

SWING = 3.0 * np.sin(np.arange(N) / 17.0)


@given(st.floats(0.05, 0.9), st.integers(-50, 50))
@settings(max_examples=40, deadline=None)
def test_the_step_of_a_converter_is_found_wherever_its_zero_is(step, zero):
    """Rounding to multiples: a reading is at most half a step from the PV."""
    found = grid_of((np.round(SWING / step) + zero) * step)
    assert found is not None
    assert found.rounded
    assert found.step == pytest.approx(step, rel=1e-6)
    assert found.half == pytest.approx(step / 2.0, rel=1e-6)


@pytest.mark.parametrize("pv", [
    SWING + 0.01 * NOISE,
    np.full(N, 4.0),
    np.round(SWING, 6),  # nearly every reading differs: too fine to be seen
    np.tile([0.0, 1.0, 2.6, 1.0], N // 4),  # no common step
], ids=["noise", "constant", "fine", "uneven"])  # fmt: skip
def test_other_readings_have_no_grid(pv):
    assert grid_of(pv) is None


def sent_on_change(pv, least):
    """A transmitter that sends a reading as soon as it is `least` from the last one."""
    sent = [pv[0]]
    for value in pv[1:]:
        sent.append(value if abs(value - sent[-1]) >= least else sent[-1])
    return np.array(sent)


@pytest.mark.parametrize("least", [0.5, 1.0])
def test_a_sensor_that_reports_changes_may_be_a_whole_step_off(least):
    pv = 3.0 * np.sin(np.arange(4 * N) / 170.0) + 1e-4 * np.random.default_rng(1).normal(size=4 * N)
    found = grid_of(sent_on_change(pv, least))
    assert found is not None
    assert not found.rounded
    assert found.sends
    assert found.half == found.step == pytest.approx(least, rel=0.05)


def test_a_grid_of_two_values_is_that_of_changes():
    assert grid_of(np.repeat([0.0, 2.0, 0.0], 50)) == Grid(2.0, 2.0, rounded=False)


# ------------------------------------------------------------------------------------------------------------- jumps


@given(st.floats(-5.0, 5.0), st.integers(20, N - 20), st.floats(-0.25, 0.25))
@settings(max_examples=40, deadline=None)
def test_the_size_of_a_jump_on_a_slope_is_exact(size, k, share):
    """The difference beside both neighbours is that of the jump: a slope of up to a quarter a sample falls out."""
    t = 0.5 * np.arange(N)
    slope = 2.0 * share * size
    found = visible_jumps(t, slope * t + size * (np.arange(N) > k), 0.01)
    assert len(found) == (abs(size) > 0.06)
    for at_s, seen in found:
        assert at_s == pytest.approx((t[k] + t[k + 1]) / 2.0)
        assert seen == pytest.approx(size)


@pytest.mark.parametrize("share", [0.7, 1.0, 2.0])
def test_a_jump_against_a_steep_slope_is_no_wild_reading(share):
    """The PV rises by 1 to 3 a sample and falls by 2 at one: what is seen there may be minus the rise elsewhere."""
    k, size = 150, -2.0
    ((at_s, seen),) = visible_jumps(np.arange(float(N)), share * np.arange(N) + size * (np.arange(N) > k), 0.01)
    assert at_s == k + 0.5
    assert seen == pytest.approx(size)


def test_a_wild_reading_on_a_steep_slope_is_no_jump():
    pv = 2.0 * np.arange(N)
    pv[150] += 3.0
    assert visible_jumps(np.arange(float(N)), pv, 0.01) == []


@pytest.mark.parametrize(("share", "count"), [(5.9, 0), (6.1, 1)])
def test_a_jump_is_visible_from_six_floors(share, count):
    assert len(visible_jumps(np.arange(float(N)), share * 0.2 * (np.arange(N) > 99), 0.2)) == count


def test_a_wild_reading_comes_back_and_is_no_jump():
    pv = 0.01 * NOISE
    pv[200] += 5.0
    assert visible_jumps(np.arange(float(N)), pv, 0.0) == []


def test_the_largest_four_are_given_in_the_order_of_time():
    at, sizes = [60, 120, 180, 240, 300, 360], [3.0, 1.0, -5.0, 2.0, -1.5, 4.0]
    pv = 0.01 * NOISE
    for k, size in zip(at, sizes, strict=True):
        pv += size * (np.arange(N) >= k)
    found = visible_jumps(np.arange(float(N)), pv, 0.0)
    assert [at_s for at_s, _ in found] == [59.5, 179.5, 239.5, 359.5]
    assert [size for _, size in found] == pytest.approx([3.0, -5.0, 2.0, 4.0], abs=0.1)


def test_a_few_samples_show_no_jumps():
    assert visible_jumps(np.arange(14.0), np.repeat([0.0, 9.0], 7), 0.0) == []


@given(SCALES, OFFSETS)
@settings(max_examples=30, deadline=None)
def test_jumps_scale_with_the_units(scale, offset):
    pv = 0.1 * NOISE + 4.0 * (np.arange(N) > 250)
    ((at_s, size),) = visible_jumps(np.arange(float(N)), scale * (pv + offset), 0.0)
    assert at_s == 250.5
    assert size / scale == pytest.approx(4.0, abs=0.4)
