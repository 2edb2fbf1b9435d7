"""What keeps effects from being called an explanation although they leave next to nothing."""

from dataclasses import replace

import numpy as np
import pytest

from autotuner import Recording, diagnose
from autotuner.core.diagnosis.findings.doubts import (
    doubts_about,
    doubts_about_errors,
    doubts_about_moments,
    doubts_about_process,
)
from autotuner.core.diagnosis.findings.result import FoundEffect, Misfit
from autotuner.core.diagnosis.record.dataset import dataset_of
from autotuner.core.diagnosis.record.parts import parts_of
from autotuner.core.model.process import Fopdt, SopdtUnderdamped
from autotuner_sim import LoadStep
from tests.diagnosis.cases import PLANTS, tuning_record

pytestmark = pytest.mark.usefixtures("without_gains")

PLAY = FoundEffect("backlash", "actuator", {"width": 1.0}, {"width": (0.9, 1.1)}, 0.9)
LOAD = FoundEffect(
    "load_step", "disturbance", {"at_s": 100.0, "size": 2.0}, {"at_s": (99.0, 101.0), "size": (1.5, 2.5)}, 0.9
)
TIED = replace(PLAY, confidence=0.5, indistinguishable=("stiction",))


@pytest.mark.parametrize(
    "effect",
    [
        PLAY,
        LOAD,
        replace(PLAY, interval95={}),  # counted in the readings, not fitted
        replace(LOAD, interval95={"at_s": (0.0, 200.0), "size": (1.5, 2.5)}),
        replace(PLAY, parameters={"curve": 0.1, "third": 0.2}, interval95={"curve": (-1, 1), "third": (0.15, 0.25)}),
    ],
)
def test_an_effect_that_is_sure_and_bounded_is_not_doubted(effect):
    assert doubts_about((effect,)) == []


@pytest.mark.parametrize(
    ("effect", "word"),
    [
        (replace(PLAY, confidence=0.12), "confidence"),
        (TIED, "confidence"),
        (replace(PLAY, interval95={"width": (-19.0, 21.0)}), "open"),
        (replace(PLAY, interval95={"width": (0.4, 1.6)}), "open"),
        (replace(PLAY, interval95={"width": (float("nan"), 1.0)}), "open"),
        (replace(LOAD, interval95={"at_s": (99.9, 100.1), "size": (0.5, 3.5)}), "its size open"),
    ],
)
def test_an_effect_that_is_unsure_or_open_is_a_hypothesis(effect, word):
    (doubt,) = doubts_about((effect,))
    assert word in doubt


def test_effects_at_one_place_share_their_confidence_unless_a_controller_moves_the_output():
    shared = replace(TIED, at_its_place=0.999)
    assert doubts_about((shared,)) == []
    assert len(doubts_about((shared,), in_loop=True)) == 1
    assert len(doubts_about((replace(TIED, at_its_place=0.52),))) == 1


def test_the_process_beside_the_effects_has_to_be_known():
    """Its gain, and its answer time as a whole: a lag and a dead time that make up for each other are no doubt."""
    process, K, open_K = Fopdt(2.0, 10.0, 5.0), 0.1**2, 1.5**2
    apart = np.array([[4.0**2, -(4.0**2)], [-(4.0**2), 4.0**2]])

    def covariance(gain, lags):
        return np.block([[np.array([[gain]]), np.zeros((1, 2))], [np.zeros((2, 1)), lags]])

    assert doubts_about_process(process, process, None) == []
    assert doubts_about_process(process, process, covariance(K, apart)) == []
    assert "gain" in doubts_about_process(process, process, covariance(open_K, apart))[0]
    assert "answer time" in doubts_about_process(process, process, covariance(K, np.abs(apart)))[0]


def test_a_process_that_rings_has_to_show_its_damping():
    process = SopdtUnderdamped(6.0, 3284.0, 0.5, 1146.0)
    known = np.diag(np.array([0.35, 200.0, 0.05, 20.0]) ** 2)
    assert doubts_about_process(process, process, known) == []
    assert "damping" in doubts_about_process(process, process, np.diag(np.array([0.35, 200.0, 2.0, 20.0]) ** 2))[0]


def test_a_gain_that_changes_its_sign_with_the_effects_is_not_proven_in_a_loop():
    turned = Fopdt(-0.01, 10.0, 5.0), Fopdt(1.5, 10.0, 5.0)
    assert "sign" in doubts_about_process(*turned, None, in_loop=True)[0]
    assert doubts_about_process(*turned, None) == []


