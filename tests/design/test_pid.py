import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotuner.core.design import PidGains
from autotuner.core.design.simulation.pid import PidSettings, started, step
from autotuner.errors import InputError


def run(settings, pvs, set_points, h=0.5, output=0.0):
    state = started(settings, 0.0, pvs[0], set_points[0], output)
    outputs = [state.output]
    for k in range(1, len(pvs)):
        state = step(settings, state, k * h, pvs[k], set_points[k])
        outputs.append(state.output)
    return np.array(outputs), state


@given(st.floats(-50.0, 50.0), st.floats(-50.0, 50.0), st.floats(-100.0, 100.0), st.floats(0.0, 1.0))
def test_take_over_at_rest_is_bumpless(pv, set_point, output, b):
    settings = PidSettings(PidGains(2.0, math.inf, 1.0, 0.5, b))
    state = step(settings, started(settings, 0.0, pv, set_point, output), 1.0, pv, set_point)
    assert state.output == pytest.approx(output, abs=1e-9)


def test_integral_of_a_constant_error_by_hand():
    # Kp/Ti = 0.5: an error of 2 raises the output by 1 each second.
    outputs, _ = run(PidSettings(PidGains(2.0, 4.0)), [8.0] * 5, [10.0] * 5, h=1.0, output=3.0)
    assert outputs == pytest.approx([3.0, 4.0, 5.0, 6.0, 7.0])


def test_proportional_part_of_a_set_point_step_by_hand():
    settings = PidSettings(PidGains(2.0, 4.0, b=0.25))
    state = started(settings, 0.0, 0.0, 0.0, 0.0)
    assert step(settings, state, 1.0, 0.0, 1.0).output == pytest.approx(2.0 * 0.25)


def test_derivative_of_a_ramp_by_hand():
    # PV rises by 1 each second: P part falls by 2 (PV - Tf) and D part is -2 * 3 * 1 once the filter has settled.
    settings = PidSettings(PidGains(2.0, Td=3.0, Tf=0.5))
    outputs, state = run(settings, list(range(40)), [0.0] * 40, h=1.0)
    assert state.slope == pytest.approx(1.0)
    assert outputs[-1] == pytest.approx(-2.0 * (39.0 - 0.5) - 6.0)


@given(st.floats(0.05, 5.0), st.floats(0.05, 3.0))
def test_filter_is_exact_for_straight_pieces(Tf, h):
    """Against the same filter run in a hundred small steps over the same straight pieces."""
    settings = PidSettings(PidGains(1.0, Tf=Tf))
    pvs = [0.0, 1.0, 0.5, 0.5, 2.0]
    _, coarse = run(settings, pvs, [0.0] * 5, h=h)
    fine_pvs = np.interp(np.arange(401) / 100.0, np.arange(5), pvs)
    _, fine = run(settings, list(fine_pvs), [0.0] * 401, h=h / 100.0)
    assert (coarse.filtered, coarse.slope) == pytest.approx((fine.filtered, fine.slope), abs=1e-9)


def test_filter_answers_a_sine_with_its_frequency_response():
    Tf, w, h = 0.7, 1.3, 0.01
    t = np.arange(6000) * h
    settings = PidSettings(PidGains(1.0, Tf=Tf))
    outputs, _ = run(settings, list(np.sin(w * t)), [0.0] * t.size, h=h)
    response = -1.0 / (1.0 + 1j * w * Tf - (w * Tf) ** 2 / 2.0)
    expected = np.abs(response) * np.sin(w * t + np.angle(response))
    np.testing.assert_allclose(outputs[2000:], expected[2000:], atol=2e-4)


@given(st.lists(st.floats(-100.0, 100.0), min_size=3, max_size=30), st.floats(0.1, 10.0))
def test_limits_and_slew_are_never_exceeded(pvs, slew):
    settings = PidSettings(PidGains(5.0, 3.0, 0.5, 0.1), -10.0, 20.0, slew)
    outputs, _ = run(settings, pvs, [0.0] * len(pvs), h=0.5, output=1.0)
    assert np.all((outputs >= -10.0) & (outputs <= 20.0))
    assert np.all(np.abs(np.diff(outputs)) <= slew * 0.5 * (1.0 + 1e-9))


def test_integral_does_not_wind_up():
    settings = PidSettings(PidGains(1.0, 2.0), 0.0, 10.0)
    _, state = run(settings, [0.0] * 500, [100.0] * 500)
    # The error turns: with a wound-up integral (100 * 250 s / 2 s) the output would stay at its limit for ever.
    outputs = []
    for k in range(20):
        state = step(settings, state, 250.0 + 0.5 * k, 110.0, 100.0)
        outputs.append(state.output)
    assert outputs[-1] == 0.0
    assert outputs.index(0.0) <= 4


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        ({"low": 5.0, "high": 5.0}, "pid.low"),
        ({"low": math.nan}, "pid.low"),
        ({"slew_per_s": 0.0}, "pid.slew_per_s"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings, field):
    with pytest.raises(InputError) as caught:
        PidSettings(PidGains(1.0), **settings)
    assert caught.value.field == field
