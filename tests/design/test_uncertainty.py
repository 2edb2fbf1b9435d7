"""What a covariance does: limits that hold for the models it stands for, intervals that follow from it."""

import math

import numpy as np
import pytest

from autotuner.core.design import Requirements, design, margins, merged, tune
from autotuner.core.design.optimisation.uncertainty import shifted
from autotuner.core.model.process import Fopdt, Integrating, InverseResponse, SopdtOverdamped, SopdtUnderdamped
from autotuner.errors import InputError

MODELS = [
    Fopdt(2.0, 10.0, 2.0),
    Fopdt(1.0, 100.0, 1.0),
    SopdtOverdamped(1.0, 10.0, 4.0, 1.0),
    SopdtUnderdamped(1.0, 4.0, 1.0, 2.0),
    Integrating(0.1, 1.0, 2.0),
    InverseResponse(1.0, 5.0, 2.0, 1.0, 1.0),
]
FEW = [model if k in {0, 4} else pytest.param(model, marks=pytest.mark.long) for k, model in enumerate(MODELS)]
"""Of these one that settles and one that does not; the others take minutes."""


def independent(model, share):
    return np.diag([(share * value) ** 2 for value in model.parameters().values()])


@pytest.mark.parametrize("model", FEW, ids=str)
@pytest.mark.parametrize("share", [pytest.param(0.03, marks=pytest.mark.long), 0.1])
def test_the_true_loop_seldom_exceeds_the_limit(model, share):
    covariance = independent(model, share)
    gains = design(model, Requirements(), covariance).gains
    rng = np.random.default_rng(7)
    truths = [shifted(model, rng.multivariate_normal(np.zeros(len(covariance)), covariance)) for _ in range(100)]
    found = [margins(truth, gains) for truth in truths]
    exceeded = sum(not m.stable or m.Ms > 1.4 or m.Mt > 1.4 for m in found)
    assert exceeded <= 0.05 * len(truths)


@pytest.mark.long  # a wide region says why the gains are calm
def test_lags_that_cannot_be_told_apart_are_known_by_sum_and_product():
    """The region holds loops that ring and loops that do not; the limit is kept over both."""
    known_as = merged(SopdtOverdamped(1.0, 5.1, 4.9, 3.0))
    covariance = np.diag([0.02**2, 1.5**2, 0.3**2, 0.05**2])
    gains = tune(SopdtOverdamped(1.0, 5.1, 4.9, 3.0), covariance=covariance, known_as=known_as).gains
    rng = np.random.default_rng(3)
    truths = [shifted(known_as, rng.multivariate_normal(np.zeros(4), covariance)) for _ in range(200)]
    assert {truth.structure for truth in truths} == {"sopdt_overdamped", "sopdt_underdamped"}
    assert sum(margins(truth, gains).Ms > 1.4 for truth in truths) <= 0.05 * len(truths)
    alone = tune(SopdtOverdamped(1.0, 5.1, 4.9, 3.0)).gains
    assert sum(margins(truth, alone).Ms > 1.4 for truth in truths) > 0.2 * len(truths)


@pytest.mark.one_of(2)
@pytest.mark.parametrize("model", FEW, ids=str)
def test_gains_are_calmer_the_less_is_known(model):
    errors = [design(model, Requirements(), independent(model, share)).iae for share in (1e-4, 0.05, 0.2)]
    assert errors == sorted(errors)
    assert errors[0] == pytest.approx(design(model).iae, rel=0.01)


def test_a_wide_region_says_why_the_gains_are_calm():
    found = design(MODELS[0], Requirements(), independent(MODELS[0], 0.3))
    assert any("not known well enough" in warning for warning in found.warnings)
    assert design(MODELS[0], Requirements(), independent(MODELS[0], 0.01)).warnings == ()


def test_interval_of_the_gain_from_that_of_the_static_gain_by_hand():
    # Only K is uncertain, by 2 %: Kp goes as 1/K, the times do not move.
    found = design(Fopdt(2.0, 10.0, 2.0), Requirements(), np.diag([0.04**2, 0.0, 0.0]))
    low, high = found.intervals["Kp"].low, found.intervals["Kp"].high
    assert math.sqrt(low * high) == pytest.approx(found.gains.Kp, rel=1e-9)
    assert high / found.gains.Kp == pytest.approx(math.exp(1.96 * 0.02), rel=1e-3)
    assert found.intervals["Ti"].high == pytest.approx(found.gains.Ti)


def test_interval_of_the_times_from_a_common_error_of_time_by_hand():
    # T and D wrong by the same factor of 3 %: all times follow it, the gain does not.
    times = np.array([0.0, 10.0, 2.0])
    found = design(Fopdt(2.0, 10.0, 2.0), Requirements(), 0.03**2 * np.outer(times, times))
    assert found.intervals["Ti"].high / found.gains.Ti == pytest.approx(math.exp(1.96 * 0.03), rel=2e-3)
    assert found.intervals["Kp"].high == pytest.approx(found.gains.Kp, rel=2e-3)


def test_intervals_of_a_direct_acting_controller_are_ordered():
    found = design(Fopdt(-2.0, 10.0, 2.0), Requirements(), independent(Fopdt(-2.0, 10.0, 2.0), 0.05))
    assert found.intervals["Kp"].low < found.gains.Kp < found.intervals["Kp"].high < 0.0


def test_shifted_models_stay_physical():
    assert shifted(Fopdt(2.0, 10.0, 2.0), np.array([-5.0, -20.0, -3.0])) == Fopdt(0.4, 2.0, 0.0)
    assert shifted(Fopdt(-2.0, 10.0, 2.0), np.array([5.0, 0.0, 0.0])) == Fopdt(-0.4, 10.0, 2.0)
    assert shifted(SopdtOverdamped(1.0, 5.0, 4.0, 1.0), np.array([0.0, -1.0, 1.0, 0.0])) == SopdtOverdamped(
        1.0, 5.0, 4.0, 1.0
    )
    assert shifted(SopdtUnderdamped(1.0, 1.0, 1.9, 1.0), np.array([0.0, 0.0, 0.3, 0.0])).structure == "sopdt_overdamped"


@pytest.mark.parametrize(
    "covariance",
    [
        np.full((3, 3), math.nan),
        np.diag([1.0, 1.0]),
        np.diag([1.0, -1.0, 1.0]),
        np.array([[1.0, 5.0, 0.0], [5.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    ],
)
def test_a_covariance_that_is_none_is_refused(covariance):
    with pytest.raises(InputError) as caught:
        tune(Fopdt(2.0, 10.0, 2.0), covariance=covariance)
    assert caught.value.field == "covariance"
