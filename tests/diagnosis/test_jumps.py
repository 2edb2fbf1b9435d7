"""A jump of the reading that stands out by itself, and what is found beside it. Truths are the simulator's settings."""

import numpy as np
import pytest

from autotuner import Recording, diagnose
from autotuner.core.diagnosis.effects.jumps import plain_jump
from autotuner.core.diagnosis.record.dataset import dataset_of
from autotuner_sim import BiasStep, LoadStep, PowerLaw
from tests.diagnosis.cases import PLANTS, SAMPLE_S, tuning_record

pytestmark = pytest.mark.usefixtures("without_gains")

AT_S = 150.0


def jump_of(recording):
    return plain_jump(dataset_of(recording))


def record_of(kind="lag", sigma=0.0, **physics):
    return tuning_record(PLANTS[kind], SAMPLE_S[kind], sigma, **physics)


@pytest.mark.parametrize(("sigma", "size"), [(0.0, 0.8), (0.0, -3.0), (0.02, 1.0)])
def test_a_jump_is_seen_at_its_sample(sigma, size):
    at_s = jump_of(record_of(sigma=sigma, offsets=[BiasStep(AT_S, size)]))
    assert at_s == pytest.approx(AT_S, abs=SAMPLE_S["lag"])


@pytest.mark.parametrize("physics", [{}, {"loads": [LoadStep(AT_S, 3.0)]}])
@pytest.mark.parametrize("sigma", [0.0, 0.05])
def test_a_process_that_turns_does_not_jump(physics, sigma):
    assert jump_of(record_of(sigma=sigma, **physics)) is None


def test_a_wild_reading_is_no_jump():
    whole = record_of(sigma=0.02)
    pv = np.array(whole.pv)
    pv[pv.size // 3] += 5.0
    assert jump_of(Recording(whole.t, whole.output, pv, settings=whole.settings)) is None


@pytest.mark.long  # another pair of effects is in test_effects_are_named
def test_a_curve_is_found_beside_a_jump_that_hides_it():
    """Without noise: each alone is followed by a dozen other effects as well."""
    found = diagnose(record_of(actuators=[PowerLaw(2.0)], offsets=[BiasStep(AT_S, 0.8)]))
    assert {effect.name for effect in found.effects} == {"static_nonlinearity", "bias_step"}
    jump = next(effect for effect in found.effects if effect.name == "bias_step")
    assert jump.parameters["size"] == pytest.approx(0.8, rel=0.02)
    assert pytest.approx(2.0, rel=0.02) == found.process.K


@pytest.mark.long  # a record without segments shows the same
def test_a_jump_there_and_back_is_found_with_its_duration():
    there_and_back = [BiasStep(AT_S, 0.8), BiasStep(AT_S + 40.0, -0.8)]
    found = diagnose(record_of(sigma=0.02, offsets=there_and_back))
    assert [effect.name for effect in found.effects] == ["bias_step"]
    assert found.effects[0].parameters["at_s"] == pytest.approx(AT_S, abs=2.0 * SAMPLE_S["lag"])
    assert found.effects[0].parameters["lasts_s"] == pytest.approx(40.0, abs=2.0 * SAMPLE_S["lag"])
