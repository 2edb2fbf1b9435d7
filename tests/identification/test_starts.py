"""A known model as the start of least squares, in place of a scan."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

import autotuner_sim
from autotuner.core.estimation import optimiser
from autotuner.core.estimation.data import ANY_GAIN, data_of
from autotuner.core.estimation.initial_guesses import Start, starts_from
from autotuner.core.estimation.least_squares import candidate_of
from autotuner.core.estimation.variable_projection import Projection
from autotuner.core.identification import running_model
from autotuner.core.model.process import Fopdt, Integrating, SopdtOverdamped, UnstableFopdt, second_order
from autotuner.core.model.structures import FOPDT, INTEGRATING, PURE_INTEGRATOR, SECOND_ORDER, THIRD_ORDER, searched
from autotuner.core.recording import Recording
from benchmarks.accuracy.estimates.learned import record

TRUTH = {"K": 2.0, "T": 10.0, "D": 1.5}


@pytest.mark.parametrize(("model", "structure", "shape"), [
    (Fopdt(2.0, 10.0, 1.5), FOPDT, (10.0,)),
    (SopdtOverdamped(2.0, 6.0, 3.0, 1.5), SECOND_ORDER, (9.0, 2.0)),
    (second_order(2.0, 25.0, 5.0, 1.5), SECOND_ORDER, (5.0, 5.0)),
    (Integrating(2.0, 0.0, 1.5), PURE_INTEGRATOR, ()),
])  # fmt: skip
def test_a_model_of_the_same_structure_is_one_as_it_is(model, structure, shape):
    (start,) = starts_from(model, structure)
    assert start.shape == pytest.approx(shape)
    assert start.delay_s == 1.5


@pytest.mark.parametrize("model", [
    Fopdt(2.0, 10.0, 0.0),
    Fopdt(2.0, 1.0, 30.0),
    SopdtOverdamped(2.0, 6.0, 0.0, 1.5),
    SopdtOverdamped(2.0, 6.0, 6.0, 1.5),
    second_order(2.0, 25.0, 9.0, 1.5),
])  # fmt: skip
@pytest.mark.parametrize("structure", [FOPDT, SECOND_ORDER])
def test_a_near_structure_starts_with_the_same_sum_of_lags_and_dead_time(model, structure):
    (start,) = starts_from(model, structure)
    assert min(start.shape) > 0.0
    assert start.shape[0] + start.delay_s == pytest.approx(model.rational().a[1] + model.D)


RINGS = second_order(2.0, 25.0, 0.5, 1.5)


@pytest.mark.parametrize("model", [RINGS, Integrating(2.0, 0.0, 1.5), Integrating(2.0, 8.0, 0.0)])
@pytest.mark.parametrize("structure", [FOPDT, SECOND_ORDER, PURE_INTEGRATOR])
def test_what_rings_or_integrates_starts_with_positive_times(model, structure):
    (start,) = starts_from(model, structure)
    assert all(0.0 < value < math.inf for value in (*start.shape, start.delay_s or 1.0))


@pytest.mark.parametrize(("model", "structure"), [
    (None, FOPDT),
    (UnstableFopdt(2.0, 10.0, 1.5), FOPDT),
    (Fopdt(2.0, 10.0, 1.5), INTEGRATING),
    (Fopdt(2.0, 10.0, 1.5), THIRD_ORDER),
    (Integrating(2.0, 0.0, 0.0), FOPDT),
])  # fmt: skip
def test_another_is_none(model, structure):
    assert starts_from(model, structure) == ()


def step_response():
    """Return the step response of `TRUTH` in closed form, noise 0.05."""
    t = np.arange(0.0, 60.0, 0.2)
    late = np.maximum(t - 11.5, 0.0)
    pv = 20.0 * (1.0 - np.exp(-late / 10.0)) + np.random.default_rng(2).normal(0.0, 0.05, t.size)
    return Recording(t, np.where(t >= 10.0, 10.0, 0.0), pv)


@pytest.mark.parametrize("begun", [
    None, Fopdt(2.0, 10.0, 1.5), Fopdt(50.0, 900.0, 0.1), SopdtOverdamped(2.0, 7.0, 4.0, 1.0),
    Integrating(0.2, 1.0, 1.5),
])  # fmt: skip
def test_where_it_begins_does_not_change_where_it_ends(begun):
    found = running_model(step_response(), 0.05, begun)
    assert found.model.parameters() == pytest.approx(TRUTH, rel=0.01)


@pytest.mark.parametrize(("begun", "scans"), [
    (None, True),
    (Fopdt(2.0, 5.0, 2.0), False),
    (Fopdt(2.0, 5.0, 12.0), True),
    (Fopdt(2.0, 5.0, 500.0), True),
])  # fmt: skip
def test_a_scan_is_made_only_where_the_known_model_leads_nowhere(begun, scans, monkeypatch):
    """From a dead time of more than a half period no search comes back; the scan finds the process all the same."""
    asked = []
    scan = optimiser.scans
    monkeypatch.setattr(optimiser, "scans", lambda *arguments: asked.append(arguments) or scan(*arguments))
    recording = record(autotuner_sim.Fopdt(2.0, 10.0, 4.0), 3, 30.0, 1)
    found = running_model(recording, recording.settings["noise_sigma"], begun)
    assert bool(asked) is scans
    assert found.model.parameters() == pytest.approx({"K": 2.0, "T": 10.0, "D": 4.0}, rel=0.015)


def test_where_no_model_explains_the_record_the_nearest_one_shows_the_kind_of_process():
    """Noise of 0.3 where 0.01 was seen at rest: nothing explains it, and the nearest model is the process still."""
    quiet = step_response()
    loud = replace(quiet, pv=quiet.pv + np.random.default_rng(4).normal(0.0, 0.3, quiet.t.size))
    assert running_model(loud, 0.01) is None
    found = running_model(loud, 0.01, nearest=True)
    assert not found.explains
    assert found.model.parameters()["K"] == pytest.approx(TRUTH["K"], rel=0.03)


def test_slopes_that_underflow_move_nothing_and_warn_of_nothing(monkeypatch):
    """A response that ends within a sample has slopes of about 1e-155, whose covariance overflowed in SciPy."""
    slopes = Projection.sensitivities
    monkeypatch.setattr(Projection, "sensitivities", lambda self, theta: slopes(self, theta) * (1.0, 1e-155))
    start = Start((5.0,), 1.5, 0.0)
    data = data_of(record(autotuner_sim.Fopdt(2.0, 10.0, 1.5), 3, 30.0, 1))
    found = optimiser.refine(data, FOPDT, ("offset",), start)
    assert found.start.delay_s == start.delay_s
    assert found.start.shape == pytest.approx((10.0,), rel=0.02)


@pytest.mark.parametrize("structure", searched("auto"), ids=lambda structure: structure.name)
def test_whatever_the_search_tries_is_a_number(structure):
    """A search that runs away tries lags of any length, and a product of several must not be without end."""
    t = np.arange(120) * 0.5
    data = data_of(Recording(t, np.repeat([0.0, 1.0, -1.0, 1.0, 0.0], 24), np.sin(t)))
    problem = Projection(data, structure, ("offset",), 1.0)
    for logarithms in itertools.product((-1e3, -110.0, 0.0, 110.0, 260.0, 1e3), repeat=len(structure.shape)):
        theta = np.array([*logarithms, 1.3])
        assert np.isfinite(problem.residual(theta)).all()
        assert np.isfinite(problem.jacobian(theta)).all()


def test_a_dead_time_longer_than_the_record_is_no_process():
    t = np.arange(120) * 0.5
    data = data_of(Recording(t, np.repeat([0.0, 1.0, -1.0, 1.0, 0.0], 24), np.sin(t)))
    found = optimiser.refine(data, INTEGRATING, ("offset", "state"), Start((5.0,), 70.0, 0.0))
    assert candidate_of(found, ANY_GAIN, 0, 1e-9) is None
