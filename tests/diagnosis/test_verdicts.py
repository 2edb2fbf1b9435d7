"""The verdict against the errors that stand beside it, and what a record is blind to."""

import functools
import itertools
import math

import numpy as np
import pytest
import scipy

import autotuner
from autotuner import Recording, diagnose
from autotuner.core.diagnosis.findings.judgement import verdict_of
from autotuner.core.diagnosis.findings.result import FoundEffect, Misfit
from autotuner.core.diagnosis.record.parts import parts_of
from autotuner_sim import Backlash, DirectionGain, Overflow
from tests.diagnosis.cases import PLANTS, tuning_record

EFFECT = FoundEffect("backlash", "actuator", {"width": 1.0}, {}, 0.9)
SIGMAS = (0.9, 1.4, 1.6, 1.9, 2.1, 13.0)


def errors(fitted, selection):
    return {"fitted": Misfit(*fitted, 1.0, 1.0), "selection": Misfit(*selection, 1.0, 1.0)}


def test_what_is_called_adequate_is_small_everywhere():
    """Nothing beside the word contradicts it: 1.5 noise sigmas where it was fitted, 2 where it was not."""
    for figures in itertools.product(SIGMAS, repeat=4):
        fitted, other = figures[:2], figures[2:]
        verdict = verdict_of((), errors(fitted, other), ())
        small_after = fitted[1] < 1.5 and other[1] <= 2.0
        small_before = fitted[0] < 1.5 and other[0] <= 2.0
        assert (verdict == "adequate") == (small_after and small_before)
        assert (verdict == "unexplained") == (not small_after)


@pytest.mark.parametrize(
    ("selection_after", "expected"), [(0.9, "explained"), (2.1, "partly_explained"), (9.0, "partly_explained")]
)
def test_effects_that_leave_much_on_the_other_part_are_hypotheses(selection_after, expected):
    """However large the fall: 14 to 2.1 sigmas is no explanation."""
    assert verdict_of((EFFECT,), errors((9.0, 1.0), (14.0, selection_after)), ()) == expected


def test_effects_that_help_little_leave_the_record_unexplained():
    assert verdict_of((EFFECT,), errors((9.0, 8.0), (14.0, 13.0)), ()) == "unexplained"


def test_a_doubt_makes_effects_hypotheses_however_little_they_leave():
    assert verdict_of((EFFECT,), errors((9.0, 1.0), (14.0, 1.0)), ("a doubt",)) == "partly_explained"


def test_effects_that_only_the_other_part_shows_are_hypotheses_and_no_riddle():
    """Where it was fitted, there was nothing to explain."""
    assert verdict_of((EFFECT,), errors((1.0, 0.9), (6.0, 1.0)), ("a doubt",)) == "partly_explained"
    assert verdict_of((EFFECT,), errors((3.0, 2.9), (6.0, 1.0)), ("a doubt",)) == "unexplained"


def steps(sigma=0.02, levels=(0.0, 10.0, 3.0, -6.0, 0.0, 5.0)):
    """Steps behind a lag of 5 s, gain 2, each until it has settled."""
    output = np.repeat(levels, 60)
    pv = np.zeros(output.size)
    for k in range(1, output.size):
        pv[k] = pv[k - 1] - np.expm1(-0.2) * (2.0 * output[k - 1] - pv[k - 1])
    noise = np.random.default_rng(2).normal(0.0, sigma, pv.size)
    return Recording(np.arange(float(output.size)), 40.0 + output, 80.0 + pv + noise)


@functools.cache
def diagnosed(play=None):
    """Return the diagnosis of a tuning's record, with such a play of the actuator."""
    return diagnose(tuning_record(PLANTS["balanced"], sigma=0.05, actuators=[Backlash(play)] if play else ()))


