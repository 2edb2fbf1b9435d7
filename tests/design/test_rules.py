"""Each rule against an example worked by hand from its source."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotuner.core.design import UltimatePoint, apply_rule, rule_names
from autotuner.core.design.rules.reduction import half_rule, one_lag_of_many, two_lags_of_many
from autotuner.core.model.process import (
    Fopdt,
    Integrating,
    InverseResponse,
    NLags,
    SopdtOverdamped,
    SopdtUnderdamped,
    ThirdOrder,
    UnstableFopdt,
)
from autotuner.errors import InputError

INF = math.inf
POINT = UltimatePoint(4.0, 10.0)
LAG = Fopdt(K=2.0, T=10.0, D=2.0)  # a = K D/T = 0.4, D/T = 0.2
TWO_LAGS = SopdtOverdamped(K=2.0, T1=10.0, T2=4.0, D=2.0)
RAMP = Integrating(K=0.1, T=0.0, D=2.0)  # a = K D = 0.2
SLOW_RAMP = Integrating(K=0.1, T=3.0, D=2.0)

BY_HAND = [
    ("ziegler_nichols_p", POINT, (2.0, INF, 0.0)),
    ("ziegler_nichols_pi", POINT, (1.8, 8.3333333, 0.0)),
    ("ziegler_nichols_pid", POINT, (2.4, 5.0, 1.25)),
    ("tyreus_luyben_pi", POINT, (1.25, 22.0, 0.0)),
    ("tyreus_luyben_pid", POINT, (1.8181818, 22.0, 1.5873016)),
    ("pessen_pid", POINT, (2.8, 4.0, 1.5)),
    ("some_overshoot_pid", POINT, (1.3333333, 5.0, 3.3333333)),
    ("no_overshoot_pid", POINT, (0.8, 5.0, 3.3333333)),
    ("ziegler_nichols_reaction_p", LAG, (2.5, INF, 0.0)),
    ("ziegler_nichols_reaction_pi", LAG, (2.25, 6.6666667, 0.0)),
    ("ziegler_nichols_reaction_pid", LAG, (3.0, 4.0, 1.0)),
    ("ziegler_nichols_reaction_pid", RAMP, (6.0, 4.0, 1.0)),
    # r = 0.2: (1 + 0.2/3)/0.4; (0.9 + 0.2/12)/0.4 and 2*30.6/13; (4/3 + 0.05)/0.4, 2*33.2/14.6 and 8/11.4.
    ("cohen_coon_p", LAG, (2.6666667, INF, 0.0)),
    ("cohen_coon_pi", LAG, (2.2916667, 4.7076923, 0.0)),
    ("cohen_coon_pid", LAG, (3.4583333, 4.5479452, 0.7017544)),
    ("chr_load_0_p", LAG, (0.75, INF, 0.0)),
    ("chr_load_0_pi", LAG, (1.5, 8.0, 0.0)),
    ("chr_load_0_pid", LAG, (2.375, 4.8, 0.84)),
    ("chr_load_20_p", LAG, (1.75, INF, 0.0)),
    ("chr_load_20_pi", LAG, (1.75, 4.6, 0.0)),
    ("chr_load_20_pid", LAG, (3.0, 4.0, 0.84)),
    ("chr_set_point_0_p", LAG, (0.75, INF, 0.0)),
    ("chr_set_point_0_pi", LAG, (0.875, 12.0, 0.0)),
    ("chr_set_point_0_pid", LAG, (1.5, 10.0, 1.0)),
    ("chr_set_point_20_p", LAG, (1.75, INF, 0.0)),
    ("chr_set_point_20_pi", LAG, (1.5, 10.0, 0.0)),
    ("chr_set_point_20_pid", LAG, (2.375, 14.0, 0.94)),
    ("simc_pi", LAG, (1.25, 10.0, 0.0)),
    ("simc_pi", RAMP, (2.5, 16.0, 0.0)),
    # Series Kc = 1.25, Ti = 10, Td = 4: interaction 1.4.
    ("simc_pid", TWO_LAGS, (1.75, 14.0, 2.8571429)),
    # Series Kc = 2.5, Ti = 16, Td = 3: interaction 1.1875.
    ("simc_pid", SLOW_RAMP, (2.96875, 19.0, 2.5263158)),
    # tau_c = T = 10: 10/(2*12); 11/(2*11), 11, 20/22.
    ("lambda_pi", LAG, (0.4166667, 10.0, 0.0)),
    ("lambda_pid", LAG, (0.5, 11.0, 0.9090909)),
    # tau_c = 3 D = 6: (12 + 2)/(0.1*64).
    ("lambda_pi", RAMP, (2.1875, 14.0, 0.0)),
    # 0.075 + (0.35 - 20/144) 2.5; 0.7 + 2600/368.
    ("amigo_pi", LAG, (0.6027778, 7.7652174, 0.0)),
    ("amigo_pid", LAG, (1.225, 5.8666667, 0.9433962)),
    ("amigo_pi", RAMP, (1.75, 26.8, 0.0)),
    ("amigo_pid", RAMP, (2.25, 16.0, 1.0)),
]


def apply_to(name, process, **options):
    if isinstance(process, UltimatePoint):
        return apply_rule(name, ultimate=process, **options)
    return apply_rule(name, process, **options)


@pytest.mark.parametrize(("name", "process", "expected"), BY_HAND)
def test_rule_by_hand(name, process, expected):
    gains = apply_to(name, process).gains
    assert (gains.Kp, gains.Ti, gains.Td) == pytest.approx(expected, rel=1e-7)


def test_every_rule_has_an_example():
    assert {name for name, _, _ in BY_HAND} == set(rule_names())


@pytest.mark.parametrize("name", rule_names())
def test_every_rule_names_its_source_and_controller(name):
    process = next(process for rule, process, _ in BY_HAND if rule == name)
    result = apply_to(name, process)
    assert result.gains.controller.lower() == name.rsplit("_", 1)[1]
    assert any(character.isdigit() for character in result.source)


@pytest.mark.parametrize(
    ("name", "process", "tau_c_s", "expected"),
    [
        ("simc_pi", LAG, 0.5, (2.0, 10.0, 0.0)),
        ("simc_pi", LAG, 0.25, (2.2222222, 9.0, 0.0)),
        ("lambda_pi", LAG, 3.0, (1.0, 10.0, 0.0)),
        ("lambda_pid", LAG, 4.5, (1.0, 11.0, 0.9090909)),
        ("simc_pid", TWO_LAGS, 3.0, (1.4, 14.0, 2.8571429)),
    ],
)
def test_wanted_closed_loop_time_by_hand(name, process, tau_c_s, expected):
    gains = apply_rule(name, process, tau_c_s=tau_c_s).gains
    assert (gains.Kp, gains.Ti, gains.Td) == pytest.approx(expected, rel=1e-7)


def test_half_rule_by_hand():
    # Skogestad 2003, section 2: half of the smaller lag goes to the other, half to the dead time.
    assert half_rule(TWO_LAGS) == Fopdt(2.0, 12.0, 4.0)
    assert half_rule(InverseResponse(2.0, 10.0, 4.0, 1.5, 2.0)) == Fopdt(2.0, 12.0, 5.5)


def test_a_reduction_is_said():
    result = apply_rule("simc_pi", TWO_LAGS)
    assert (result.gains.Kp, result.gains.Ti) == pytest.approx((0.75, 12.0))
    assert "half rule" in result.warnings[0]


def test_first_order_is_a_second_order_model_without_its_second_lag():
    assert apply_rule("simc_pid", LAG).gains == apply_rule("simc_pi", LAG).gains
    assert apply_rule("simc_pid", LAG).warnings == ()


def test_derivative_comes_with_a_filter():
    assert apply_rule("ziegler_nichols_pid", ultimate=POINT).gains.Tf == pytest.approx(0.125)
    assert apply_rule("ziegler_nichols_pi", ultimate=POINT).gains.Tf == 0.0


def test_amigo_weights_the_set_point_by_the_dead_time():
    assert apply_rule("amigo_pid", LAG).gains.b == 0.0
    assert apply_rule("amigo_pid", Fopdt(1.0, 1.0, 3.0)).gains.b == 1.0


def test_measured_ultimate_point_wins_over_the_model():
    assert apply_rule("ziegler_nichols_p", LAG, POINT).gains.Kp == 2.0
    # w T + tan(w D) = 0 has its root at w D = 1.6887 for T = 5 D, and Ku K = sqrt(1 + (w T)^2) = 8.5023.
    assert apply_rule("ziegler_nichols_p", LAG).gains.Kp == pytest.approx(8.5023 / 4.0, rel=1e-4)


@pytest.mark.parametrize(
    ("name", "model", "quantity"),
    [
        ("cohen_coon_pi", Fopdt(1.0, 1.0, 3.0), "D/T is 3"),
        ("ziegler_nichols_reaction_pid", Fopdt(1.0, 100.0, 1.0), "D/T is 0.01"),
        ("amigo_pid", LAG, "D/T is 0.2"),
        ("ziegler_nichols_pid", Fopdt(1.0, 1.0, 20.0), "K Ku is"),
    ],
)
def test_outside_its_range_a_rule_warns(name, model, quantity):
    assert any(quantity in warning for warning in apply_rule(name, model).warnings)


def test_a_closed_loop_faster_than_the_dead_time_allows_is_warned_of():
    assert "tau_c/D is 0.5" in apply_rule("lambda_pi", LAG, tau_c_s=1.0).warnings[0]


def test_names_are_forgiving():
    assert apply_rule(" Ziegler-Nichols PID ", ultimate=POINT).rule == "ziegler_nichols_pid"


@pytest.mark.parametrize(
    ("name", "given", "field"),
    [
        ("zn", {"model": LAG}, "rule"),
        ("simc_pi", {}, "model"),
        ("ziegler_nichols_pid", {}, "ultimate"),
        ("cohen_coon_pi", {"model": RAMP}, "model.structure"),
        ("simc_pi", {"model": SopdtUnderdamped(1.0, 1.0, 0.5, 1.0)}, "model.structure"),
        ("amigo_pi", {"model": UnstableFopdt(1.0, 1.0, 0.1)}, "model.structure"),
        ("ziegler_nichols_pid", {"model": Fopdt(1.0, 1.0, 0.0)}, "model.D"),
        ("simc_pi", {"model": Fopdt(1.0, 1.0, 0.0)}, "model.D"),
        ("amigo_pid", {"model": Fopdt(1.0, 1.0, 0.0)}, "model.D"),
        ("amigo_pi", {"model": Fopdt(1.0, 1.0, 1e-320)}, "model.D"),
        ("simc_pi", {"model": LAG, "tau_c_s": 0.0}, "tau_c_s"),
        ("simc_pi", {"model": LAG, "tau_c_s": math.nan}, "tau_c_s"),
        ("amigo_pi", {"model": LAG, "tau_c_s": 1.0}, "tau_c_s"),
    ],
)
def test_what_a_rule_cannot_use_is_refused_by_name(name, given, field):
    with pytest.raises(InputError) as caught:
        apply_rule(name, **given)
    assert caught.value.field == field
    assert caught.value.remedy


def test_an_unknown_rule_lists_all():
    with pytest.raises(InputError) as caught:
        apply_rule("magic", LAG)
    assert all(name in caught.value.remedy for name in rule_names())


@given(
    st.sampled_from([(n, p) for n, p, _ in BY_HAND if isinstance(p, Fopdt)]), st.floats(0.1, 10.0), st.floats(0.1, 10.0)
)
def test_rules_scale_with_gain_and_time(row, gain, time):
    """Of a process with `K` times `gain` and all times times `time`, the gains are those of the process scaled back."""
    name, model = row[0], row[1]
    plain = apply_rule(name, model).gains
    scaled = apply_rule(name, Fopdt(model.K * gain, model.T * time, model.D * time)).gains
    assert scaled.Kp * gain == pytest.approx(plain.Kp, rel=1e-9)
    assert (scaled.Ti / time, scaled.Td / time) == pytest.approx((plain.Ti, plain.Td), rel=1e-9)


def test_a_well_damped_pair_is_taken_for_two_equal_lags_and_a_lively_one_is_not():
    # sqrt(m) = 4, damping n/(2 sqrt(m)) = 0.75: lags 4 and 4, by the half rule T = 6 and D = 2 + 2.
    result = apply_rule("simc_pi", SopdtUnderdamped(2.0, 16.0, 6.0, 2.0))
    assert (result.gains.Kp, result.gains.Ti) == pytest.approx((6.0 / (2.0 * 8.0), 6.0))
    assert "two equal lags" in result.warnings[0]
    with pytest.raises(InputError):
        apply_rule("simc_pi", SopdtUnderdamped(2.0, 16.0, 4.0, 2.0))


def test_half_rule_of_many_lags_by_hand():
    assert one_lag_of_many(NLags(2.0, 4.0, 4.0, 1.0)) == Fopdt(2.0, 6.0, 11.0)
    assert two_lags_of_many(NLags(2.0, 4.0, 4.0, 1.0)) == SopdtOverdamped(2.0, 6.0, 4.0, 7.0)
    assert one_lag_of_many(ThirdOrder(2.0, 10.0, 3.0, 1.0, 1.0)) == Fopdt(2.0, 11.5, 3.5)
    assert two_lags_of_many(ThirdOrder(2.0, 10.0, 3.0, 1.0, 1.0)) == SopdtOverdamped(2.0, 10.0, 3.5, 1.5)
