"""Every rule of the verdict, of the doubts and of the evidence at, below and above its bound; no record is searched."""

import json
import math
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy
from hypothesis import given, settings
from hypothesis import strategies as st

from autotuner.core.diagnosis.findings.advice import REMEDIES, remedy, separating
from autotuner.core.diagnosis.findings.doubts import doubts_about, doubts_about_errors, doubts_about_process
from autotuner.core.diagnosis.findings.judgement import verdict_of
from autotuner.core.diagnosis.findings.result import Diagnosis, FoundEffect, Misfit
from autotuner.core.diagnosis.procedure import _is_as_good_later
from autotuner.core.diagnosis.search.judge import Evidence, is_helpful, is_shown, is_supported
from autotuner.core.model.process import Fopdt, SopdtOverdamped, SopdtUnderdamped

PLAY = FoundEffect("backlash", "actuator", {"width": 2.0}, {"width": (1.5, 2.5)}, 0.9)
DRIFT = FoundEffect("drift", "disturbance", {"pv_per_s": 0.1}, {}, 0.9)


def errors(fitted, selection, expected=1.0, scale=1.0):
    def misfit(before, after):
        return Misfit(scale * before, scale * after, scale * 0.9, scale * expected)

    return {"fitted": misfit(*fitted), "selection": misfit(*selection)}


# ----------------------------------------------------------------------------------------------------------- verdict


@pytest.mark.parametrize(("fitted", "selection", "has_memory", "expected"), [
    (1.49, 1.0, False, "adequate"),
    (1.5, 1.0, False, "unexplained"),  # visible from 1.5 on
    (1.49, 2.0, False, "adequate"),  # up to 2
    (1.49, 2.01, False, "unexplained"),
    (1.49, 3.0, True, "adequate"),  # a short part has a few swings of a noise with memory
    (1.49, 3.01, True, "unexplained"),
    (1.5, 1.0, True, "unexplained"),
    (math.nan, 1.0, False, "unexplained"),
])  # fmt: skip
def test_a_model_alone_at_its_bounds(fitted, selection, has_memory, expected):
    at = errors((fitted, fitted), (selection, selection))
    assert verdict_of((), at, (), has_memory=has_memory) == expected


@pytest.mark.parametrize(("fitted", "expected"), [(1.49, "adequate"), (1.5, "unexplained")])
def test_an_error_of_the_numbers_themselves_makes_no_model_alone_inadequate(fitted, expected):
    at = errors((fitted, fitted), (5.0, 5.0))
    assert verdict_of((), at, (), foreseen=True) == expected
    assert verdict_of((), at, ()) == "unexplained"
    assert verdict_of((PLAY,), at, (), foreseen=True) != "explained"


@pytest.mark.parametrize(("fitted", "selection", "expected"), [
    ((1.5, 1.0), (1.0, 1.0), "explained"),  # other values of the declared model
    ((1.49, 1.0), (2.01, 1.0), "explained"),
    ((1.49, 1.0), (2.0, 1.0), "adequate"),
])  # fmt: skip
def test_other_values_of_the_same_model_explain_what_the_declared_ones_did_not(fitted, selection, expected):
    assert verdict_of((), errors(fitted, selection), ()) == expected


@pytest.mark.parametrize(("fitted", "selection", "expected"), [
    ((9.0, 2.0), (9.0, 2.0), "explained"),
    ((9.0, 2.01), (9.0, 1.0), "partly_explained"),
    ((9.0, 1.0), (9.0, 2.01), "partly_explained"),
    ((10.0, 6.99), (10.0, 6.99), "partly_explained"),  # less than 0.7 on both
    ((10.0, 7.0), (10.0, 6.99), "unexplained"),
    ((10.0, 6.99), (10.0, 7.0), "unexplained"),
])  # fmt: skip
def test_effects_at_their_bounds(fitted, selection, expected):
    assert verdict_of((PLAY,), errors(fitted, selection), ()) == expected


def test_memory_excuses_no_effects():
    assert verdict_of((PLAY,), errors((9.0, 1.0), (9.0, 2.5)), (), has_memory=True) == "partly_explained"


