"""Gains before and after, the intervals of a coarse sensor, and what a record hides, by closed forms."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotuner import Recording
from autotuner.core.design.gains import PidGains
from autotuner.core.diagnosis.extended.extended_model import Extended
from autotuner.core.diagnosis.extended.fit_context import bench_of, thinned
from autotuner.core.diagnosis.extended.fitting import fit
from autotuner.core.diagnosis.findings.gain_comparison import (
    NOMINAL,
    Design,
    Known,
    both_gains,
    calmer_note,
    lasts_s,
    missing_note,
    no_design_note,
)
from autotuner.core.diagnosis.findings.result import FoundEffect
from autotuner.core.diagnosis.findings.sensor_effects import outside_free
from autotuner.core.diagnosis.record.budget import UNLIMITED, Budget
from autotuner.core.diagnosis.record.dataset import dataset_of
from autotuner.core.diagnosis.record.sensor import Grid
from autotuner.core.diagnosis.search.detectability import blind_spots
from autotuner.core.model.process import Fopdt, Integrating, SopdtOverdamped, SopdtUnderdamped
from autotuner.core.model.structures import FOPDT, PURE_INTEGRATOR
from autotuner.errors import InputError

PLANT = Fopdt(2.0, 10.0, 4.0)
PLAY = FoundEffect("backlash", "actuator", {"width": 2.0}, {}, 1.0)
LOAD = FoundEffect("load_step", "disturbance", {"size": 2.0, "at_s": 50.0}, {}, 1.0)


def steps(levels=(0.0, 10.0, 3.0, -6.0, 0.0, 5.0), sigma=0.02, lag_s=5.0, gain=2.0, of_output=1.0, each=40):
    """Steps behind a lag, of `each` seconds."""
    output = np.repeat(levels, each)
    pv = np.zeros(output.size)
    for k in range(1, output.size):
        pv[k] = pv[k - 1] - np.expm1(-1.0 / lag_s) * (gain * output[k - 1] - pv[k - 1])
    noise = np.random.default_rng(2).normal(0.0, sigma, pv.size)
    return Recording(np.arange(float(output.size)), of_output * (40.0 + output), 80.0 + pv + noise)


DATASET = dataset_of(steps())


# ------------------------------------------------------------------------------------------------------------- gains


def by_lambda(factor=1.0, calmer=None):
    """The lambda rule, T/(K (lambda + D)) with lambda = factor T, as the design that is asked for."""

    def choose(model, _covariance):
        return PidGains(model.T / (model.K * (factor * model.T + model.D)), model.T)

    return Design(f"lambda {factor:g}", choose, calmer)


def kp_of(told, when):
    return told[when]["gains"]["Kp"]


def test_a_record_without_effects_has_one_set_of_gains():
    told = both_gains(Known(PLANT), Known(PLANT), (), DATASET, by_lambda())
    assert told["before"] == told["after"]
    assert set(told) == {"before", "after"}
    assert kp_of(told, "after") == pytest.approx(10.0 / (2.0 * 14.0))
    assert "with_effects" not in told["after"]
    assert told["after"]["goal"] == "lambda 1"


def test_before_and_after_are_of_the_same_design():
    wrong = Fopdt(1.0, 20.0, 6.0)
    told = both_gains(Known(wrong), Known(PLANT), (LOAD,), DATASET, by_lambda())
    assert kp_of(told, "before") == pytest.approx(20.0 / 26.0)
    assert kp_of(told, "after") == pytest.approx(10.0 / 28.0)
    assert "with_effects" not in told["before"]  # a load that came once is nothing to foresee


@pytest.mark.parametrize(("ratio", "kp"), [(2.5, 10.0 / (5.0 * 14.0)), (0.4, 10.0 / (2.0 * 14.0))])
def test_gains_after_are_for_the_stronger_direction(ratio, kp):
    effect = FoundEffect("direction_gain", "actuator", {"ratio": ratio}, {}, 1.0)
    assert kp_of(both_gains(Known(PLANT), Known(PLANT), (effect,), DATASET, by_lambda()), "after") == pytest.approx(kp)


def test_a_zero_that_no_model_holds_leaves_no_gains_after():
    effect = FoundEffect("inverse_response", "process", {"Z": -3.0}, {}, 1.0)
    told = both_gains(Known(PLANT), Known(PLANT), (effect,), DATASET, by_lambda())
    assert told["after"] is None
    assert kp_of(told, "before") == pytest.approx(10.0 / 28.0)


@pytest.mark.parametrize("error", [InputError("no gains", field="T", value=1.0, remedy="None."), ZeroDivisionError()])
def test_a_design_that_fails_gives_no_gains(error):
    def choose(_model, _covariance):
        raise error

    assert both_gains(Known(PLANT), Known(PLANT), (), DATASET, Design("none", choose)) == {
        "before": None,
        "after": None,
    }


def test_both_gains_meet_the_play_in_steps_of_a_share_of_the_swing():
    """The swing is 16 of output: steps of 0.3 of it, and of the set point by that times the gain."""
    told = both_gains(Known(Fopdt(1.0, 20.0, 6.0)), Known(PLANT), (PLAY,), DATASET, by_lambda())
    for when in ("before", "after"):
        met = told[when]["with_effects"]
        assert met["effects"] == ["backlash"]
        assert met["load_step"] == pytest.approx(4.8)
        assert met["set_point_step"] == pytest.approx(9.6)
        assert met["cost"] > met["cycle"] >= 0.0


@pytest.mark.parametrize(("asked", "calm", "reported"), [(-0.1, 0.8, True), (1.0, 30.0, False)])
def test_calmer_gains_are_told_where_they_cost_less(asked, calm, reported):
    """A phase margin of 14 degrees swings on; a loop thirty times slower than the process takes for ever."""
    design = by_lambda(asked, by_lambda(calm))
    told = both_gains(Known(PLANT), Known(PLANT), (PLAY,), DATASET, design)
    assert ("calmer" in told) is reported
    if reported:
        assert told["calmer"]["with_effects"]["cost"] < told["after"]["with_effects"]["cost"]
        (words,) = calmer_note(told)
        assert words.startswith("with backlash in the loop, gains of the goal lambda 0.8 cost less")
        assert f"Kp {10.0 / (2.0 * 12.0):.4g}, Ti 10" in words
    else:
        assert calmer_note(told) == []


def test_a_process_without_gains_says_so():
    """A second way has a time constant of its own, and no model of ours holds that."""
    second = FoundEffect("inverse_response", "process", {"time_constant_s": 3.0, "share_against": 0.3}, {}, 1.0)
    shown = both_gains(Known(PLANT), Known(PLANT), (second,), DATASET)
    assert shown["after"] is None
    (words,) = missing_note(shown, (second,))
    assert words.startswith("no gains after: none can be computed for a process with inverse_response")
    assert missing_note(both_gains(Known(PLANT), Known(PLANT), (PLAY,), DATASET), (PLAY,)) == []
    assert missing_note({"before": None, "after": None}, (second,)) == []
    assert missing_note(shown, ()) == []


@pytest.mark.parametrize("model", [Fopdt(2.0, 10.0, 0.0), Integrating(0.001, 0.0, 0.0)])
def test_a_process_without_dead_time_says_why_it_has_no_gains(model):
    quick = Known(model)
    shown = both_gains(quick, quick, (), DATASET)
    assert shown == {"before": None, "after": None}
    (words,) = no_design_note(shown, quick, NOMINAL)
    assert "nothing limits the gain" in words
    assert no_design_note(both_gains(Known(PLANT), Known(PLANT), (), DATASET), Known(PLANT), NOMINAL) == []


def test_an_error_of_arithmetic_is_no_reason_that_a_reader_gets():
    def choose(_model, _covariance):
        raise ZeroDivisionError("float division by zero")

    (words,) = no_design_note({"before": None, "after": None}, Known(PLANT), Design("none", choose))
    assert words.startswith("no gains: the design has no solution for this process")


@pytest.mark.parametrize(("model", "expected"), [
    (Fopdt(2.0, 10.0, 4.0), 25.0 * 14.0),
    (SopdtOverdamped(2.0, 10.0, 5.0, 1.0), 25.0 * 16.0),
    (SopdtUnderdamped(2.0, 100.0, 4.0, 1.0), 25.0 * 5.0),
])  # fmt: skip
def test_a_response_lasts_25_answer_times(model, expected):
    assert lasts_s(model) == pytest.approx(expected)


@pytest.mark.parametrize("lag_s", [0.0, 0.2, 6.0])
def test_the_length_of_a_response_scales_with_the_time_of_an_integrating_process(lag_s):
    """The same process in hours: `K e^{-Ds}/(s (T s + 1))` with K per hour."""
    in_s, in_h = Integrating(0.05, lag_s, 2.0), Integrating(180.0, lag_s / 3600.0, 2.0 / 3600.0)
    assert lasts_s(in_s) == pytest.approx(3600.0 * lasts_s(in_h))
    assert lasts_s(in_s) == pytest.approx(25.0 * (5.0 * max(2.0, lag_s) + 2.0))


# ---------------------------------------------------------------------------------------------------- coarse readings


@given(st.floats(0.01, 10.0), st.floats(-50.0, 50.0))
@settings(max_examples=60, deadline=None)
def test_a_reading_moves_towards_the_model_by_half_a_step_at_most(step, off):
    moved = float(outside_free(np.array([off]), Grid(step, step / 2.0, rounded=True))[0])
    assert abs(moved) <= step / 2.0
    assert abs(off) - abs(moved) == pytest.approx(max(abs(off) - step / 2.0, 0.0), abs=1e-12)
    assert moved * off >= 0.0


# --------------------------------------------------------------------------------------------------- budget, thinning


def test_a_budget_is_spent_when_it_says_so_and_passes_words_on():
    said, spent = [], [False, True]
    budget = Budget(lambda: spent.pop(0), said.append)
    assert [budget.spent, budget.spent] == [False, True]
    budget.report("half way")
    assert said == ["half way"]
    assert not UNLIMITED.spent
    UNLIMITED.report("nobody hears")


@given(st.integers(1, 500), st.integers(2, 100))
@settings(max_examples=60, deadline=None)
def test_thinned_rows_keep_both_ends_and_are_even(count, most):
    rows = 7 + 3 * np.arange(count)
    picked = thinned(rows, most)
    assert picked.size == min(count, most)
    assert set(picked) <= set(rows)
    assert (picked[0], picked[-1]) == (rows[0], rows[-1])
    if picked.size > 1:
        assert np.ptp(np.diff(picked)) <= 3 * 1


# -------------------------------------------------------------------------------------------------------- blind spots


def spots_of(recording, noise=0.02):
    dataset = dataset_of(recording)
    context = bench_of(dataset)
    lag = fit(Extended(dataset, FOPDT, (), context.coarse), np.array([math.log(5.0), 0.0]))
    assert lag.rms < 0.05
    return blind_spots(context, lag, noise)


def size_of(spots, words):
    said = next((spot.words for spot in spots if spot.words.startswith(words)), None)
    return 0.0 if said is None else float(said.removeprefix(words).split()[0])


@pytest.mark.parametrize("words", ["play up to", "sticking up to", "steps of the actuator up to"])
def test_more_noise_hides_larger_effects(words):
    sizes = [size_of(spots_of(steps(), noise), words) for noise in (0.02, 0.5, 3.0)]
    assert sizes == sorted(sizes)
    assert sizes[0] < sizes[-1] or (words.startswith("sticking") and sizes[0] > 5.0)  # the smallest step hides as much


def test_a_slow_mode_hides_in_quick_moves_and_shows_where_the_output_is_held():
    """Moves back and forth average to nothing over the ten lags that a slow mode takes."""
    held, quick = steps((0.0, 10.0, 3.0, -6.0), each=150), steps((0.0, *(8.0, -8.0) * 20), each=15)
    shown, hidden = (size_of(spots_of(r, 0.1), "slow modes of some 50 s up to") for r in (held, quick))
    assert 0.0 < shown < 5.0
    assert hidden > 20.0


def test_a_process_that_integrates_hides_no_share_of_a_gain():
    recording = steps()
    level = np.cumsum(recording.output - 40.0) / 20.0
    noise = np.random.default_rng(3).normal(0.0, 0.02, level.size)
    dataset = dataset_of(Recording(recording.t, recording.output, 80.0 + level + noise))
    context = bench_of(dataset)
    start = np.zeros(len(PURE_INTEGRATOR.shape) + 1)
    spots = blind_spots(context, fit(Extended(dataset, PURE_INTEGRATOR, (), context.coarse), start), 0.02)
    assert not any("slow modes" in spot.words for spot in spots)


def test_hidden_sizes_are_in_the_units_of_the_output():
    """The same record with an output of 0 to 1: a hundredth of the play."""
    one, other = spots_of(steps(), 0.5), spots_of(steps(of_output=0.01), 0.5)
    for words in ("play up to", "sticking up to", "steps of the actuator up to"):
        assert size_of(other, words) == pytest.approx(0.01 * size_of(one, words), rel=0.02)


def test_an_output_that_never_turns_shows_no_friction():
    words = [spot.words for spot in spots_of(steps((0.0, 2.0, 4.0, 6.0, 8.0, 10.0)))]
    assert words[0].startswith("play, sticking and other friction")
    assert not any(w.startswith("play up to") for w in words)


@pytest.mark.parametrize(("levels", "told"), [((0.0, 8.0, -8.0, 8.0, -8.0, 0.0), True), ((0.0, 8.0, -8.0, 4.0), False)])
def test_an_output_of_three_levels_shows_no_curve(levels, told):
    assert any("too few levels" in spot.words and spot.grave for spot in spots_of(steps(levels))) is told


def test_what_was_reached_comes_last():
    record = steps()
    spots = spots_of(record)
    assert [spot.grave for spot in spots] == sorted((spot.grave for spot in spots), reverse=True)
    reached = f"output 34 to 50, PV {min(record.pv):.4g} to {max(record.pv):.4g}"
    assert spots[-1].words == f"limits beyond what it reached ({reached})"
