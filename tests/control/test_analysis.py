"""A model that does not explain its record gets no gains, unless a named effect beside it does."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from autotuner.application.analysis.parts_of_record import hold_on_parts, undisturbed
from autotuner.application.analysis.procedure import analyse, identified
from autotuner.core.design import DesignSpec, design
from autotuner.core.identification import identify
from autotuner.core.identification.held_out import HeldOut
from autotuner.core.recording import Recording
from autotuner_sim import Fopdt


@pytest.fixture
def recording(rig, virtual):
    """The record of a tuning of the plant K 2, T 10 s, D 1.5 s; its relay part is that before `half_relay`."""
    one = rig()
    virtual(one.conduct())
    return one.tuning.recording()


@pytest.mark.long  # `tune` in tests/cli shows the same
def test_a_model_that_explains_its_record_gets_gains(recording):
    analysis = analyse(recording)
    assert analysis.verdict.code == "identified"
    assert analysis.gains is not None
    assert analysis.diagnosis.gains["before"]["gains"] == analysis.gains.gains.to_dict()


@pytest.mark.parametrize(("held_out", "alone", "asks"), [(0.05, True, False), (0.5, True, True), (0.05, False, True)])
def test_a_disturbance_beside_a_model_that_leaves_noise_asks_for_nothing(recording, held_out, alone, asks):
    """The errors are those of a model on the part not fitted, with noise of 0.05."""
    named = SimpleNamespace(
        verdict="explained",
        summary="a wave",
        effects=(SimpleNamespace(name="wave", advice="look"),),
        disturbances_alone=alone,
        error={"held_out": SimpleNamespace(before=1.0, after=0.1)},
    )
    analysis = replace(identified(recording), diagnosis=named, error=HeldOut(0.05, held_out, 0.05, 5.0))
    assert any("a wave" in message for message in analysis.messages)
    assert any("a wave" in warning for warning in analysis.warnings) is asks


@pytest.mark.one_of(2)
@pytest.mark.parametrize("left", [0.15, -0.15])
def test_what_is_left_of_an_earlier_motion_does_not_shift_the_gain(recording, left):
    """Three sigma of the noise that fade with the process's own lag; the relay part alone takes them for 11 % of K."""
    fading = left * np.exp(-recording.t / 10.0)
    spoiled = Recording(recording.t, recording.output, recording.pv + fading, settings=recording.settings)
    analysis = identified(spoiled, "fopdt")
    low, high = analysis.identification.estimates["least_squares"].interval95["K"]
    assert low < 2.0 < high
    assert high - low < 0.1
    assert analysis.warnings == ()


@pytest.mark.long  # the next two effects show the same
def test_a_record_in_which_something_else_swung_the_pv_gets_the_gains_of_the_process_beside_it(recording):
    """A load as large as the relay's own, with a period that is not the relay's."""
    load = 6.0 * np.sin(2.0 * np.pi * recording.t / 23.0)
    spoiled = Recording(recording.t, recording.output, recording.pv + load, settings=recording.settings)
    analysis = analyse(spoiled)
    (effect,) = analysis.diagnosis.effects
    assert effect.name == "periodic_disturbance"
    assert effect.parameters == pytest.approx({"period_s": 23.0, "amplitude": 6.0}, rel=0.01)
    assert analysis.identification.recommended == "diagnosis"
    assert analysis.identification.model.parameters() == pytest.approx({"K": 2.0, "T": 10.0, "D": 1.5}, rel=0.02)


@pytest.mark.parametrize(("size", "share"), [(4.0, 0.15), pytest.param(-3.0, 0.3, marks=pytest.mark.long)])
def test_a_load_step_in_mid_experiment_costs_the_stretch_before_it_only(recording, size, share):
    """A load at the output of the process, through a lag of its own: 3 s."""
    begin, end = recording.settings["segments"]["relay"], recording.settings["segments"]["tail"]
    since = np.maximum(recording.t - begin - share * (end - begin), 0.0)
    spoiled = replace(recording, pv=recording.pv + size * (1.0 - np.exp(-since / 3.0)))
    found, error = undisturbed(spoiled, "auto", identify(spoiled))
    assert largest_sensitivity(Fopdt(2.0, 10.0, 1.5), design(found.model).gains) == pytest.approx(1.4, abs=0.04)
    assert error.held_out < 2.0 * error.noise_sigma