@pytest.mark.parametrize(
    ("selection_after", "expected"), [(2.01, "explained"), (4.0, "explained"), (4.1, "partly_explained")]
)
def test_what_is_expected_counts_and_not_the_noise(selection_after, expected):
    """Uneven sampling doubles what a perfect model leaves; the noise is 0.9 as before."""
    assert verdict_of((PLAY,), errors((9.0, 1.0), (9.0, selection_after), expected=2.0), ()) == expected


FIGURES = st.floats(0.1, 20.0)


@given(FIGURES, FIGURES, FIGURES, FIGURES, st.floats(1e-6, 1e6), st.booleans(), st.booleans(), st.booleans())
@settings(max_examples=200, deadline=None)
def test_the_verdict_is_the_same_in_other_units(a, b, c, d, scale, named, doubted, has_memory):
    effects, doubts = (PLAY,) if named else (), ("a doubt",) if doubted else ()
    one, other = (
        verdict_of(effects, errors((a, b), (c, d), scale=s), doubts, has_memory=has_memory) for s in (1.0, scale)
    )
    near = [abs(x / bound - 1.0) < 1e-9 for x in (a, b, c, d) for bound in (1.5, 2.0, 3.0)]
    near += [abs(after / before / 0.7 - 1.0) < 1e-9 for before, after in ((a, b), (c, d))]
    assert one == other or any(near)


@given(FIGURES, FIGURES, FIGURES, FIGURES, st.floats(0.0, 1.0))
@settings(max_examples=200, deadline=None)
def test_a_smaller_error_never_makes_the_verdict_worse(a, b, c, d, share):
    rank = ["unexplained", "partly_explained", "explained"]
    worse = verdict_of((PLAY,), errors((a, b), (c, d)), ())
    better = verdict_of((PLAY,), errors((a, share * b), (c, share * d)), ())
    assert rank.index(better) >= rank.index(worse)


# ------------------------------------------------------------------------------------------------------------ doubts


@pytest.mark.parametrize(("confidence", "at_its_place", "in_loop", "doubts"), [
    (0.55, None, False, 1), (0.56, None, False, 0), (0.56, None, True, 0),
    (0.41, 0.56, False, 0), (0.41, 0.55, False, 1), (0.39, 0.99, False, 1),
    (0.41, 0.99, True, 1), (0.56, 0.56, True, 0),
])  # fmt: skip
def test_confidence_at_its_bounds(confidence, at_its_place, in_loop, doubts):
    """More than 55 % at its place, at least 40 % alone; in a loop alone."""
    effect = replace(PLAY, confidence=confidence, at_its_place=at_its_place)
    assert len(doubts_about((effect,), in_loop=in_loop)) == doubts


@pytest.mark.parametrize(("half", "doubts"), [(0.99, 0), (1.0, 0), (1.01, 1)])
@pytest.mark.parametrize("size", [2.0, -2.0])
def test_a_size_is_bounded_within_half_of_it(size, half, doubts):
    effect = replace(PLAY, parameters={"width": size}, interval95={"width": (size - half, size + half)})
    assert len(doubts_about((effect,))) == doubts


def test_every_effect_is_doubted_on_its_own_and_in_order():
    unsure, unknown = replace(PLAY, confidence=0.2), replace(DRIFT, interval95={"pv_per_s": (-1.0, 1.0)})
    words = doubts_about((unsure, DRIFT, unknown))
    assert [w.split()[0] for w in words] == ["backlash", "drift"]
    assert "20%" in words[0]
    assert "pv_per_s open (-1 to 1)" in words[1]


@given(st.floats(1e-3, 1e3), st.floats(0.01, 3.0))
@settings(max_examples=50, deadline=None)
def test_a_size_in_other_units_is_as_sure(scale, half):
    def doubted(by):
        sizes = {"width": by * 2.0}
        return doubts_about(
            (replace(PLAY, parameters=sizes, interval95={"width": (by * (2 - half), by * (2 + half))}),)
        )

    assert len(doubted(1.0)) == len(doubted(scale)) or abs(half - 1.0) < 1e-9


