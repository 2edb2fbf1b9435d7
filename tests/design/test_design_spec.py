"""What a user asks of gains reaches them."""

import math

import numpy as np
import pytest

from autotuner.core.design import (
    Basis,
    DesignSpec,
    Noise,
    controller_response,
    design_from_spec,
    design_spec_from,
    noise_of,
)
from autotuner.core.model.process import Fopdt, SopdtOverdamped, frequency_response
from autotuner.errors import InputError

BASIS = Basis(SopdtOverdamped(2.0, 10.0, 3.0, 1.5))
NOISE = Noise(0.1, 0.5)


def test_nothing_asked_is_the_balanced_goal():
    found = design_from_spec(BASIS, DesignSpec())
    assert (found.goal, found.rule) == ("balanced", "robust")
    assert found.margins.Ms == pytest.approx(1.4, abs=0.005)


@pytest.mark.parametrize("Ms", [1.2, 1.55])
def test_a_sensitivity_in_numbers_is_kept_and_used(Ms):
    found = design_from_spec(BASIS, DesignSpec(Ms=Ms))
    assert found.goal == f"Ms {Ms:g}"
    assert max(found.margins.Ms, found.margins.Mt) == pytest.approx(Ms, abs=0.01)


def test_a_controller_without_derivative_action():
    found = design_from_spec(BASIS, DesignSpec(controller="PI"))
    assert found.goal == "balanced, PI"
    assert found.gains.Td == 0.0
    assert math.isinf(design_from_spec(BASIS, DesignSpec(controller="P")).gains.Ti)


@pytest.mark.one_of(2)
@pytest.mark.parametrize(("lag_s", "dead_time_s", "is_poor"), [(10.0, 1.0, True), (1.0, 10.0, False)])
def test_asked_for_pi_the_design_reports_what_that_costs(lag_s, dead_time_s, is_poor):
    """Two equal lags need a derivative; a dead time gains nothing from one."""
    basis = Basis(SopdtOverdamped(1.0, lag_s, lag_s, dead_time_s))
    pi, pid = (design_from_spec(basis, DesignSpec(controller=controller)) for controller in ("PI", "PID"))
    assert any("suits this process poorly" in warning for warning in pi.warnings) is is_poor
    assert (pi.iae > 1.3 * pid.iae) is is_poor
    assert not any("poorly" in warning for warning in pid.warnings)


def test_asked_for_p_the_design_reports_the_lasting_error():
    assert any("lasting error" in warning for warning in design_from_spec(BASIS, DesignSpec(controller="P")).warnings)


def test_set_point_tracking_and_load_want_other_gains():
    loads, steps = (design_from_spec(BASIS, DesignSpec(purpose=purpose)) for purpose in ("load", "set_point"))
    assert loads.iae < steps.iae
    assert steps.gains.b == 1.0


def test_a_closed_loop_time_is_kept_where_it_is_robust():
    """SIMC (Skogestad 2003, equations 23 to 25) for the second order, series turned into ideal form."""
    model = BASIS.model
    tau = 6.0
    Kc, Ti, Td = model.T1 / (model.K * (tau + model.D)), min(model.T1, 4.0 * (tau + model.D)), model.T2
    found = design_from_spec(BASIS, DesignSpec(tau_c_s=tau))
    assert found.rule == "simc_pid"
    assert found.gains.Kp == pytest.approx(Kc * (1.0 + Td / Ti), rel=1e-6)
    hasty = design_from_spec(BASIS, DesignSpec(tau_c_s=0.1))
    assert hasty.rule == "robust"
    assert any("needs more than Ms" in warning for warning in hasty.warnings)


def test_the_jitter_of_the_output_is_told_and_kept():
    """Against the integral over frequencies, taken here on a grid of its own."""
    noisy = Basis(BASIS.model, None, 0.0, NOISE)
    free, quiet = design_from_spec(noisy, DesignSpec()), design_from_spec(noisy, DesignSpec(jitter=0.05))
    w = np.linspace(1e-5, math.pi / NOISE.sample_time_s, 200_001)
    for found in (free, quiet):
        C = controller_response(found.gains, w)
        R = C / (1.0 + C * frequency_response(BASIS.model, w))
        variance = NOISE.sigma**2 * NOISE.sample_time_s / math.pi * np.trapezoid(np.abs(R) ** 2, w)
        assert found.jitter == pytest.approx(math.sqrt(variance), rel=0.02)
    assert quiet.jitter <= 0.05 * 1.01 < free.jitter


def test_a_jitter_without_measured_noise_limits_nothing_and_says_so():
    found = design_from_spec(BASIS, DesignSpec(jitter=0.05))
    assert found.jitter is None
    assert any("no noise was measured" in warning for warning in found.warnings)


def test_a_rule_is_named_by_itself():
    found = design_from_spec(Basis(Fopdt(2.0, 10.0, 1.5)), DesignSpec(rule="simc_pi", tau_c_s=3.0))
    assert (found.goal, found.rule) == (None, "simc_pi")
    assert found.gains.Kp == pytest.approx(10.0 / (2.0 * 4.5))


@pytest.mark.parametrize(
    ("asked", "field"),
    [
        ({"goal": "fast"}, "goal"),
        ({"rule": "magic"}, "rule"),
        ({"Ms": 1.0}, "requirements.Ms"),
        ({"Ms": math.nan}, "requirements.Ms"),
        ({"controller": "D"}, "controller"),
        ({"purpose": "both"}, "purpose"),
        ({"tau_c_s": 0.0}, "tau_c_s"),
        ({"jitter": -1.0}, "jitter"),
    ],
)
def test_a_wish_that_cannot_be_is_refused_by_name(asked, field):
    with pytest.raises(InputError) as refused:
        DesignSpec(**asked)
    assert refused.value.field == field


def test_a_wish_goes_through_json_and_older_requests_have_less():
    spec = DesignSpec("brisk", Ms=1.5, controller="PI", jitter=0.2)
    assert design_spec_from(spec.to_dict()) == spec
    assert design_spec_from({"structure": "auto", "goal": "calm", "rule": None}) == DesignSpec("calm")


@pytest.mark.parametrize("values", [(0.0, 1.0), (0.1, 0.0), (math.nan, 1.0)])
def test_noise_that_is_none_is_refused(values):
    with pytest.raises(InputError, match="noise"):
        Noise(*values)


@pytest.mark.parametrize(
    ("sigma", "rmse", "expected"),
    [(0.2, 0.05, 0.05), (0.05, 0.2, 0.05), (0.05, 0.06, 0.06), (0.0, 0.1, None), (math.nan, 0.1, None)],
)
def test_the_noise_is_what_the_model_leaves_unless_that_is_much_more(sigma, rmse, expected):
    found = noise_of(sigma, rmse, 0.5)
    assert (found.sigma if found else None) == expected
