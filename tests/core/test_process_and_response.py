"""Process models and their exact response, judged by matrix exponentials and closed forms."""

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st

from autotuner.core.estimation.simulation import response
from autotuner.core.model.process import (
    STRUCTURES,
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
    model_from_dict,
    model_to_dict,
    second_order,
    second_order_with_zero,
    third_order,
)
from autotuner.errors import InputError

MODELS = [
    Fopdt(2.0, 10.0, 1.5),
    SopdtOverdamped(1.2, 8.0, 3.0, 1.23),
    SopdtOverdamped(1.2, 8.0, 8.0, 1.23),
    SopdtOverdamped(1.2, 8.0, 0.0, 0.4),
    SopdtUnderdamped(1.0, 9.0, 2.4, 1.0),
    Integrating(0.1, 0.0, 1.0),
    Integrating(0.1, 3.0, 1.0),
    UnstableFopdt(1.0, 50.0, 1.0),
    InverseResponse(1.0, 8.0, 3.0, 2.0, 1.0),
    InverseResponse(1.0, 8.0, 0.0, 2.0, 1.0),
    InverseResponseUnderdamped(1.0, 9.0, 2.4, 2.0, 1.0),
    NLags(1.5, 3.0, 4.0, 1.0),
    NLags(1.5, 3.0, 3.0, 0.0),
    ThirdOrder(1.5, 10.0, 3.0, 1.0, 1.0),
    ThirdOrder(1.5, 10.0, 3.0, 3.0, 1.0),
    ThirdOrderUnderdamped(1.5, 9.0, 2.4, 5.0, 1.0),
]


def by_matrix_exponential(model, t, u):
    """State-space simulation from event to event with scipy.linalg.expm: slow, and nothing of ours."""
    r = model.rational()
    order = max(k for k, value in enumerate(r.a) if value)
    lead = r.a[order]
    feed = r.b[order] / lead if order == 1 else 0.0
    b = [(r.b[k] if k < 2 else 0.0) - feed * r.a[k] for k in range(order)]
    extended = np.zeros((order + 1, order + 1))
    extended[: order - 1, 1:order] = np.eye(order - 1)
    extended[order - 1, :order] = [-a / lead for a in r.a[:order]]
    extended[order - 1, order] = 1.0
    delayed = t + model.D
    x, last, seen = np.zeros(order), t[0], {}
    for event in np.unique(np.concatenate((delayed, t))):
        held = u[np.searchsorted(delayed, 0.5 * (last + event), side="right") - 1] if event > delayed[0] else 0.0
        step = scipy.linalg.expm(extended * (event - last))
        x, last = step[:order, :order] @ x + step[:order, order] * held, event
        after = u[np.searchsorted(delayed, event, side="right") - 1] if event >= delayed[0] else 0.0
        seen[event] = np.dot(b, x) / lead + feed * after
    return np.array([seen[moment] for moment in t])


