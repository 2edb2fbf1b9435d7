"""The process as a controller meets it: gains are for the loop that is there, effects included."""

from dataclasses import replace

import numpy as np
import pytest

from autotuner.core.diagnosis.findings.controller_view import controller_view
from autotuner.core.diagnosis.findings.result import FoundEffect
from autotuner.core.model.process import (
    Fopdt,
    Integrating,
    SopdtOverdamped,
    SopdtUnderdamped,
    frequency_response,
    model_to_dict,
)

PLANT = Fopdt(2.0, 10.0, 1.5)
COVARIANCE = np.diag([0.04, 0.25, 0.01])


def found(name, interval95=None, **sizes):
    return FoundEffect(name, "actuator", sizes, interval95 or {}, 1.0)


@pytest.mark.parametrize(
    ("effect", "changed"),
    [
        (found("backlash", width=2.0), {}),
        (found("periodic_disturbance", period_s=23.0, amplitude=1.0), {}),
        (found("direction_gain", ratio=2.5), {"K": 5.0}),
        (found("direction_gain", ratio=0.4), {}),
        (found("direction_dynamics", rise_over_fall=1.5), {"K": 3.0}),
        (found("direction_dynamics", rising_lag_s=0.3, falling_lag_s=0.8), {"D": 2.3}),
        (found("actuator_hold", period_s=1.0), {"D": 2.0}),
        (found("rate_limit", rate_per_s=0.5), {}),
        (found("rate_limit", rate_per_s=0.5, lag_s=0.4), {"D": 1.9}),
        (found("flow_delay", flow_per_output=0.05, longest_over_first=1.6), {"D": 2.4}),
        (found("dead_time_jump", at_s=100.0, later_over_first=1.6), {"D": 2.4}),
        (found("dead_time_jump", at_s=100.0, later_over_first=0.6), {}),
        (found("sensor_hysteresis", width=0.6), {}),
    ],
)
def test_what_acts_in_the_loop_is_counted(effect, changed):
    met = controller_view(PLANT, COVARIANCE, [effect])
    assert met.model.parameters() == pytest.approx({"K": 2.0, "T": 10.0, "D": 1.5} | changed)
    assert bool(met.changes) is bool(changed)


def test_the_error_of_the_gain_grows_with_the_gain():
    """K 2 +- 0.2 times 2.5 is 5 +- 0.5."""
    met = controller_view(PLANT, COVARIANCE, [found("direction_gain", ratio=2.5)])
    assert np.diag(met.covariance) == pytest.approx([0.25, 0.25, 0.01])


@pytest.mark.parametrize(
    ("process", "expected"),
    [
        (PLANT, {"structure": "inverse_response", "K": 2.0, "T1": 10.0, "T2": 0.0, "Z": 0.4, "D": 1.5}),
        (
            SopdtOverdamped(2.0, 10.0, 3.0, 1.5),
            {"structure": "inverse_response", "K": 2.0, "T1": 10.0, "T2": 3.0, "Z": 0.4, "D": 1.5},
        ),
        (
            SopdtUnderdamped(2.0, 25.0, 4.0, 1.5),
            {"structure": "inverse_response_underdamped", "K": 2.0, "m": 25.0, "n": 4.0, "Z": 0.4, "D": 1.5},
        ),
    ],
)
def test_an_inverse_response_is_part_of_the_process(process, expected):
    met = controller_view(process, None, [found("inverse_response", Z=0.4)])
    assert model_to_dict(met.model) == pytest.approx(expected)
    assert met.covariance is None


def test_a_zero_brings_its_own_error():
    """Z 0.4 +- 0.196 is a standard error of 0.1; T2 is not there, so it has none."""
    met = controller_view(PLANT, COVARIANCE, [found("inverse_response", {"Z": (0.204, 0.596)}, Z=0.4)])
    assert list(met.model.parameters()) == ["K", "T1", "T2", "Z", "D"]
    assert np.diag(met.covariance) == pytest.approx([0.04, 0.25, 0.0, 0.01, 0.01])