def of_sigmas(*sigmas):
    return np.diag(np.array(sigmas) ** 2)


@pytest.mark.parametrize(("model", "sigmas", "open_ones"), [
    # A half width of 1.96 sigma, at most half of the value: sigma/value up to 0.5/1.96 = 0.2551.
    (Fopdt(2.0, 6.0, 4.0), (0.255 * 2.0, 0.0, 0.0), []),
    (Fopdt(2.0, 6.0, 4.0), (0.256 * 2.0, 0.0, 0.0), ["gain"]),
    (Fopdt(-2.0, 6.0, 4.0), (0.256 * 2.0, 0.0, 0.0), ["gain"]),
    # T + D = 10 with independent errors of 3-4-5 proportions.
    (Fopdt(2.0, 6.0, 4.0), (0.0, 0.255 * 6.0, 0.255 * 8.0), []),
    (Fopdt(2.0, 6.0, 4.0), (0.0, 0.256 * 6.0, 0.256 * 8.0), ["answer time"]),
    (Fopdt(2.0, 6.0, 4.0), (0.0, 0.0, 2.6), ["answer time"]),  # of which the dead time is a part
    (SopdtOverdamped(2.0, 5.0, 3.0, 2.0), (0.0, 2.0, 2.0, 2.0), ["answer time"]),
    (SopdtOverdamped(2.0, 5.0, 3.0, 2.0), (0.0, 1.4, 1.4, 1.4), []),  # sqrt(3) 1.4 = 2.42 of 10
    # An underdamped one: n alone, whatever m and D are.
    (SopdtUnderdamped(2.0, 9.0, 2.0, 1.0), (0.0, 99.0, 0.255 * 2.0, 99.0), []),
    (SopdtUnderdamped(2.0, 9.0, 2.0, 1.0), (0.6, 0.0, 0.256 * 2.0, 0.0), ["gain", "damping"]),
])  # fmt: skip
def test_the_process_at_its_bounds(model, sigmas, open_ones):
    words = doubts_about_process(model, model, of_sigmas(*sigmas))
    assert [next(w for w in ("gain", "answer time", "damping") if w in said) for said in words] == open_ones


@pytest.mark.parametrize(("before", "after", "expected", "later", "doubts"), [
    (1.0, 1.5, 1.0, 2.0, 0),  # up to 1.5 times what is expected nothing is visible
    (1.0, 1.51, 1.0, 2.0, 1),
    (3.0, 3.0, 1.0, 2.0, 0),
    (3.0, 3.01, 1.0, 2.0, 1),
    (3.0, 1.0, 1.0, 2.01, 1),
    (1.0, 1.51, 1.0, 2.01, 2),
    (1.0, 1.51, 1.1, 2.01, 0),
])  # fmt: skip
def test_the_errors_at_their_bounds(before, after, expected, later, doubts):
    parts = Misfit(before, after, 0.9, expected), Misfit(before, later, 0.9, expected)
    assert len(doubts_about_errors(*parts)) == doubts


def test_the_growth_of_the_error_is_said():
    (words,) = doubts_about_errors(Misfit(9.0, 1.0, 0.5, 0.5), Misfit(9.0, 1.85, 0.5, 0.5))
    assert "3.7 times" in words


# ---------------------------------------------------------------------------------------------------------- evidence

GOOD = Evidence(gain=20.0, held_out_ratio=0.5, held_out_z=2.0, share=0.8, fall=0.5)
WEAK = replace(GOOD, gain=14.0, held_out_ratio=0.72, held_out_z=2.4)


