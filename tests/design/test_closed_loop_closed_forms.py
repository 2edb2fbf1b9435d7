"""Simulated loops against the responses that a textbook writes down for them."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotuner.core.design import PidGains, PidSettings, Prediction, Scenario, predict
from autotuner.core.model.process import Fopdt, Integrating, NLags, SopdtOverdamped, SopdtUnderdamped, ThirdOrder


def test_a_cancelled_lag_follows_a_set_point_as_first_order():
    """`Ti = T` leaves `L = K Kp/(T s)`: `y = 1 - e^{-t/tau}`, `tau = T/(K Kp)`; IAE `tau`, settled at `ln 50 tau`."""
    found = predict(Fopdt(2.0, 10.0, 0.0), PidSettings(PidGains(1.0, 10.0)), Scenario(60.0, 0.01, set_point_step=3.0))
    np.testing.assert_allclose(found.pv, 3.0 * (1.0 - np.exp(-found.t / 5.0)), atol=0.006)
    assert found.iae == pytest.approx(15.0, rel=2e-3)
    assert found.settling_time_s == pytest.approx(5.0 * math.log(50.0), rel=2e-3)
    assert found.overshoot == 0.0


def test_a_cancelled_lag_meets_a_load_with_two_exponentials():
    """`K s T/((T s + 1)(s T + K Kp))` times `1/s`: `K (e^{-t/T} - e^{-t/tau})/(K Kp - 1)`."""
    found = predict(Fopdt(2.0, 10.0, 0.0), PidSettings(PidGains(1.0, 10.0)), Scenario(80.0, 0.01, load_step=1.5))
    expected = 1.5 * 2.0 * (np.exp(-found.t / 10.0) - np.exp(-found.t / 5.0))
    np.testing.assert_allclose(found.pv, expected, atol=0.004)


@given(st.floats(0.3, 5.0), st.floats(0.5, 5.0))
@settings(max_examples=6, deadline=None)
def test_the_overshoot_of_a_second_order_loop_is_that_of_its_damping(loop_gain, lag):
    """`K Kp/(T s^2 + s + K Kp)`: damping `1/(2 sqrt(K Kp T))`, overshoot `e^{-pi z/sqrt(1 - z^2)}`."""
    z = 0.5 / math.sqrt(loop_gain * lag)
    h = 5e-3 * lag / max(1.0, math.sqrt(loop_gain * lag))
    found = predict(
        Integrating(0.5, lag, 0.0), PidSettings(PidGains(2.0 * loop_gain)), Scenario(9.0 * lag, h, set_point_step=-2.0)
    )
    expected = math.exp(-math.pi * z / math.sqrt(1.0 - z * z)) if z < 1.0 else 0.0
    assert found.overshoot == pytest.approx(expected, abs=0.02)


def test_an_integrator_with_dead_time_follows_by_the_method_of_steps():
    """P control, `k = K Kp`: 0 up to D, then `k (t - D)`, from 2 D on less `k^2 (t - 2 D)^2/2`."""
    D, k, h = 2.0, 0.3, 0.002
    found = predict(Integrating(0.1, 0.0, D), PidSettings(PidGains(3.0)), Scenario(3.0 * D, h, set_point_step=1.0))
    late, later = np.maximum(found.t - D, 0.0), np.maximum(found.t - 2.0 * D, 0.0)
    np.testing.assert_allclose(found.pv, k * late - k * k * later**2 / 2.0, atol=2.0 * k * h)


def test_a_dead_time_between_two_samples_by_hand():
    """An integrator, D = 1.3, samples of 0.5: the output 0.4 acts from 1.3 on, that of t = 1.5, 0.368, from 2.8 on."""
    found = predict(Integrating(1.0, 0.0, 1.3), PidSettings(PidGains(0.4)), Scenario(3.0, 0.5, set_point_step=1.0))
    assert found.t == pytest.approx([0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0])
    assert found.pv == pytest.approx([0.0, 0.0, 0.0, 0.08, 0.28, 0.48, 0.6736])
    assert found.output[:5] == pytest.approx([0.4, 0.4, 0.4, 0.368, 0.288])


LOOPS = [
    (Fopdt(2.0, 10.0, 1.3), PidGains(1.4, 9.0)),
    (SopdtOverdamped(2.0, 10.0, 3.0, 1.5), PidGains(1.2, 12.0, 2.0, 0.4)),
    (SopdtUnderdamped(-1.0, 4.0, 1.0, 0.7), PidGains(-0.3, 2.0, 0.5, 0.2, 0.4)),
    (NLags(0.5, 3.0, 4.0, 0.6), PidGains(1.5, 10.0, 2.0, 0.2, N=8.0)),
    (ThirdOrder(1.0, 8.0, 4.0, 1.0, 0.3), PidGains(1.5, 10.0, 1.0, 0.1)),
    (Integrating(0.1, 1.0, 1.0), PidGains(1.5, 25.0, 0.5, 0.1)),
]


@pytest.mark.parametrize(("model", "gains"), LOOPS, ids=str)
@pytest.mark.parametrize("h", [0.15, 0.37])
def test_the_integral_of_the_error_after_a_load_is_the_integral_time_over_the_gain(model, gains, h):
    """The controller ends at the output `-load`, and the integral part alone holds it: `Kp/Ti int e = -load`."""
    found = predict(model, PidSettings(gains), Scenario(300.0, h, load_step=0.7))
    assert np.trapezoid(found.error, found.t) == pytest.approx(-0.7 * gains.Ti / gains.Kp, rel=1e-6)
    assert found.output[-1] == pytest.approx(-0.7, rel=1e-6)


@pytest.mark.parametrize(("model", "gains"), LOOPS[:5], ids=str)
def test_the_integral_of_the_error_after_a_set_point_step_includes_weight_and_filter(model, gains):
    """At the end `r/K = I - Kp (1 - b) r`; the filtered PV lags by `Tf r`: `int e = (Ti (1/(K Kp) + 1 - b) - Tf) r`."""
    found = predict(model, PidSettings(gains), Scenario(300.0, 0.15, set_point_step=2.0))
    expected = 2.0 * (gains.Ti * (1.0 / (model.K * gains.Kp) + 1.0 - gains.b) - gains.Tf)
    assert np.trapezoid(found.error, found.t) == pytest.approx(expected, rel=1e-6)
    assert found.output[-1] == pytest.approx(2.0 / model.K, rel=1e-6)


@given(st.floats(0.1, 10.0), st.floats(0.1, 10.0))
@settings(max_examples=15, deadline=None)
def test_a_loop_in_other_units_is_the_same_loop(gain, time):
    """`K -> a K` with `Kp -> Kp/a`, all times by one factor: the same PV at the stretched times."""
    plain = predict(Fopdt(2.0, 10.0, 1.3), PidSettings(PidGains(1.4, 9.0, 0.5, 0.1)), Scenario(30.0, 0.2, 1.0))
    other = PidGains(1.4 / gain, 9.0 * time, 0.5 * time, 0.1 * time)
    scaled = predict(
        Fopdt(2.0 * gain, 10.0 * time, 1.3 * time), PidSettings(other), Scenario(30.0 * time, 0.2 * time, 1.0)
    )
    n = min(plain.pv.size, scaled.pv.size)
    np.testing.assert_allclose(scaled.pv[:n], plain.pv[:n], atol=1e-9)
    np.testing.assert_allclose(gain * scaled.output[:n], plain.output[:n], atol=1e-9)


def test_responses_to_set_point_and_load_add_up():
    model, controller = SopdtOverdamped(2.0, 10.0, 3.0, 1.5), PidSettings(PidGains(1.2, 12.0, 2.0, 0.4))
    both, first, second = (
        predict(model, controller, Scenario(60.0, 0.3, set_point_step=r, load_step=d))
        for r, d in ((2.0, -0.5), (1.0, 0.0), (0.0, 1.0))
    )
    np.testing.assert_allclose(both.pv, 2.0 * first.pv - 0.5 * second.pv, atol=1e-9)


def test_figures_of_a_response_by_hand():
    """Errors 4, 2, -1, 0.05, 0.05: IAE 3 + 1.5 + 0.525 + 0.05; outside of 0.08 up to the third sample."""
    t, error = np.arange(5.0), np.array([4.0, 2.0, -1.0, 0.05, 0.05])
    found = Prediction(t, np.full(5, 4.0), 4.0 - error, np.zeros(5))
    assert found.iae == pytest.approx(5.075)
    assert found.overshoot == pytest.approx(0.25)
    assert found.settling_time_s == 2.0
    np.testing.assert_allclose(found.error, error)
    mirrored = Prediction(t, np.full(5, -4.0), error - 4.0, np.zeros(5))
    assert (mirrored.overshoot, mirrored.settling_time_s) == pytest.approx((0.25, 2.0))
    assert Prediction(t, np.zeros(5), error, np.zeros(5)).overshoot == 0.0