@pytest.mark.long  # tests/core/test_late_load has its size and moment
def test_a_load_in_the_tail_is_noted_and_asks_for_nothing(recording):
    """A load at the process's input, late in the tail: the answer of K 2, T 10 s to it, in closed form."""
    at_s = recording.t[-1] - 0.4 * (recording.t[-1] - recording.settings["segments"]["tail"])
    load = 6.0 * -np.expm1(-np.maximum(recording.t - at_s, 0.0) / 10.0)
    analysis = analyse(replace(recording, pv=recording.pv + load))
    assert analysis.warnings == ()
    assert any(note.startswith("a load of") for note in analysis.notes)
    assert largest_sensitivity(Fopdt(2.0, 10.0, 1.5), analysis.gains.gains) == pytest.approx(1.4, abs=0.02)


def test_gains_hold_on_parts_only_where_these_are_of_one_process(recording):
    """A check under twice the gain belongs to another process than the relay's: there the gains are near the edge."""
    whole = identify(recording)
    gains = design(whole.model).gains
    assert hold_on_parts(recording, whole, gains, recording.sample_interval_s)
    check = recording.t >= recording.settings["segments"]["half_relay"]
    doubled = np.where(check, 80.0 + 2.0 * (recording.pv - 80.0), recording.pv)
    assert not hold_on_parts(replace(recording, pv=doubled), whole, gains, recording.sample_interval_s)


@pytest.mark.long  # the worn valve of the examples (tests/reports) shows the same
def test_a_record_that_a_named_effect_explains_gets_the_gains_of_the_extended_model(rig, virtual):
    """An actuator that is stuck at 35 and 45: on the relay's record an unstable process looks the same."""
    one = rig(spec=DesignSpec(), device={"effects": [{"effect": "saturation", "low": 35.0, "high": 45.0}]})
    verdict = virtual(one.conduct())
    analysis = one.tuning.analysis
    assert verdict.code == "identified"
    assert [effect.name for effect in analysis.diagnosis.effects] == ["saturation"]
    truth = {"K": 2.0, "T": 10.0, "D": 1.5}
    assert analysis.identification.model.parameters() == pytest.approx(truth, rel=0.02)
    fitted, selection, held = (analysis.diagnosis.error[part] for part in ("fitted", "selection", "held_out"))
    assert max(fitted.after, selection.after) < 1.2 * held.noise
    # The last samples of the tail choose nothing and are few: the stated limit of `explained` is two noise sigmas.
    assert held.after < 2.0 * held.noise < 0.1 * held.before
    assert analysis.error.held_out == held.after
    assert analysis.identification.recommended == "diagnosis"
    assert any("extended model" in warning for warning in analysis.warnings)
    interval = analysis.identification.estimates["diagnosis"].interval95
    assert all(low < high for low, high in interval.values())
    assert f"K {analysis.identification.model.K:.4g}" in verdict.message
    assert analysis.gains.gains.Kp > 0.0
    told = analysis.diagnosis.gains["after"]
    assert told["goal"] == analysis.gains.goal == "balanced"
    assert told["gains"] == analysis.gains.gains.to_dict()  # one design, so one set of numbers


@pytest.mark.long  # the worn valve of the examples (tests/reports), and the test above, show the same
def test_a_model_that_misses_the_check_gives_way_to_the_process_beside_a_named_effect(rig, virtual):
    """Play of 2 in the actuator, declared by nobody: the relay alone shows three times the gain and the lag."""
    one = rig(spec=DesignSpec(), device={"effects": [{"effect": "backlash", "width": 2.0}]})
    verdict = virtual(one.conduct())
    analysis, truth = one.tuning.analysis, {"K": 2.0, "T": 10.0, "D": 1.5}
    assert 2.0 * truth["K"] < analysis.identification.estimates["least_squares"].model.K
    assert [effect.name for effect in analysis.diagnosis.effects] == ["backlash"]
    assert analysis.identification.model.parameters() == pytest.approx(truth, rel=0.03)
    assert f"K {analysis.identification.model.K:.4g}" in verdict.message
    assert analysis.gains.gains.Kp > 0.0
    told = analysis.diagnosis.gains
    assert told["before"]["goal"] == told["after"]["goal"] == analysis.gains.goal == "balanced"
    assert told["after"]["gains"] == analysis.gains.gains.to_dict()  # one design, so one set of numbers