@pytest.mark.parametrize(
    ("before", "after", "later", "doubts"),
    [(9.0, 1.0, 1.9, 0), (9.0, 1.8, 2.4, 1), (1.0, 1.4, 1.4, 0), (1.2, 1.9, 1.9, 1)],
)
def test_the_selection_part_is_foretold_to_its_end_and_not_worse(before, after, later, doubts):
    parts = Misfit(before, after, 1.0, 1.0), Misfit(before, later, 1.0, 1.0)
    assert len(doubts_about_errors(*parts)) == doubts


def two_steps(late_s, lag_s=20.0, delay_s=15.0, moves=(45.0, 180.0), sigma=0.15):
    """Two moves of the output, of which the first reaches the process late: nobody records that."""
    t = np.arange(0.0, 300.0)
    levels = (10.0, -15.0)
    output = sum(level * (t >= at) for level, at in zip(levels, moves, strict=True))
    pv = np.zeros(t.size)
    for level, at in zip(levels, (moves[0] + late_s, moves[1]), strict=True):
        pv -= 2.5 * level * np.expm1(-np.maximum(t - at - delay_s, 0.0) / lag_s)
    noise = np.random.default_rng(4).normal(0.0, sigma, t.size)
    return Recording(t, 40.0 + output, 80.0 + pv + noise)


def test_a_load_that_comes_and_goes_with_the_answer_to_a_move_is_a_hypothesis():
    dataset, pulse = dataset_of(two_steps(0.0)), replace(LOAD, parameters={"size": 5.0, "at_s": 110.0, "lasts_s": 30.0})
    assert doubts_about_moments((pulse,), dataset, 15.0) == []
    for at_s, lasts_s in ((60.0, 12.0), (48.0, 12.0), (90.0, 105.5)):
        moved = replace(pulse, parameters={"size": 5.0, "at_s": at_s, "lasts_s": lasts_s})
        assert len(doubts_about_moments((moved,), dataset, 15.0)) == 1
    wave = replace(pulse, name="periodic_disturbance", parameters={"from_s": 60.0})
    assert doubts_about_moments((wave,), dataset, 15.0) == []


@pytest.mark.parametrize(
    ("from_s", "half_s", "doubts"), [(64.0, 6.0, 1), (64.0, 3.0, 0), (110.0, 6.0, 0), (70.0, 40.0, 0), (-30.0, 6.0, 0)]
)
def test_a_drift_that_may_begin_with_the_answer_to_a_move_is_a_hypothesis(from_s, half_s, doubts):
    """Moves arrive at 60 and 195 s. A beginning known to within 40 s may coincide by chance."""
    sizes = {"pv_in_all": 5.0, "time_constant_s": 40.0, "from_s": from_s}
    drift = FoundEffect("drift", "disturbance", sizes, {"from_s": (from_s - half_s, from_s + half_s)}, 0.9)
    assert len(doubts_about_moments((drift,), dataset_of(two_steps(0.0)), 15.0)) == doubts


def test_a_move_that_arrives_late_is_not_explained_by_a_load(among):
    among("load_step", "bias_step", "drift", "actuator_hold")
    found = diagnose(two_steps(10.0))
    assert found.verdict != "explained" or "load_step" not in [effect.name for effect in found.effects]
    assert found.model["after"] == found.model["before"]


@pytest.mark.long  # test_parts tampers with the test part
def test_what_the_test_part_speaks_against_is_said_and_chooses_nothing(among):
    """The load ends where the test part begins: names and verdict stay, and the sentence says that it is none."""
    among("load_step", "bias_step", "drift")
    record = tuning_record(PLANTS["balanced"], sigma=0.05, seed=7, loads=[LoadStep(120.0, -3.0)])
    record = Recording(record.t, record.output, record.pv)
    found = diagnose(record)
    pv, rows = record.pv.copy(), parts_of(record).tested
    pv[rows] = found.traces.before[rows]
    other = diagnose(Recording(record.t, record.output, pv))
    assert (other.verdict, other.effects) == (found.verdict, found.effects)
    assert found.effects
    assert "speaks against" not in found.summary
    assert "the test part speaks against" in other.summary
    assert any("larger with the effects" in note for note in other.notes)
