"""The advised controller: what fewer parts cost, judged on loops of the simulator and by closed forms."""

import numpy as np
import pytest

from autotuner.core.design import Basis, Controller, DesignSpec, Requirements, design, design_from_spec, with_prediction
from autotuner.core.design.controller_advice import controller_advice
from autotuner.core.design.simulation.pid import PidSettings, started, step
from autotuner.core.model.process import Fopdt, Integrating, SopdtOverdamped
from autotuner_sim.plants import PLANTS
from autotuner_sim.stepped import SteppedPlant

SCAN_S = 0.02


def load_response(model, gains, duration_s):
    """Return the PV of the simulator's loop after a unit load step, which enters beside the output."""
    plant = SteppedPlant(PLANTS[model.structure](**model.parameters()))
    settings = PidSettings(gains)
    state = started(settings, -SCAN_S, 0.0, 0.0, 0.0)
    pv = np.empty(round(duration_s / SCAN_S))
    for k in range(pv.size):
        plant.advance(k * SCAN_S)
        pv[k] = plant.pv
        state = step(settings, state, k * SCAN_S, pv[k], 0.0)
        plant.output = state.output + 1.0
    return pv


@pytest.mark.one_of(3)
@pytest.mark.parametrize("model", [Fopdt(2.0, 10.0, 1.5), SopdtOverdamped(1.0, 3.0, 3.0, 1.0), Fopdt(1.0, 1.0, 5.0)])
def test_the_cost_of_pi_is_that_of_simulated_loops(model):
    advice = controller_advice(model)
    errors = [
        np.abs(load_response(model, design(model, Requirements(controller=part)).gains, 100.0)).sum()
        for part in (Controller.PI, Controller.PID)
    ]
    assert pytest.approx(errors[0] / errors[1], rel=0.05) == advice.PI


def test_the_share_that_p_leaves_is_that_of_a_simulated_loop():
    model = Fopdt(2.0, 10.0, 1.5)
    gains = design(model, Requirements(controller=Controller.P)).gains
    assert pytest.approx(load_response(model, gains, 100.0)[-1] / model.K, rel=0.01) == controller_advice(model).P


@pytest.mark.parametrize(
    ("model", "controller"),
    [
        (Fopdt(2.0, 10.0, 1.5), "PID"),
        (SopdtOverdamped(1.0, 10.0, 10.0, 1.0), "PID"),
        (Fopdt(1.0, 1.0, 20.0), "PI"),
        (Integrating(0.1, 0.5, 1.0), "PID"),
    ],
    ids=str,
)
def test_a_derivative_is_advised_where_there_are_lags_to_lead(model, controller):
    advice = controller_advice(model)
    assert advice.controller == controller
    assert str(advice).startswith(controller)
    assert (advice.P is None) is isinstance(model, Integrating)


def test_a_design_carries_the_advice_whatever_was_asked():
    basis = Basis(Fopdt(2.0, 10.0, 1.5))
    for controller in ("PI", "PID"):
        found = with_prediction(design_from_spec(basis, DesignSpec(controller=controller)), basis)
        assert found.to_dict()["advice"]["costs"]["PI"] == pytest.approx(1.82, abs=0.02)


def test_asked_for_a_poor_one_the_cost_is_reported_in_per_cent():
    basis = Basis(SopdtOverdamped(1.0, 10.0, 10.0, 1.0))
    cost = 100.0 * (controller_advice(basis.model).PI - 1.0)
    (warning,) = (text for text in design_from_spec(basis, DesignSpec(controller="PI")).warnings if "poorly" in text)
    assert f"{cost:.0f} % larger" in warning
