import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotuner.core.design import PidGains, UltimatePoint, is_stable, ultimate_point
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


def test_integrator_with_dead_time_by_hand():
    # Phase -pi/2 - w D = -pi at w = pi/(2 D), gain K/w.
    point = ultimate_point(Integrating(0.5, 0.0, 2.0))
    assert (point.Ku, point.Pu) == pytest.approx((math.pi / 4.0 / 0.5, 8.0), rel=1e-12)


def test_three_equal_corners_by_hand():
    # (1 - s)/(1 + s)^2: three phases of atan(w) each, so w = tan(60 deg) = sqrt 3, gain 2/4.
    point = ultimate_point(InverseResponse(1.0, 1.0, 1.0, 1.0, 0.0))
    assert (point.Ku, point.Pu) == pytest.approx((2.0, 2.0 * math.pi / math.sqrt(3.0)), rel=1e-12)


@pytest.mark.parametrize(
    ("model", "Ku", "w"),
    [(NLags(1.0, 2.0, 4.0, 0.0), 4.0, 0.5), (ThirdOrder(2.0, 1.0, 1.0, 1.0, 0.0), 4.0, math.sqrt(3.0))],
)
def test_equal_lags_by_hand(model, Ku, w):
    # n atan(w T) = pi, gain cos(pi/n)^n.
    point = ultimate_point(model)
    assert (point.Ku, point.Pu) == pytest.approx((Ku, 2.0 * math.pi / w), rel=1e-6)


@given(st.floats(0.1, 10.0), st.floats(0.01, 100.0), st.floats(0.01, 100.0))
def test_fopdt_meets_its_two_equations(K, T, D):
    point = ultimate_point(Fopdt(-K, T, D))
    w = 2.0 * math.pi / point.Pu
    assert math.atan(w * T) + w * D == pytest.approx(math.pi, rel=1e-12)
    assert -point.Ku * K == pytest.approx(math.hypot(1.0, w * T), rel=1e-9) or point.Ku * K == pytest.approx(
        -math.hypot(1.0, w * T), rel=1e-9
    )


@settings(max_examples=30)
@given(st.floats(0.05, 0.9))
def test_proportional_control_is_stable_up_to_the_ultimate_gain_and_not_beyond(ratio):
    for model in (
        SopdtOverdamped(2.0, 5.0, 3.0, 4.0 * ratio),
        SopdtUnderdamped(2.0, 4.0, 1.0, 4.0 * ratio),
        UnstableFopdt(1.5, 3.0, 3.0 * ratio),
    ):
        Ku = ultimate_point(model).Ku
        assert is_stable(model, PidGains(Ku * (1.0 - 1e-6)))
        assert not is_stable(model, PidGains(Ku * (1.0 + 1e-6)))


@pytest.mark.parametrize(
    "model",
    [
        Fopdt(1.0, 1.0, 0.0),
        SopdtOverdamped(1.0, 1.0, 1.0, 0.0),
        SopdtUnderdamped(1.0, 1.0, 0.5, 0.0),
        Integrating(1.0, 1.0, 0.0),
        InverseResponse(1.0, 1.0, 0.0, 1.0, 0.0),
        UnstableFopdt(1.0, 1.0, 1.0),
        UnstableFopdt(1.0, 1.0, 0.0),
    ],
)
def test_a_phase_that_never_crosses_has_no_ultimate_point(model):
    assert ultimate_point(model) is None


@pytest.mark.parametrize(
    ("Ku", "Pu", "field"), [(0.0, 1.0, "Ku"), (math.nan, 1.0, "Ku"), (1.0, 0.0, "Pu"), (1.0, math.inf, "Pu")]
)
def test_points_that_cannot_exist_are_refused(Ku, Pu, field):
    with pytest.raises(InputError) as caught:
        UltimatePoint(Ku, Pu)
    assert caught.value.field == f"ultimate.{field}"
