"""A known model as a start of least squares."""

import numpy as np
import pytest

from autotuner.core.estimation.initial_guesses import starts_from
from autotuner.core.identification import running_model
from autotuner.core.model.process import Fopdt, Integrating, SopdtOverdamped, second_order
from autotuner.core.model.structures import FOPDT, PURE_INTEGRATOR, SECOND_ORDER
from autotuner.core.recording import Recording


@pytest.mark.parametrize(("model", "structure", "shape"), [
    (Fopdt(2.0, 10.0, 1.5), FOPDT, (10.0,)),
    (SopdtOverdamped(2.0, 6.0, 3.0, 1.5), SECOND_ORDER, (9.0, 2.0)),
    (second_order(2.0, 25.0, 5.0, 1.5), SECOND_ORDER, (5.0, 5.0)),
])  # fmt: skip
def test_a_model_of_the_same_kind_is_one(model, structure, shape):
    (start,) = starts_from(model, structure)
    assert start.shape == pytest.approx(shape)
    assert start.delay_s == 1.5


@pytest.mark.parametrize(("model", "structure"), [
    (None, FOPDT),
    (Fopdt(2.0, 10.0, 1.5), SECOND_ORDER),
    (Integrating(2.0, 10.0, 1.5), FOPDT),
    (Integrating(2.0, 0.0, 1.5), PURE_INTEGRATOR),
])  # fmt: skip
def test_another_is_none(model, structure):
    assert starts_from(model, structure) == ()


@pytest.mark.parametrize("begun", [None, Fopdt(2.0, 10.0, 1.5), Fopdt(50.0, 900.0, 0.1)])
def test_where_it_begins_does_not_change_where_it_ends(begun):
    """The step response of K 2, T 10 s, D 1.5 s in closed form, noise 0.05."""
    t = np.arange(0.0, 60.0, 0.2)
    late = np.maximum(t - 11.5, 0.0)
    pv = 20.0 * (1.0 - np.exp(-late / 10.0)) + np.random.default_rng(2).normal(0.0, 0.05, t.size)
    found = running_model(Recording(t, np.where(t >= 10.0, 10.0, 0.0), pv), 0.05, begun)
    assert found.model.parameters() == pytest.approx({"K": 2.0, "T": 10.0, "D": 1.5}, rel=0.01)
