"""A sensor that died is told from one that has nothing new to say."""

import numpy as np
import pytest

from autotuner.core.recording import Sample
from autotuner.core.sensor_watch import FrozenWatch, JumpWatch
from autotuner.core.watches import Seen

FEWEST = 20


def first_trip(watch, pvs, outputs):
    """The row of the first verdict, or None."""
    for k, (pv, output) in enumerate(zip(pvs, outputs, strict=True)):
        if verdict := watch.check(Seen(Sample(float(k), float(pv), float(output)))):
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
    assert tripped == pytest.approx(200 + 3 * 20, abs=3)


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
    verdicts = [watch.check(Seen(Sample(float(k), float(pvs[k]), float(outputs[k])))) for k in rows]
    assert not any(verdicts)


def test_nothing_is_known_before_the_pv_was_driven():
    assert first_trip(JumpWatch(), [80.0] * 50 + [20.0] * 50, [40.0] * 100) is None