@pytest.mark.usefixtures("without_gains")
def test_noise_is_that_of_the_closest_explanation(among):
    """A load twice as large as the moves: the process alone errs so quickly that its residual looks twice as noisy."""
    among("load_step")
    sigma, t = 0.04, np.arange(200.0)
    output = np.where(t >= 20.0, np.where(t // 12 % 2 == 0, 2.0, -2.0), 0.0)
    arrived = np.concatenate((np.zeros(6), output))[: t.size] - 8.0 * (t > 100.0)
    pv = scipy.signal.lfilter([0.0, 2.5 * -math.expm1(-0.25)], [1.0, -math.exp(-0.25)], arrived)
    noise = np.random.default_rng(1).normal(0.0, sigma, t.size)
    found = diagnose(Recording(t, 40.0 + output, 80.0 + pv + noise))
    assert [effect.name for effect in found.effects] == ["load_step"]
    assert found.error["fitted"].noise == pytest.approx(sigma, rel=0.2)


def spots(found):
    return " ".join(note for note in found.notes if "blind" in note)


def test_steps_say_how_much_sticking_they_hide():
    """A valve that sticks within less than the smallest step, 5, is where it should be after each."""
    found = diagnose(steps())
    assert found.verdict == "adequate"
    assert "sticking up to" in found.summary
    hidden = float(spots(found).split("sticking up to ")[1].split()[0])
    assert 2.0 < hidden < 6.0


def test_sizes_are_written_as_people_write_them():
    """Moves twenty times as fast leave rate limits of some hundreds a second open."""
    slow = steps()
    words = spots(diagnose(Recording(slow.t / 20.0, slow.output, slow.pv)))
    rate = words.split("rate limits above ")[1].split()[0]
    assert rate.isdigit()
    assert 100 < int(rate) < 1000


def test_every_record_says_how_far_it_reached():
    assert "limits beyond what it reached (output 34 to 50, PV 6" in spots(diagnose(steps()))


def test_a_staircase_shows_much_smaller_friction_than_steps_do():
    found = diagnosed()
    assert found.verdict == "adequate"
    assert "play up to" not in found.summary


@pytest.mark.long  # the worn valve (tests/reports) is found in a whole tuning
def test_friction_that_was_found_is_no_blind_spot():
    found = diagnosed(play=2.0)
    assert [effect.name for effect in found.effects] == ["backlash"]
    assert "play" not in spots(found)


@pytest.mark.long  # what an adequate record leaves is in the first test
@pytest.mark.usefixtures("without_gains")
def test_a_limit_that_shows_at_the_end_only_is_never_called_adequate(among):
    """Too late in the record to be named: the verdict says that something is missing, a note where."""
    among("state_saturation", "saturation", "load_step")
    clean = tuning_record(PLANTS["lag"])
    fitted = clean.t < clean.settings["segments"]["tail"]
    limit = (clean.pv[fitted].max() + clean.pv[: parts_of(clean).tested.start].max()) / 2.0 - 100.0
    found = diagnose(tuning_record(PLANTS["lag"], bounds=[Overflow(limit)], step_s=0.05))
    assert found.verdict == "unexplained"
    assert any("on the test part" in note for note in found.notes)


def test_gains_are_shown_on_the_loop_with_the_effect():
    """Both gains meet the play that was found; a clean record has one set of gains and nothing to foresee."""
    gains = diagnosed(play=2.0).gains
    for when in ("before", "after"):
        assert gains[when]["with_effects"]["effects"] == ["backlash"]
        assert np.isfinite(gains[when]["with_effects"]["settling_time_s"])
        assert gains[when]["goal"] == "balanced"
    assert gains["calmer"]["goal"] == "calm"
    assert gains["calmer"]["with_effects"]["cost"] < gains["after"]["with_effects"]["cost"]
    clean = diagnosed().gains
    assert clean["before"] == clean["after"]
    assert "with_effects" not in clean["after"]


@pytest.mark.long  # by hand in test_gains_compared
def test_gains_for_two_directions_are_those_for_the_stronger_one(among):
    among("direction_gain", "static_nonlinearity", "saturation")
    found = diagnose(tuning_record(PLANTS["balanced"], sigma=0.05, actuators=[DirectionGain(1.8)]))
    assert [effect.name for effect in found.effects] == ["direction_gain"]
    weaker = autotuner.design(found.process, "balanced")
    assert found.gains["after"]["gains"]["Kp"] == pytest.approx(weaker.gains.Kp / 1.8, rel=0.1)