@pytest.mark.parametrize("model", MODELS, ids=lambda m: f"{m.structure}-{m.parameters()}")
def test_response_equals_matrix_exponential_at_irregular_samples(model):
    rng = np.random.default_rng(7)
    t = np.sort(rng.uniform(0.0, 60.0, 250))
    u = np.where(np.arange(t.size) // 40 % 2, 1.0, -0.5)
    expected = by_matrix_exponential(model, t, u)
    assert np.abs(response(model, t, u) - expected).max() <= 1e-11 * np.abs(expected).max()


def test_step_response_of_fopdt_by_hand():
    t = np.array([0.0, 1.0, 1.5, 11.5, 1000.0])
    y = response(Fopdt(2.0, 10.0, 1.5), t, np.full(t.size, 3.0))
    assert y == pytest.approx([0.0, 0.0, 0.0, 6.0 * (1.0 - np.exp(-1.0)), 6.0], abs=1e-12)


def test_response_at_other_times_than_the_samples():
    t = np.array([0.0, 4.0])
    at = np.linspace(0.0, 20.0, 41)
    y = response(Fopdt(1.0, 5.0, 1.0), t, np.array([1.0, 1.0]), at)
    assert y == pytest.approx(np.where(at > 1.0, 1.0 - np.exp(-(at - 1.0) / 5.0), 0.0), abs=1e-12)


@given(
    K=st.floats(0.1, 15.0),
    T=st.floats(0.01, 1e4),
    share=st.floats(0.01, 10.0),
    scale=st.floats(1e-3, 1e4),
)
def test_response_is_invariant_to_the_scale_of_time(K, T, share, scale):
    t = np.linspace(0.0, 6.0 * T, 40)
    u = np.where(np.arange(40) < 20, 1.0, 0.0)
    one = response(Fopdt(K, T, share * T), t, u)
    other = response(Fopdt(K, scale * T, scale * share * T), scale * t, u)
    assert other == pytest.approx(one, rel=1e-9, abs=1e-9 * K)


def test_frequency_response_by_hand():
    w = 0.5
    g = frequency_response(SopdtOverdamped(3.0, 4.0, 2.0, 1.0), np.array([w]))[0]
    assert g == pytest.approx(3.0 / ((1 + 2j) * (1 + 1j)) * np.exp(-0.5j))


def test_second_order_splits_real_and_complex_poles():
    assert second_order(1.0, 20.0, 12.0, 4.0) == SopdtOverdamped(1.0, 10.0, 2.0, 4.0)
    assert second_order(1.0, 9.0, 2.4, 1.0) == SopdtUnderdamped(1.0, 9.0, 2.4, 1.0)


def test_third_order_splits_likewise_and_orders_its_lags():
    assert third_order(1.0, 20.0, 12.0, 5.0, 4.0) == ThirdOrder(1.0, 10.0, 5.0, 2.0, 4.0)
    assert third_order(1.0, 9.0, 2.4, 3.0, 1.0) == ThirdOrderUnderdamped(1.0, 9.0, 2.4, 3.0, 1.0)


def test_three_equal_lags_answer_alike_in_both_structures():
    t, u = np.linspace(0.0, 60.0, 300), np.where(np.arange(300) // 50 % 2, 1.0, -0.5)
    equal, free = response(NLags(2.0, 5.0, 3.0, 1.0), t, u), response(ThirdOrder(2.0, 5.0, 5.0, 5.0, 1.0), t, u)
    assert np.abs(equal - free).max() <= 2e-4 * np.abs(equal).max()


def test_poles_with_a_zero_split_likewise():
    assert second_order_with_zero(1.0, 20.0, 12.0, 3.0, 4.0) == InverseResponse(1.0, 10.0, 2.0, 3.0, 4.0)
    assert second_order_with_zero(1.0, 9.0, 2.4, 3.0, 1.0) == InverseResponseUnderdamped(1.0, 9.0, 2.4, 3.0, 1.0)


@pytest.mark.parametrize("model", MODELS, ids=lambda m: m.structure)
def test_models_survive_json(model):
    assert model_from_dict(model_to_dict(model)) == model


def test_structure_follows_from_the_parameter_names():
    assert model_from_dict({"K": 1, "T": 2, "D": 0}).structure == "fopdt"
    assert model_from_dict({"K": 1, "m": 9, "n": 2, "D": 0}).structure == "sopdt_underdamped"
    assert model_from_dict({"K": 1, "m": 9, "n": 2, "Z": 1, "D": 0}).structure == "inverse_response_underdamped"
    assert model_from_dict({"K": 1, "T": 2, "n": 4, "D": 0}).structure == "n_lags"
    assert model_from_dict({"K": 1, "T1": 3, "T2": 2, "T3": 1, "D": 0}).structure == "third_order"
    assert len(STRUCTURES) == 10


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"K": 0.0, "T": 1.0, "D": 1.0}, "model.K"),
        ({"K": 1.0, "T": -1.0, "D": 1.0}, "model.T"),
        ({"K": 1.0, "T": 1.0, "D": float("nan")}, "model.D"),
        ({"K": 1.0, "T1": 1.0, "T2": 2.0, "D": 0.0}, "model.T2"),
        ({"K": 1.0, "m": 1.0, "n": 2.0, "D": 0.0}, "model.n"),
        ({"K": 1.0, "T": 1.0, "n": 2.5, "D": 0.0}, "model.n"),
        ({"K": 1.0, "T": 1.0, "n": 21.0, "D": 0.0}, "model.n"),
        ({"K": 1.0, "T1": 3.0, "T2": 1.0, "T3": 2.0, "D": 0.0}, "model.T3"),
        ({"K": "1", "T": 1.0, "D": 1.0}, "model.K"),
        ({"structure": "fopdt", "K": 1.0, "T": 1.0}, "model.D"),
        ({"structure": "fopdt", "K": 1.0, "T": 1.0, "D": 1.0, "Z": 1.0}, "model.Z"),
        ({"structure": "fifth", "K": 1.0}, "model.structure"),
    ],
)
def test_impossible_models_name_the_field(values, field):
    with pytest.raises(InputError) as caught:
        model_from_dict(values)
    assert caught.value.field == field
    assert caught.value.remedy