@pytest.mark.parametrize(("evidence", "expected"), [
    (GOOD, True),
    (replace(GOOD, share=0.45), False), (replace(GOOD, share=0.46), True),
    (replace(GOOD, fall=0.06), False), (replace(GOOD, fall=0.061), True),
    (replace(GOOD, held_out_ratio=0.75, held_out_z=1.6), False),
    (replace(GOOD, held_out_ratio=0.749, held_out_z=-3.0), True),
    (replace(GOOD, held_out_ratio=0.99, held_out_z=1.61), True),
    (WEAK, False), (replace(WEAK, gain=14.1), True),
    (replace(WEAK, held_out_ratio=0.49, held_out_z=1.61), True),  # confirmed where nothing was fitted
    (replace(WEAK, held_out_ratio=0.51, held_out_z=1.61), False),
    (replace(WEAK, held_out_ratio=0.69, held_out_z=2.51), True),
    (replace(WEAK, held_out_ratio=0.71, held_out_z=2.51), False),
    (replace(WEAK, held_out_ratio=0.49, held_out_z=1.61, gain=0.0), False),  # the criterion has to allow it
    (replace(WEAK, held_out_ratio=0.49, held_out_z=1.61, gain=0.1), True),
    (replace(GOOD, held_out_ratio=1.0, held_out_z=0.0, quiet=True, gain=60.0), False),
    (replace(GOOD, held_out_ratio=1.0, held_out_z=0.0, quiet=True, gain=60.1), True),
    (replace(GOOD, held_out_ratio=1.0, held_out_z=0.0, quiet=False, gain=60.1), False),
])  # fmt: skip
def test_the_first_effect_at_its_bounds(evidence, expected):
    assert is_supported(evidence, first=True, seen_held_out=True) is expected


@pytest.mark.parametrize(("share", "expected"), [(0.6, False), (0.61, True)])
def test_a_further_effect_has_to_explain_more(share, expected):
    assert is_supported(replace(GOOD, share=share), first=False, seen_held_out=True) is expected


@pytest.mark.parametrize(("ratio", "expected"), [(1.49, True), (1.5, False)])
def test_what_cannot_be_seen_on_the_other_part_may_not_make_it_worse(ratio, expected):
    unseen = replace(GOOD, held_out_ratio=ratio, held_out_z=-5.0)
    assert is_supported(unseen, first=True, seen_held_out=False) is expected
    assert not is_supported(unseen, first=True, seen_held_out=True)


def test_what_cannot_be_seen_there_is_not_confirmed_there():
    assert not is_supported(replace(WEAK, held_out_ratio=0.3, held_out_z=9.0), first=True, seen_held_out=False)


@pytest.mark.parametrize(("evidence", "expected"), [
    (replace(GOOD, held_out_ratio=0.79), True), (replace(GOOD, held_out_ratio=0.8), False),
    (replace(GOOD, gain=60.1, held_out_ratio=0.99), True), (replace(GOOD, gain=60.1, held_out_ratio=1.0), False),
    (replace(GOOD, gain=60.0, held_out_ratio=0.99), False),
    (replace(GOOD, gain=14.0, held_out_ratio=0.75, held_out_z=1.0), False),
    (replace(GOOD, gain=0.0, held_out_ratio=0.45, held_out_z=1.7), True),
    (replace(GOOD, fall=0.05), False),
    (replace(GOOD, share=0.0), True),  # a measured disturbance need not explain much
])  # fmt: skip
def test_a_measured_disturbance_at_its_bounds(evidence, expected):
    assert is_helpful(evidence) is expected


def test_a_fall_of_rounding_is_none():
    assert is_shown(1.0, 1.0 - 1.1e-5)
    assert not is_shown(1.0, 1.0 - 0.9e-5)
    assert not is_shown(0.0, 0.0)
    assert not is_shown(1.0, 2.0)


# ----------------------------------------------------------------------------------------------------- result, advice


def diagnosis(*effects, **told):
    return Diagnosis("adequate", effects, None, errors((1.0, 1.0), (1.0, 1.0)), {}, {}, (), **told)


def test_disturbances_alone_leave_the_process_known():
    at_first = replace(DRIFT, name="not_settled", place="process")
    assert diagnosis(DRIFT).disturbances_alone
    assert diagnosis(DRIFT, at_first).disturbances_alone
    assert not diagnosis(DRIFT, PLAY).disturbances_alone
    assert not diagnosis().disturbances_alone


