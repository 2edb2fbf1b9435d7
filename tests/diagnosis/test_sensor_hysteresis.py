"""Play of a sensor, against play worked by hand, a general solver, and records that were made without ours."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotuner import Recording, diagnose
from autotuner.core.diagnosis.effects.sensor_hysteresis import reading_that_creeps, reading_with_play, sensor_hysteresis
from autotuner.core.diagnosis.record.dataset import dataset_of
from autotuner.effects import EffectPlugin, check_effect
from tests.diagnosis.test_records_without_segments import integrated, levels, straight

pytestmark = pytest.mark.usefixtures("without_gains")


def one_by_one(pv, width, ahead):
    """The definition, sample by sample."""
    at, result = pv[0], []
    for y in pv:
        at = min(max(at, y - ahead * width), y + (1.0 - ahead) * width)
        result.append(at)
    return result


def test_a_reading_stands_still_after_a_reversal():
    pv = np.array([0.0, 1.0, 3.0, 2.0, 0.5, -1.0, 1.0])
    assert reading_with_play(pv, 2.0, 0.5).tolist() == [0.0, 0.0, 2.0, 2.0, 1.5, 0.0, 0.0]
    assert reading_with_play(pv, 2.0, 0.0).tolist() == [0.0, 1.0, 3.0, 3.0, 2.5, 1.0, 1.0]


@given(
    st.lists(st.floats(-10.0, 10.0), min_size=2, max_size=40),
    st.floats(0.01, 8.0),
    st.floats(0.0, 1.0),
)
def test_it_is_the_definition(pv, width, ahead):
    assert reading_with_play(np.array(pv), width, ahead) == pytest.approx(one_by_one(pv, width, ahead), abs=1e-12)


def test_a_reading_that_creeps_comes_nearer_by_a_share_each_time():
    """A half of the way in ln 2 seconds for a time constant of 1 s; the play holds it within 1 of the PV."""
    pv = np.array([0.0, 3.0, 2.5, 2.5, 2.5, -2.0])
    t = math.log(2.0) * np.array([0.0, 1.0, 2.0, 3.0, 4.0, 6.0])
    # 1.5 is too far from 3; a half of the way from 2 to 2.5, twice more, and a quarter of the way is left after two
    assert reading_that_creeps(t, pv, 2.0, 1.0) == pytest.approx([0.0, 2.0, 2.25, 2.375, 2.4375, -1.0])
    assert reading_that_creeps(t, pv, 2.0, 1e9) == pytest.approx(reading_with_play(pv, 2.0, 0.5))


@given(
    st.lists(st.floats(-10.0, 10.0), min_size=2, max_size=40),
    st.floats(0.01, 8.0),
    st.floats(0.1, 100.0),
)
def test_the_creep_is_the_definition(pv, width, creep_s):
    at, expected = pv[0], []
    for y in pv:
        crept = y + (at - y) * (math.exp(-1.0 / creep_s) if expected else 1.0)
        at = min(max(crept, y - width / 2.0), y + width / 2.0)
        expected.append(at)
    t = np.arange(float(len(pv)))
    assert reading_that_creeps(t, np.array(pv), width, creep_s) == pytest.approx(expected, abs=1e-9)


def test_it_conforms():
    def make(dataset, _base):
        return [replace(effect, name="float") for effect in sensor_hysteresis(dataset)]

    assert check_effect(EffectPlugin("float", make, "the reading stands still for {width:.3g}")) == []


@pytest.mark.parametrize("hidden", ["sensor", "actuator"])
def test_play_of_the_sensor_and_of_the_actuator_are_distinguished(hidden, among):
    """Play before the process delays its motion, play behind it cuts the tips off."""
    among("sensor_hysteresis", "backlash", "stiction")
    output = levels(np.random.default_rng(12), 600, 15, 60)
    moved = output if hidden == "sensor" else np.array(one_by_one(output, 3.0, 0.5))
    pv = integrated(moved, straight)
    read = np.array(one_by_one(pv, 4.0, 0.5)) if hidden == "sensor" else pv
    noise = np.random.default_rng(3).normal(0.0, 0.05, pv.size)
    found = diagnose(Recording(np.arange(pv.size, dtype=float), output, read + noise))
    (effect,) = found.effects
    assert found.verdict == "explained"
    if hidden == "sensor":
        assert (effect.name, effect.place) == ("sensor_hysteresis", "sensor")
        assert effect.parameters["width"] == pytest.approx(4.0, rel=0.02)
    else:
        assert effect.name == "backlash"
        assert effect.parameters["width"] == pytest.approx(3.0, rel=0.05)
    assert pytest.approx(2.0, rel=0.02) == found.process.K


def test_a_creep_as_quick_as_the_process_is_a_further_lag_of_the_row():
    dataset = dataset_of(Recording(np.arange(60.0), np.repeat([0.0, 5.0], 30), np.arange(60.0)))
    standing, creeping = sensor_hysteresis(dataset)
    assert standing.means((0.5, 0.5), (), 1.0, (20.0, 5.0))
    assert creeping.means((0.5, math.log(40.0)), (), 1.0, (20.0, 5.0))
    assert not creeping.means((0.5, math.log(22.0)), (), 1.0, (20.0, 5.0))
