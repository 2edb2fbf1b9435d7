"""Gains by goal, by rule and by an ultimate point: each stable, each with its robustness."""

import functools
import json

import numpy as np
import pytest

from autotuner.core.design import GOALS, UltimatePoint, apply_rule, tune
from autotuner.core.model.process import (
    Fopdt,
    Integrating,
    InverseResponse,
    SopdtOverdamped,
    SopdtUnderdamped,
    UnstableFopdt,
)
from autotuner.errors import InputError

MODELS = [
    Fopdt(2.0, 10.0, 2.0),
    Fopdt(-2.0, 1.0, 20.0),
    SopdtOverdamped(2.0, 10.0, 3.0, 1.5),
    SopdtUnderdamped(1.0, 1.0, 0.5, 1.0),
    Integrating(0.1, 1.0, 2.0),
    UnstableFopdt(1.0, 10.0, 1.0),
    InverseResponse(1.0, 5.0, 2.0, 1.0, 1.0),
]
tuned = functools.cache(tune)
"""The same gains, computed once: several tests judge them."""


@pytest.mark.one_of(4)
@pytest.mark.parametrize("model", MODELS, ids=lambda m: m.structure)
@pytest.mark.parametrize("goal", GOALS)
def test_every_goal_gives_a_stable_loop_for_every_structure(model, goal):
    found = tuned(model, goal)
    assert found.goal == goal
    assert found.margins.stable
    json.dumps(found.to_dict(), allow_nan=False)


@pytest.mark.parametrize("model", MODELS[:4], ids=lambda m: m.structure)
def test_the_dial_turns_the_right_way(model):
    errors = [abs(1.0 / tuned(model, goal).gains.Ki) for goal in ("calm", "balanced", "brisk")]
    assert errors == sorted(errors, reverse=True)


def test_a_named_rule_is_what_is_given():
    model = MODELS[0]
    found = tune(model, rule="simc-pi", tau_c_s=3.0)
    assert (found.goal, found.rule) == (None, "simc_pi")
    assert found.gains == apply_rule("simc_pi", model, tau_c_s=3.0).gains


def largest_sensitivity(gains, K, T, D):
    """Return Ms of a PI controller on a lag with dead time, by its definition on a dense grid."""
    w = np.geomspace(1e-3, 1e2, 200_000) / D
    C, G = gains.Kp * (1.0 + 1.0 / (1j * w * gains.Ti)), K / (1j * w * T + 1.0) * np.exp(-1j * w * D)
    return float(np.max(1.0 / np.abs(1.0 + C * G)))


@pytest.mark.parametrize(("error", "warned"), [(0.05, False), (0.3, True)])
def test_a_rule_on_an_uncertain_gain_is_warned_of_where_the_loop_suffers(error, warned):
    """SIMC has Ms 1.59 on its model; the largest gain of the 95 % region decides."""
    K, T, D = 2.0, 10.0, 2.0
    found = tune(Fopdt(K, T, D), rule="simc_pi", covariance=np.diag([(error * K) ** 2, 1e-9, 1e-9]))
    worst = largest_sensitivity(found.gains, K * (1.0 + 1.96 * error), T, D)
    assert (worst > 2.0) == warned
    said = [text for text in found.warnings if "95 % region" in text]
    assert len(said) == warned
    assert not warned or f"{worst:.2f}" in said[0]
    assert found.gains == apply_rule("simc_pi", Fopdt(K, T, D)).gains


def test_alternatives_carry_their_robustness():
    found = tune(MODELS[0])
    by_name = {candidate.rule: candidate for candidate in found.alternatives}
    assert by_name["ziegler_nichols_pid"].margins.Ms > by_name["simc_pi"].margins.Ms > by_name["amigo_pi"].margins.Ms


def test_an_ultimate_point_is_enough_for_its_rules_and_says_what_is_not_known():
    found = tune(None, rule="tyreus_luyben_pi", ultimate=UltimatePoint(3.2, 10.0))
    assert (found.gains.Kp, found.gains.Ti) == pytest.approx((1.0, 22.0))
    assert found.margins is None
    assert "was not checked" in found.warnings[-1]


def test_gains_that_oscillate_are_warned_of():
    assert any("Ms is" in warning for warning in tune(MODELS[0], rule="cohen_coon_pid").warnings)


def test_gains_that_are_unstable_are_warned_of():
    found = tune(Fopdt(1.0, 1.0, 2.0), rule="ziegler_nichols_p", ultimate=UltimatePoint(10.0, 5.0))
    assert not found.margins.stable
    assert any("do not use" in warning for warning in found.warnings)


@pytest.mark.parametrize(
    ("given", "field"),
    [
        ({"model": MODELS[0], "goal": "heroic"}, "goal"),
        ({"model": None}, "model"),
        ({"model": MODELS[0], "rule": "magic"}, "rule"),
        ({"model": UnstableFopdt(1.0, 1.0, 5.0)}, "model.D"),
    ],
)
def test_what_cannot_be_tuned_is_refused_by_name(given, field):
    with pytest.raises(InputError) as caught:
        tune(**given)
    assert caught.value.field == field
