"""Records of the tuning's experiment with something in them that nobody declared: what is named, and how big.

Expected values are the simulator's own settings.
"""

import math

import numpy as np
import pytest

from autotuner import diagnose
from autotuner_sim import Backlash, LoadStep, OutputQuantisation, Saturation, SquareRootOutflow
from tests.diagnosis.cases import PLANTS, SAMPLE_S, swing_of_pv, tuning_record

pytestmark = pytest.mark.usefixtures("without_gains")


def record_of(kind, decibel=40.0, seed=1, **physics):
    plant, step_s = PLANTS[kind], SAMPLE_S[kind]
    sigma = 0.0 if math.isinf(decibel) else swing_of_pv(plant, step_s) * 10.0 ** (-decibel / 20.0)
    return tuning_record(plant, step_s, sigma, seed, **physics)


HIDDEN = {
    "backlash": ("balanced", {"actuators": [Backlash(2.0)]}, {"width": 2.0}),
    "saturation": ("second", {"actuators": [Saturation(0.0, 46.0)]}, {"high": 46.0}),
    "output_quantisation": ("balanced", {"actuators": [OutputQuantisation(1.7)]}, {"step": 1.7}),
    "load_step": ("lag", {"loads": [LoadStep(150.0, 3.0)]}, {"at_s": 150.0, "size": 3.0}),
}


ACTUATOR = ("backlash", "stiction", "saturation", "rate_limit", "output_quantisation", "direction_gain")
LOAD = ("load_step", "bias_step", "drift")


@pytest.mark.one_of(2)
@pytest.mark.parametrize("name", ["backlash", "saturation", "output_quantisation"])
def test_an_effect_of_the_actuator_is_named_alone_with_its_size(name, among):
    among(*ACTUATOR)
    assert_named_alone(name)


def test_an_effect_is_named_alone_with_its_size():
    """In the whole catalogue."""
    assert_named_alone("load_step")


def assert_named_alone(name):
    kind, physics, truth = HIDDEN[name]
    found = diagnose(record_of(kind, **physics))
    assert found.verdict == "explained"
    assert [effect.name for effect in found.effects] == [name]
    effect = found.effects[0]
    for size, value in truth.items():
        low, high = effect.interval95[size]
        slack = 0.01 * abs(value)
        assert low - slack <= value <= high + slack
    assert effect.advice
    held, sigma = found.error["held_out"], swing_of_pv(PLANTS[kind], SAMPLE_S[kind]) / 100.0  # 40 dB
    assert held.noise == pytest.approx(sigma, rel=0.08)
    assert held.after < 1.31 * sigma < held.before
    plant = PLANTS[kind].parameters() if hasattr(PLANTS[kind], "parameters") else {"K": PLANTS[kind].K}
    assert pytest.approx(plant["K"], rel=0.03) == found.process.K


@pytest.mark.parametrize("kind", ["balanced", "under"])
def test_a_record_with_nothing_hidden_is_adequate(kind):
    found = diagnose(record_of(kind, 30.0, seed=3))
    assert found.verdict == "adequate"
    assert found.effects == ()


def test_a_record_without_the_check_says_what_it_is_blind_to():
    whole = record_of("balanced", 30.0, seed=4)
    alone = whole.window(0.0, whole.settings["segments"]["half_relay"])
    found = diagnose(alone.__class__(alone.t, alone.output, alone.pv))
    assert any("blind" in note for note in found.notes)


def test_two_effects_are_both_named(among):
    among(*ACTUATOR[:3], *LOAD)
    found = diagnose(record_of("balanced", 40.0, actuators=[Backlash(3.0)], loads=[LoadStep(120.0, -3.0)]))
    assert {effect.name for effect in found.effects} == {"backlash", "load_step"}


def test_a_form_that_the_catalogue_lacks_is_never_named_confidently_wrong():
    found = diagnose(record_of("second", 40.0, couplings=[SquareRootOutflow(20.0, 1.5)], step_s=0.1))
    wrong = [e for e in found.effects if e.name not in {"nonlinear_loss", "static_nonlinearity"}]
    assert all(effect.confidence < 0.8 or effect.indistinguishable for effect in wrong)


def test_the_answer_is_json_ready():
    import json

    told = diagnose(record_of("balanced", 30.0, seed=5)).to_dict()
    assert json.loads(json.dumps(told, allow_nan=False)) == told
    assert set(told["error"]["held_out"]) == {"before", "after", "noise", "expected"}
    assert np.isfinite(told["error"]["fitted"]["after"])