def largest_sensitivity(plant, gains):
    """Return Ms of a loop of the simulator's plant, by its transfer function."""
    w = np.geomspace(1e-3, 1e2, 20_000)
    s = 1j * w
    controller = (
        gains.Kp * (1.0 + 1.0 / (gains.Ti * s) + gains.Td * s) / (1.0 + gains.Tf * s + (gains.Tf * s) ** 2 / 2.0)
    )
    loop = controller * np.array([plant.transfer(one) for one in s])
    return float(np.max(1.0 / np.abs(1.0 + loop)))


@pytest.mark.long  # the same without the check is shorter
def test_gains_are_for_the_direction_with_the_larger_gain(rig, virtual):
    """Above the rest the actuator moves 2.5 times as far: what is balanced (Ms 1.4) there is calm below."""
    one = rig(spec=DesignSpec(), device={"effects": [{"effect": "direction_gain", "ratio": 2.5}]})
    virtual(one.conduct())
    analysis = one.tuning.analysis
    assert [effect.name for effect in analysis.diagnosis.effects] == ["direction_gain"]
    assert analysis.identification.recommended == "diagnosis"
    assert largest_sensitivity(Fopdt(5.0, 10.0, 1.5), analysis.gains.gains) < 1.45
    assert abs(analysis.identification.model.K - 5.0) < 0.25
    assert any("its gain is the larger one" in warning for warning in analysis.warnings)


@pytest.mark.long  # a record without segments shows the same
def test_a_record_that_no_effect_explains_gets_no_gains(recording):
    """A wandering load as large as the relay's own, seed 5."""
    wander = np.cumsum(np.random.default_rng(5).normal(size=recording.t.size))
    load = 6.0 * wander / np.std(wander)
    spoiled = Recording(recording.t, recording.output, recording.pv + load, settings=recording.settings)
    analysis = analyse(spoiled)
    assert analysis.verdict.code != "identified"
    assert analysis.gains is None
    assert analysis.verdict.remedy


def test_without_the_check_the_record_itself_is_judged(recording):
    load = 6.0 * np.sin(2.0 * np.pi * recording.t / 23.0)
    analysis = analyse(Recording(recording.t, recording.output, recording.pv + load))
    assert analysis.verdict.code != "identified"
    assert analysis.gains is None
    assert analysis.verdict.remedy


def test_a_model_that_runs_away_misses_by_no_absurd_number():
    assert "misses by 0.5, 10.0 times the noise" in HeldOut(0.1, 0.5, 0.05).warning
    assert "misses by over 10000 times the noise" in HeldOut(0.1, 2.84e32, 0.05).warning


def test_a_model_whose_gain_is_against_the_action_gets_no_gains(recording):
    """The PV was seen to rise with the output; a record turned round afterwards can only be of something else."""
    turned = Recording(recording.t, recording.output, recording.pv, settings={**recording.settings, "direct": False})
    analysis = analyse(turned)
    assert analysis.verdict.code == "record_unexplained"
    assert "other way" in analysis.verdict.message
    assert analysis.gains is None


@pytest.mark.long  # with the check, the worn valve of the examples (tests/reports) shows the same
def test_without_the_check_the_diagnosed_process_is_taken_too(rig, virtual):
    """The plain model is bent by the effect, and only what the diagnosis held out says so."""
    one = rig(
        spec=DesignSpec(), relay={"check": False}, device={"effects": [{"effect": "direction_gain", "ratio": 2.5}]}
    )
    virtual(one.conduct())
    analysis = one.tuning.analysis
    assert analysis.error is None
    assert [effect.name for effect in analysis.diagnosis.effects] == ["direction_gain"]
    assert analysis.identification.recommended == "diagnosis"
    assert abs(analysis.identification.model.K - 5.0) < 0.25
    for words in ("check was left out", "its gain is the larger one"):
        assert any(words in warning for warning in analysis.warnings)
    assert largest_sensitivity(Fopdt(5.0, 10.0, 1.5), analysis.gains.gains) < 1.45
