"""Processes that integrate, with effects and without: a lag that outlasts the record is an integrator there.

Records are those of the independent generator, but for a lag whose response is (1 - e^{-t/T}): a closed form.
"""

import numpy as np
import pytest

from autotuner import Recording, diagnose
from benchmarks.accuracy.diagnosis.independent import Case, record_of


def answer_to(key, seed, experiment, noise="white"):
    """Return a record of an integrating plant, and its diagnosis."""
    hidden = record_of(Case(key, seed, experiment, noise, "integrating"))
    return hidden, diagnose(Recording.from_csv_text(hidden.csv()))


def holds(answer, name, value):
    low, high = answer.model["after"]["interval95"][name]
    return low < value < high


@pytest.mark.parametrize(("seed", "experiment", "noise"), [(895, "relay", "white"), (894, "relay", "coloured")])
def test_a_process_that_integrates_is_one_and_gets_gains(seed, experiment, noise):
    """By the error alone it is a lag whose gain could be any: of 895, no gains could be given."""
    hidden, answer = answer_to("clean", seed, experiment, noise)
    assert answer.verdict == "adequate"
    assert answer.model["after"]["structure"] == "integrating"
    assert holds(answer, "K", hidden.gain)
    assert answer.gains["after"]["margins"]["stable"]


EFFECTS = [
    ("backlash:play", 501, "steps"),
    ("dead_time_jump:at once", 501, "random"),
    ("gain_drift:fouling", 906, "steps"),
    ("load_step:step", 909, "short"),
    ("periodic_disturbance:sine", 911, "steps"),
    pytest.param("rate_limit:unequal", 501, "short", marks=pytest.mark.long),
    pytest.param("actuator_hold:even", 900, "relay", marks=pytest.mark.long),
]


@pytest.mark.usefixtures("without_gains")
@pytest.mark.parametrize(("key", "seed", "experiment"), EFFECTS)
def test_an_effect_beside_a_process_that_integrates_is_explained(key, seed, experiment):
    hidden, answer = answer_to(key, seed, experiment)
    assert answer.verdict == "explained"
    assert [e.name for e in answer.effects] == [key.partition(":")[0]]
    assert answer.model["after"]["structure"] == "integrating"
    assert holds(answer, "K", hidden.gain)


@pytest.mark.usefixtures("without_gains")
def test_a_slow_residual_is_no_noise_of_a_lag_that_outlasts_the_record():
    """It is shorter than such a lag, and was taken for noise that has passed the process."""
    _, answer = answer_to("sensor_hysteresis:creeping", 501, "random")
    assert answer.verdict != "adequate"


@pytest.mark.usefixtures("without_gains")
@pytest.mark.parametrize("lag_s", [900.0, 1500.0])
def test_a_lag_that_outlasts_the_record_and_shows_stays_one(lag_s):
    t, gain, delay_s = np.arange(0.0, 1000.0), 3.0, 10.0
    moves = ((20.0, 10.0), (300.0, -16.0), (520.0, 12.0), (760.0, -8.0))
    output = 40.0 + sum(move * (t >= at_s) for at_s, move in moves)
    pv = sum(-gain * move * np.expm1(-np.maximum(t - at_s - delay_s, 0.0) / lag_s) for at_s, move in moves)
    answer = diagnose(Recording(t, output, 50.0 + pv + np.random.default_rng(3).normal(0.0, 0.02, t.size)))
    assert answer.verdict == "adequate"
    assert answer.model["after"]["structure"] != "integrating"
    assert holds(answer, "K", gain)