@pytest.mark.parametrize(("process", "Z"), [(Integrating(0.2, 1.0, 1.5), 0.4), (PLANT, -0.4)])
def test_a_zero_that_no_model_holds_leaves_no_process(process, Z):
    assert controller_view(process, None, [found("inverse_response", Z=Z)]) is None


def test_no_model_holds_a_second_way_with_a_lag_of_its_own():
    """Gains that ignore it could be unstable."""
    assert controller_view(PLANT, None, [found("inverse_response", time_constant_s=2.0, share_against=0.4)]) is None


@pytest.mark.parametrize(
    ("share", "time_constant_s", "held"), [(0.4, 200.0, True), (0.9, 15.0, False), (1.2, 200.0, False)]
)
def test_a_slow_mode_is_left_out_only_where_it_is_slow_and_small(share, time_constant_s, held):
    """Two thirds of the gain behind 200 s hardly show where a loop on 10 s turns over; 9 times it behind 15 s do."""
    met = controller_view(PLANT, COVARIANCE, [found("slow_mode", share=share, time_constant_s=time_constant_s)])
    assert (met is not None) is held
    assert met is None or met.model == PLANT


@pytest.mark.parametrize(("process", "share", "held"), [(PLANT, 0.6, True), (Fopdt(2.0, 10.0, 30.0), 0.6, False)])
def test_a_recycle_is_left_out_only_where_what_comes_back_is_small(process, share, held):
    """A lag of 10 s behind 1.5 s of dead time passes a tenth where a loop turns over, behind 30 s three quarters."""
    met = controller_view(process, COVARIANCE, [found("recycle", share=share, return_time_s=30.0)])
    assert (met is not None) is held
    assert met is None or met.model == process


@pytest.mark.parametrize(
    ("process", "expected"),
    [
        (PLANT, {"structure": "sopdt_overdamped", "K": 2.0, "T1": 10.0, "T2": 4.0, "D": 1.5}),
        (
            SopdtOverdamped(2.0, 10.0, 3.0, 1.5),
            {"structure": "third_order", "K": 2.0, "T1": 10.0, "T2": 4.0, "T3": 3.0, "D": 1.5},
        ),
        (
            SopdtUnderdamped(2.0, 25.0, 4.0, 1.5),
            {"structure": "third_order_underdamped", "K": 2.0, "m": 25.0, "n": 4.0, "T": 4.0, "D": 1.5},
        ),
        (Integrating(0.2, 1.0, 1.5), {"structure": "integrating", "K": 0.2, "T": 1.0, "D": 5.5}),
    ],
)
def test_a_further_lag_is_part_of_the_process(process, expected):
    met = controller_view(process, None, [found("extra_lag", time_constant_s=4.0)])
    assert model_to_dict(met.model) == pytest.approx(expected)


def test_two_further_lags_are_one_by_the_half_rule():
    """Two lags of 2 s: the second one goes half to the first, and half to the dead time (Skogestad)."""
    two = replace(found("extra_lag", time_constant_s=4.0), form="third and fourth")
    met = controller_view(PLANT, None, [two]).model
    assert model_to_dict(met) == pytest.approx(
        {"structure": "sopdt_overdamped", "K": 2.0, "T1": 10.0, "T2": 3.0, "D": 2.5}
    )
    w = np.geomspace(0.01, 0.25, 30)  # up to where the phase is -180 degrees
    exact = 2.0 * np.exp(-1.5j * w) / (10j * w + 1.0) / (2j * w + 1.0) ** 2
    assert np.abs(frequency_response(met, w) / exact - 1.0).max() < 0.05


def test_a_further_lag_brings_its_own_error():
    """4 s +- 0.196 is a standard error of 0.1 of the shorter lag."""
    met = controller_view(
        PLANT, COVARIANCE, [found("extra_lag", {"time_constant_s": (3.804, 4.196)}, time_constant_s=4.0)]
    )
    assert list(met.model.parameters()) == ["K", "T1", "T2", "D"]
    assert np.diag(met.covariance) == pytest.approx([0.04, 0.25, 0.01, 0.01], rel=1e-2)
