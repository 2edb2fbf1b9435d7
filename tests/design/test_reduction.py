"""Simpler models of a model: by hand, and by what every sound reduction keeps."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotuner.core.design import apply_rule, known_within, merged
from autotuner.core.design.rules.reduction import LEAST_DAMPING, reduce_to
from autotuner.core.model.process import (
    Fopdt,
    Integrating,
    InverseResponse,
    InverseResponseUnderdamped,
    NLags,
    SopdtOverdamped,
    SopdtUnderdamped,
    ThirdOrder,
    ThirdOrderUnderdamped,
    UnstableFopdt,
    frequency_response,
)
from autotuner.errors import InputError

W = np.geomspace(1e-3, 1e2, 200)
time = st.floats(0.1, 10.0)


@given(st.floats(0.1, 10.0), time, st.floats(0.1, 1.0), st.floats(0.1, 1.0), time, st.integers(2, 20))
def test_the_average_residence_time_and_the_gain_are_kept(K, T1, second, third, D, n):
    """The sum of lags, right-half-plane zero and dead time is the first moment of the pulse response."""
    T2 = second * T1
    T3 = third * T2
    sums = {
        SopdtOverdamped(K, T1, T2, D): T1 + T2 + D,
        InverseResponse(K, T1, T2, T3, D): T1 + T2 + T3 + D,
        NLags(K, T1, float(n), D): n * T1 + D,
        ThirdOrder(K, T1, T2, T3, D): T1 + T2 + T3 + D,
    }
    for model, total in sums.items():
        one, _ = reduce_to(Fopdt, model)
        two, _ = reduce_to(SopdtOverdamped, model)
        assert pytest.approx((K, total), rel=1e-9) == (one.K, one.T + one.D)
        assert pytest.approx((K, total), rel=1e-9) == (two.K, two.T1 + two.T2 + two.D)
        assert two.T1 >= two.T2


BY_HAND = [
    (Fopdt, SopdtOverdamped(2.0, 10.0, 4.0, 2.0), Fopdt(2.0, 12.0, 4.0)),
    (Fopdt, InverseResponse(2.0, 10.0, 4.0, 1.5, 2.0), Fopdt(2.0, 12.0, 5.5)),
    (Fopdt, SopdtUnderdamped(2.0, 16.0, 6.0, 2.0), Fopdt(2.0, 6.0, 4.0)),
    (Fopdt, InverseResponseUnderdamped(2.0, 16.0, 6.0, 1.0, 2.0), Fopdt(2.0, 6.0, 5.0)),
    (Fopdt, NLags(2.0, 4.0, 2.0, 1.0), Fopdt(2.0, 6.0, 3.0)),
    (SopdtOverdamped, Fopdt(2.0, 10.0, 2.0), SopdtOverdamped(2.0, 10.0, 0.0, 2.0)),
    (SopdtOverdamped, InverseResponse(2.0, 10.0, 4.0, 1.5, 2.0), SopdtOverdamped(2.0, 10.0, 4.0, 3.5)),
    (SopdtOverdamped, SopdtUnderdamped(2.0, 16.0, 6.0, 2.0), SopdtOverdamped(2.0, 4.0, 4.0, 2.0)),
    (SopdtOverdamped, InverseResponseUnderdamped(2.0, 16.0, 6.0, 1.0, 2.0), SopdtOverdamped(2.0, 4.0, 4.0, 3.0)),
    (SopdtOverdamped, NLags(2.0, 4.0, 2.0, 1.0), SopdtOverdamped(2.0, 4.0, 4.0, 1.0)),
    # Half of the third lag makes the second one the longer: 6 and 6 + 4/2.
    (SopdtOverdamped, ThirdOrder(2.0, 6.0, 6.0, 4.0, 1.0), SopdtOverdamped(2.0, 8.0, 6.0, 3.0)),
]


@pytest.mark.parametrize(("kind", "model", "expected"), BY_HAND, ids=str)
def test_a_reduction_by_hand(kind, model, expected):
    found, how = reduce_to(kind, model)
    assert found == expected
    assert bool(how) is not isinstance(model, Fopdt)


def test_a_model_of_the_structure_asked_for_is_itself():
    for model in (Fopdt(2.0, 10.0, 2.0), SopdtOverdamped(2.0, 10.0, 4.0, 2.0)):
        assert reduce_to(type(model), model) == (model, "")


@pytest.mark.parametrize("model", [Integrating(1.0, 2.0, 1.0), UnstableFopdt(1.0, 5.0, 1.0)], ids=str)
def test_what_has_no_static_gain_is_not_reduced_to_lags(model):
    assert reduce_to(Fopdt, model) == (None, "")
    assert reduce_to(SopdtOverdamped, model) == (None, "")


@given(st.floats(0.05, 0.99), time)
def test_a_pair_is_two_lags_from_the_damping_on_that_is_stated(damping, T):
    pair = SopdtUnderdamped(1.0, T * T, 2.0 * damping * T, 1.0)
    found, _ = reduce_to(SopdtOverdamped, pair)
    if damping > LEAST_DAMPING * (1.0 + 1e-9):
        assert pytest.approx((T, T), rel=1e-9) == (found.T1, found.T2)
    elif damping < LEAST_DAMPING * (1.0 - 1e-9):
        assert found is None
        with pytest.raises(InputError):
            apply_rule("simc_pid", pair)


@given(time, st.floats(0.05, 1.0), time, time)
def test_merged_lags_are_the_same_process(T1, ratio, Z, D):
    for model in (SopdtOverdamped(2.0, T1, ratio * T1, D), InverseResponse(-2.0, T1, ratio * T1, Z, D)):
        same = merged(model)
        np.testing.assert_allclose(frequency_response(same, W), frequency_response(model, W), rtol=1e-9)
        assert list(same.parameters()) == (
            ["K", "m", "n", "Z", "D"] if isinstance(model, InverseResponse) else ["K", "m", "n", "D"]
        )


@pytest.mark.parametrize(
    ("model", "names"),
    [
        (ThirdOrder(2.0, 6.0, 3.0, 1.0, 1.0), ["K", "a1", "a2", "a3", "D"]),
        (ThirdOrderUnderdamped(2.0, 9.0, 3.0, 2.0, 1.0), ["K", "a1", "a2", "a3", "D"]),
        (SopdtOverdamped(2.0, 6.0, 3.0, 1.0), ["K", "m", "n", "D"]),
    ],
    ids=str,
)
def test_a_covariance_of_other_parameters_comes_with_the_process_by_them(model, names):
    own, other = np.eye(len(model.parameters())), 2.0 * np.eye(len(names))
    covariance, known_as = known_within(model, own, other)
    assert covariance is other
    assert list(known_as.parameters()) == names
    np.testing.assert_allclose(frequency_response(known_as, W), frequency_response(model, W), rtol=1e-9)


def test_the_coefficients_of_three_lags_by_hand():
    """`(6 s + 1)(3 s + 1)(s + 1) = 18 s^3 + 27 s^2 + 10 s + 1`."""
    _, known_as = known_within(ThirdOrder(2.0, 6.0, 3.0, 1.0, 1.0), None, np.eye(5))
    assert known_as.parameters() == pytest.approx({"K": 2.0, "a1": 10.0, "a2": 27.0, "a3": 18.0, "D": 1.0})


def test_a_covariance_that_is_not_finite_says_nothing():
    model = Fopdt(2.0, 10.0, 2.0)
    unknown = np.diag([1.0, math.inf, 1.0])
    assert known_within(model, unknown, None) == (None, None)
    assert known_within(model, None, None) == (None, None)
    assert known_within(model, np.eye(3), np.eye(4))[1] is None
    assert known_within(SopdtOverdamped(1.0, 2.0, 1.0, 1.0), np.eye(4), np.full((4, 4), math.nan))[0] is None