@pytest.mark.parametrize("unknown", [math.nan, math.inf, -math.inf])
def test_what_is_not_known_is_no_number_in_json(unknown):
    """JSON has no NaN: a strict reader takes the text, and finds none."""
    effect = replace(PLAY, parameters={"width": unknown}, interval95={"width": (unknown, 1.0)}, confidence=unknown)
    found = replace(diagnosis(effect), error={"fitted": Misfit(unknown, unknown, unknown, unknown)})
    found = replace(found, model={"before": {"K": unknown}}, gains={"before": unknown}, runner_up={"fitted": unknown})
    told = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert told["effects"][0]["parameters"] == {"width": None}
    assert told["effects"][0]["interval95"] == {"width": [None, 1.0]}
    assert told["effects"][0]["confidence"] is None
    assert told["error"]["fitted"] == dict.fromkeys(("before", "after", "noise", "expected"))
    assert (told["model"], told["gains"]) == ({"before": {"K": None}}, {"before": None})


def test_advice_holds_the_sizes_and_needs_none():
    assert remedy("backlash", {"width": 2.3456}).startswith("dead-band 2.35 of output")
    assert remedy("load_step", {"size": -3.0, "at_s": 120.5}).startswith("a load of -3 of output came at 120.5 s")
    assert remedy("nothing_known", {}) == ""
    for name in REMEDIES:
        said = remedy(name, {})
        assert said
        assert "{" not in said


@pytest.mark.parametrize(("share", "growth_per_pv"), [(0.25, 0.1), (0.6, 0.02)])
def test_a_reaction_runs_away_where_its_heat_grows_with_the_pv_as_fast_as_the_loss(share, growth_per_pv):
    def limit(q, c):
        return scipy.optimize.brentq(lambda pv: q * math.exp(c * pv) - 1.0, 0.0, 100.0)

    sizes = {"heat_share": share, "growth_per_pv": growth_per_pv}
    ends = {"heat_share": (0.5 * share, 1.2 * share), "growth_per_pv": (0.5 * growth_per_pv, 1.5 * growth_per_pv)}
    said = remedy("nonlinear_loss", sizes, ends)
    above, earliest = (float(n) for n in re.findall(r"from ([\d.]+)", said.lower()))
    assert above == pytest.approx(limit(share, growth_per_pv), rel=0.005)
    assert earliest == pytest.approx(limit(1.2 * share, 1.5 * growth_per_pv), rel=0.005)
    assert said.startswith(f"a reaction gives back {share:.0%} of")


@pytest.mark.parametrize(("share", "growth_per_pv"), [(1.1, 0.2), (0.6, math.inf), (math.nan, 0.2), (0.6, math.nan)])
def test_a_reaction_that_may_take_up_all_of_the_loss_may_run_away_at_once(share, growth_per_pv):
    ends = {"heat_share": (0.1, share), "growth_per_pv": (0.05, growth_per_pv)}
    assert "perhaps from 0, it" in remedy("nonlinear_loss", {"heat_share": 0.5, "growth_per_pv": 0.1}, ends)


def test_a_reaction_without_heat_runs_away_nowhere():
    assert remedy("nonlinear_loss", {"heat_share": 0.0, "growth_per_pv": 0.1}) == remedy("nonlinear_loss", {})


def test_two_names_are_separated_by_the_experiment_of_the_pair_in_either_order():
    (one,), (other,) = separating("backlash", ["stiction"]), separating("stiction", ["backlash"])
    assert one.split(": ", 1)[1] == other.split(": ", 1)[1]
    assert "slow ramp" in one
    assert "staircase" in separating("backlash", ["ambient"])[0]
    assert separating("backlash", []) == []


@pytest.mark.parametrize(
    ("later", "fitted", "noise", "expected"),
    [(1.9, 1.0, 0.1, True), (2.1, 1.0, 0.1, False), (1.9, 0.1, 1.0, True), (2.1, 0.1, 1.0, False)],
)
def test_an_explanation_is_as_good_later_as_it_is_on_the_fitted_part(later, fitted, noise, expected):
    context = SimpleNamespace(held_out_residual=lambda _chosen: np.array([later, -later]))
    chosen = SimpleNamespace(rms=fitted, problem=SimpleNamespace(effects=()))
    found = SimpleNamespace(noise=noise, chosen=chosen)
    assert _is_as_good_later(context, found) is expected
