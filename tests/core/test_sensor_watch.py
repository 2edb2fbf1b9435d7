"""A sensor that died is told from one that has nothing new to say."""

import numpy as np
import pytest

from autotuner.core.recording import Sample
from autotuner.core.safety.sensor_watch import FrozenWatch, JumpWatch
from autotuner.core.safety.watches import SampleContext

FEWEST = 20


def first_trip(watch, pvs, outputs, phase=""):
    """The row of the first verdict, or None."""
    for k, (pv, output) in enumerate(zip(pvs, outputs, strict=True)):
        if verdict := watch.check(SampleContext(Sample(float(k), float(pv), float(output)), phase=phase)):
            assert verdict.outcome == "aborted"
            assert verdict.remedy
            return k
    return None


def noisy(count, seed=0, sigma=0.05):
    return 80.0 + sigma * np.random.default_rng(seed).standard_normal(count)


def relay(count, rest=50, half=20):
    """An output at rest, then up and down."""
    k = np.arange(count) - rest
    return np.where(k < 0, 40.0, np.where(k // half % 2 == 0, 50.0, 30.0))


def wave(count, rest=50, half=20, amplitude=5.0):
    """A PV that follows such an output as a triangle."""
    phase = np.clip(np.arange(count) - rest, 0, None) % (2 * half)
    return 80.0 + amplitude * np.interp(phase, np.array([0.0, 0.5, 1.5, 2.0]) * half, [0.0, 1.0, -1.0, 0.0])


@pytest.mark.parametrize("at", [60, 130])
def test_a_noisy_pv_that_repeats_itself_is_frozen(at):
    pvs = noisy(300)
    pvs[at:] = pvs[at]
    assert first_trip(FrozenWatch(FEWEST), pvs, relay(300)) == at + FEWEST - 1


def test_a_noisy_pv_frozen_while_at_rest():
    pvs = noisy(300)
    pvs[30:] = pvs[30]
    assert first_trip(FrozenWatch(FEWEST), pvs, np.full(300, 40.0)) == 30 + FEWEST - 1


def test_a_quantised_sensor_at_rest_is_not_frozen():
    assert first_trip(FrozenWatch(FEWEST), np.full(5000, 80.0), np.full(5000, 40.0)) is None


def test_a_pv_that_settles_among_its_last_bits_is_not_noisy():
    """A simulated process without noise, read as 32-bit floats, under a controller that is about to settle."""
    units = np.array([0, 1, -1, 2, -2, 1, -1, 2, 0, 1, -2, 1, 0])
    pvs = np.concatenate([80.0 + units * float(np.spacing(np.float32(80.0))), np.full(5000, 80.0)])
    assert first_trip(FrozenWatch(FEWEST), pvs, np.full(pvs.size, 40.0)) is None


def test_dither_between_two_values_is_no_noise():
    """A PV that happened to rest on the edge of a step of its sensor, and settles within one later."""
    rng = np.random.default_rng(3)
    rest = np.where(rng.random(50) < 0.5, 80.0, 80.1)
    pvs = np.concatenate((rest, np.full(400, 83.0)))
    assert first_trip(FrozenWatch(FEWEST), pvs, relay(450, half=400)) is None


def test_a_report_on_change_sensor_is_given_ten_times_its_habit():
    """Noisy, but only told every 9 samples."""
    pvs = np.repeat(noisy(100, sigma=0.3), 9)
    output = relay(900, rest=200, half=80)
    assert first_trip(FrozenWatch(FEWEST), pvs, output) is None
    pvs[500:] = pvs[500]
    assert first_trip(FrozenWatch(FEWEST), pvs, output) == pytest.approx(500 + 90, abs=9)


def test_a_pv_without_noise_that_answered_before_and_stands_still():
    pvs = np.round(wave(600), 1)
    assert first_trip(FrozenWatch(FEWEST), pvs, relay(600)) is None
    pvs[200:] = pvs[200]
    tripped = first_trip(FrozenWatch(FEWEST), pvs, relay(600))
    assert tripped == pytest.approx(200 + FEWEST, abs=3)


@pytest.mark.parametrize("at", [1270, 1300, 1340, 1420])
def test_a_sensor_that_dies_on_its_way_is_noticed_in_a_tenth_of_a_half_period(at):
    """Noise under the register's step: nothing but the steps of the register shows that the PV moves."""
    pvs = np.round(wave(2500, half=300), 1)
    assert first_trip(FrozenWatch(FEWEST), pvs, relay(2500, half=300)) is None
    pvs[at:] = pvs[at]
    assert at < first_trip(FrozenWatch(FEWEST), pvs, relay(2500, half=300)) <= at + 30


def answering(half, frozen=None, dead_time=100, lag=150.0, step=0.1, move=(10.0, -20.0)):
    """A PV behind a dead time and a lag, the relay up and, after `half` samples, down; frozen from a sample on."""
    k = np.arange(50, 50 + 4 * half)
    pvs = np.full(k.size + 50, 80.0)
    for start, size in zip((0, half), move, strict=True):
        since = np.maximum(k - 50 - start - dead_time, 0)
        pvs[50:] += size * -np.expm1(-since / lag)
    pvs = np.round(pvs / step) * step
    if frozen is not None:
        pvs[frozen:] = pvs[frozen]
    return pvs, np.where(np.arange(pvs.size) < 50, 40.0, np.where(np.arange(pvs.size) < 50 + half, 50.0, 30.0))


@pytest.mark.parametrize("frozen", [180, 250, 480])
def test_a_sensor_that_freezes_in_the_first_half_periods_is_noticed_by_what_its_answer_took(frozen):
    pvs, output = answering(400, frozen)
    assert frozen < first_trip(FrozenWatch(FEWEST), pvs, output, "relay") <= frozen + 3 * 110
    assert first_trip(FrozenWatch(FEWEST), *answering(400), "relay") is None


@pytest.mark.parametrize("lag", [20.0, 100.0, 300.0])
def test_a_pv_that_settles_short_of_the_relay_is_left_to_the_relay_for_sixteen_time_constants(lag):
    """It slows down before it stands still; the relay notices by then, and is made stronger."""
    pvs, output = answering(6000, lag=lag, move=(2.0, 0.0))
    rows = 150 + round(16 * lag)
    assert first_trip(FrozenWatch(FEWEST), pvs[:rows], output[:rows], "relay") is None


def test_a_coarse_sensor_that_no_longer_switches_the_relay_is_frozen():
    pvs = np.round(wave(600, amplitude=2.0))
    assert first_trip(FrozenWatch(FEWEST), pvs, relay(600), "relay") is None
    pvs[200:] = pvs[200]
    output = relay(600)
    output[200:] = output[200]
    assert 200 < first_trip(FrozenWatch(FEWEST), pvs, output, "relay") <= 200 + 3 * 20 + 20


def test_a_plateau_of_every_half_period_is_no_frozen_sensor():
    """A dead time much longer than the lag: the PV stands still for most of each half period."""
    pvs = np.repeat(np.where(np.arange(20) % 2 == 0, 80.0, 85.0), 100)
    pvs = np.interp(np.arange(2000), np.arange(0, 2000, 4), np.round(np.convolve(pvs, np.ones(9) / 9, "same"), 1)[::4])
    assert first_trip(FrozenWatch(FEWEST), np.round(pvs, 1), relay(2000, rest=100, half=100)) is None


def test_small_holds_after_the_relay_may_leave_the_pv_where_it_is():
    pvs, output = np.round(wave(600), 1), relay(600)
    output[450:] = 42.0
    pvs[450:] = pvs[450]
    assert first_trip(FrozenWatch(FEWEST), pvs[:505], output[:505]) is None


def test_a_coarse_sensor_may_stand_still():
    """A swing of four steps of the sensor: it may rest on one of them for long."""
    pvs = np.round(wave(600, amplitude=2.0))
    pvs[200:] = 80.0
    assert first_trip(FrozenWatch(FEWEST), pvs, relay(600)) is None


@pytest.mark.parametrize("size", [-60.0, 25.0])
def test_a_jump_that_stays_is_found_after_three_samples(size):
    pvs = wave(400) + noisy(400, sigma=0.05) - 80.0
    pvs[200:] += size
    assert first_trip(JumpWatch(), pvs, relay(400)) == 202


def test_an_outlier_is_forgiven():
    pvs = wave(400) + noisy(400, sigma=0.05) - 80.0
    pvs[200] += 60.0
    pvs[300:302] -= 60.0
    assert first_trip(JumpWatch(), pvs, relay(400)) is None


def test_corners_and_coarse_steps_are_no_jumps():
    square = 80.0 + 5.0 * (np.arange(600) // 25 % 2)
    assert first_trip(JumpWatch(), square, relay(600)) is None
    assert first_trip(JumpWatch(), np.round(wave(600, amplitude=3.0)), relay(600)) is None


def test_after_a_gap_the_pv_may_be_elsewhere():
    watch = JumpWatch()
    pvs, outputs = wave(200), relay(200)
    rows = [k for k in range(200) if not 150 <= k < 165]
    verdicts = [watch.check(SampleContext(Sample(float(k), float(pvs[k]), float(outputs[k])))) for k in rows]
    assert not any(verdicts)


def test_nothing_is_known_before_the_pv_was_driven():
    assert first_trip(JumpWatch(), [80.0] * 50 + [20.0] * 50, [40.0] * 100) is None
