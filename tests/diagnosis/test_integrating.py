"""Processes that integrate, with effects and without: a lag that outlasts the record is an integrator there.

Records are those of the independent generator and of the simulator, but for a lag whose response is
(1 - e^{-t/T}): a closed form.
"""

import numpy as np
import pytest

from autotuner import Recording, diagnose
from autotuner.core.diagnosis.extended.base import base_of, outlasts_the_record
from autotuner.core.diagnosis.extended.coloured_noise import coloured_noise
from autotuner.core.diagnosis.extended.fit_context import bench_of
from autotuner.core.diagnosis.record.dataset import dataset_of
from autotuner_sim import Backlash
from autotuner_sim.plants import Integrating
from benchmarks.accuracy.diagnosis.independent import Case, record_of
from tests.diagnosis.cases import tuning_record


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
    pytest.param("dead_time_jump:at once", 501, "random", marks=pytest.mark.long),
    ("gain_drift:fouling", 906, "steps"),
    ("load_step:step", 909, "short"),
    pytest.param("periodic_disturbance:sine", 911, "steps", marks=pytest.mark.long),
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


def test_a_level_whose_valve_has_play_gets_the_gains_of_its_own_process():
    """The process alone looks unstable, and its gains would be a guess."""
    answer = diagnose(tuning_record(Integrating(0.05, 2.0, 1.0), sigma=0.02, actuators=[Backlash(2.0)]))
    assert answer.verdict == "explained"
    assert [e.name for e in answer.effects] == ["backlash"]
    assert answer.effects[0].parameters["width"] == pytest.approx(2.0, rel=0.01)
    assert holds(answer, "K", 0.05)
    assert answer.gains["after"]["margins"]["stable"]


def test_a_slow_residual_is_no_noise_of_a_lag_that_outlasts_the_record():
    """It is shorter than such a lag, as noise is that has passed the process."""
    hidden = record_of(Case("sensor_hysteresis:creeping", 501, "random", "white", "integrating"))
    context = bench_of(dataset_of(Recording.from_csv_text(hidden.csv())))
    pair = base_of(context, ("offset",), 0).best
    assert outlasts_the_record(pair)
    assert coloured_noise(context, pair) is None


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
