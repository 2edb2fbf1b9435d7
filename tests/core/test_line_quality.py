"""What is said of a line that is slow, silent now and then, or damages what it carries."""

import numpy as np
import pytest

from autotuner.core.recording import Sample
from autotuner.core.recording.line_quality import line_warnings


def record(times_s):
    return [Sample(t, 20.0, 50.0) for t in times_s]


EVERY_TENTH = [k / 10.0 for k in range(400)]
GAP = [t for t in EVERY_TENTH if not 10.0 < t < 11.5]
CASES = {
    "as asked": (EVERY_TENTH, 2, ()),
    "slow": ([0.41 * k for k in range(100)], 0, ("every 0.41 s, not every 0.1 s", "sample_time_s to 0.49")),
    "one sample is missing": ([t for t in EVERY_TENTH if t != 10.0], 0, ()),
    "silent for a while": (GAP, 0, ("14 of 400 samples are missing, for 1.5 s at the longest",)),
    "asked again": (EVERY_TENTH, 3, ("3 requests in 400 samples", "timeout_s")),
    "too short to tell": ([0.0, 0.9, 1.8], 3, ()),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_said_of_a_line(case):
    times_s, repeated, words = CASES[case]
    told = line_warnings(record(times_s), 0.1, repeated)
    assert len(told) == bool(words)
    assert all(word in told[0] for word in words)


def test_damaged_readings_are_named_up_to_three_also_on_a_short_record():
    told = line_warnings(record(EVERY_TENTH), 0.1, 0, ["first", "second", "third", "fourth"])
    assert len(told) == 1
    assert "4 in all" in told[0]
    assert "first; second; third; and 1 more" in told[0]
    assert len(line_warnings(record([0.0]), 0.1, 0, ["first"])) == 1


def noisy(resolution, sigma=0.5, size=1000, seed=1):
    """A wave of +-5 in noise, as a register with a resolution tells it."""
    pv = 20.0 + 5.0 * np.sin(0.05 * np.arange(size)) + sigma * np.random.default_rng(seed).standard_normal(size)
    return np.round(pv / resolution) * resolution if resolution else pv


def answered_again(pv, share, seed=2):
    """Each reading an earlier one with this probability."""
    again = np.random.default_rng(seed).random(pv.size) < share
    return pv[np.maximum.accumulate(np.where(again, 0, np.arange(pv.size)))]


def told_of(pv):
    return line_warnings([Sample(0.1 * k, float(y), 50.0) for k, y in enumerate(pv)], 0.1, 0)


@pytest.mark.parametrize("resolution", [0.0, 0.1, 0.2])
@pytest.mark.parametrize("seed", range(20))
def test_readings_that_are_equal_by_chance_are_not_told(resolution, seed):
    assert told_of(noisy(resolution, seed=seed)) == []


@pytest.mark.parametrize("resolution", [0.0, 0.1, 0.2])
def test_readings_that_were_answered_again_are_told_with_their_age(resolution):
    """A fifth of them: rows of l readings with probability 0.8 x 0.2^(l-1) are 0.2/0.8 readings old on the mean."""
    (text,) = told_of(answered_again(noisy(resolution), 0.2))
    assert "equal the one before" in text
    age_s = float(text.split(" s old")[0].split()[-1])
    assert age_s == pytest.approx(0.025, rel=0.5 if resolution else 0.15)


def test_a_device_that_measures_every_third_time_is_told():
    assert len(told_of(np.repeat(noisy(0.0), 3)[:900])) == 1


@pytest.mark.parametrize(
    "pv",
    [np.full(500, 20.0), np.repeat([20.0, 20.1], 250), np.r_[np.full(300, 20.0), noisy(0.0)], noisy(2.0)],
    ids=["still", "one step", "without noise at rest", "coarse"],
)
def test_a_pv_that_may_well_stand_still(pv):
    assert told_of(pv) == []
