"""The discrete controller sample by sample: sequences worked by hand, and steady states of its own equations."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotuner.core.design import PidGains
from autotuner.core.design.simulation.pid import PidSettings, started, step


def outputs_and_integrals(settings, pvs, set_points, h=1.0, output=0.0, from_rest=0.0):
    state = started(settings, 0.0, from_rest, from_rest, output)
    rows = []
    for k, (pv, set_point) in enumerate(zip(pvs, set_points, strict=True), start=1):
        state = step(settings, state, k * h, pv, set_point)
        rows.append((state.output, state.integral))
    return [row[0] for row in rows], [row[1] for row in rows]


def test_back_calculation_by_hand():
    """Kp = 1, Ti = 2, limit 10, samples of 1 s: half of the excess leaves the integral in each sample.

    1: I 0, wanted 20, excess 10, I -5.   2: I -5 + 10, wanted 25, excess 15, I -2.5.   3: wanted 27.5, I -1.25.
    4, PV 15: the mean error is 12.5, I 5, wanted 10, no excess.   5, PV 19: I 5 + 1.5, wanted 7.5.
    """
    settings = PidSettings(PidGains(1.0, 2.0), 0.0, 10.0)
    outputs, integrals = outputs_and_integrals(settings, [0.0, 0.0, 0.0, 15.0, 19.0], [20.0] * 5)
    assert outputs == pytest.approx([10.0, 10.0, 10.0, 10.0, 7.5])
    assert integrals == pytest.approx([-5.0, -2.5, -1.25, 5.0, 6.5])


@pytest.mark.parametrize(("Td", "tracking_time_s"), [(0.0, 4.0), (1.0, 2.0), (0.25, 1.0)])
def test_the_integral_rests_where_error_and_anti_windup_cancel(Td, tracking_time_s):
    """`Kp e/Ti = (v - u)/Tt`: with e = 20 at the limit 10, `v = Kp e + I` is `10 + 20 Tt/Ti`."""
    settings = PidSettings(PidGains(1.0, 4.0, Td), 0.0, 10.0)
    assert settings.tracking_time == pytest.approx(tracking_time_s)
    _, integrals = outputs_and_integrals(settings, [0.0] * 6000, [20.0] * 6000, h=0.005)
    assert integrals[-1] == pytest.approx(10.0 + 20.0 * tracking_time_s / 4.0 - 20.0, abs=0.06)


def test_a_coarse_sample_takes_no_more_than_the_whole_excess():
    """A sample longer than `Tt` empties the excess once: the next sample starts at the limit, not beyond it."""
    settings = PidSettings(PidGains(1.0, 0.5), -10.0, 10.0)
    outputs, integrals = outputs_and_integrals(settings, [0.0, 0.0], [20.0, 20.0], h=2.0)
    assert outputs == [10.0, 10.0]
    assert integrals == pytest.approx([-10.0, -10.0])


def test_slew_by_hand_on_both_sides():
    """At most 3 in a sample: towards 8, then towards -4, and the limit of -2 in the end."""
    settings = PidSettings(PidGains(1.0), -2.0, 100.0, slew_per_s=1.5)
    outputs, _ = outputs_and_integrals(settings, [0.0] * 6, [8.0, 8.0, 8.0, -4.0, -4.0, -4.0], h=2.0)
    assert outputs == pytest.approx([3.0, 6.0, 8.0, 5.0, 2.0, -1.0])
    more, _ = outputs_and_integrals(settings, [0.0] * 3, [-4.0] * 3, h=2.0)
    assert more == pytest.approx([-2.0, -2.0, -2.0])


def test_the_bias_of_a_proportional_controller_never_moves():
    settings = PidSettings(PidGains(2.0), 0.0, 10.0)
    outputs, integrals = outputs_and_integrals(settings, [1.0, 2.0, 30.0, 5.0], [5.0] * 4, output=4.0, from_rest=5.0)
    assert outputs == pytest.approx([10.0, 10.0, 0.0, 4.0])
    assert integrals == [4.0] * 4


@given(st.floats(1.0, 20.0), st.floats(0.1, 2.0))
def test_the_derivative_of_a_ramp_rises_with_the_time_constant_of_its_filter(N, h):
    """`Kd (1 - e^{-t N/Td})` after a ramp of 1 PV/s begins, and the proportional part of the ramp itself."""
    settings = PidSettings(PidGains(2.0, Td=3.0, N=N))
    t = h * np.arange(1, 9)
    outputs, _ = outputs_and_integrals(settings, list(t), [0.0] * 8, h=h)
    np.testing.assert_allclose(outputs, -2.0 * t - 6.0 * (1.0 - np.exp(-t * N / 3.0)), atol=1e-9)


def test_a_sine_meets_the_textbook_response_of_derivative_and_filter():
    Kp, Ti, Td, N, w, h = 1.5, 4.0, 0.8, 5.0, 1.1, 0.005
    t = h * np.arange(1, 12_001)
    outputs, _ = outputs_and_integrals(PidSettings(PidGains(Kp, Ti, Td, N=N)), list(np.sin(w * t)), [0.0] * t.size, h=h)
    s = 1j * w
    response = -Kp * (1.0 + 1.0 / (s * Ti) + s * Td / (1.0 + s * Td / N))
    late = t > 30.0
    # The integral of a sine that starts at 0 has a mean of its own, Kp/(Ti w).
    expected = np.abs(response) * np.sin(w * t + np.angle(response)) - Kp / (Ti * w)
    np.testing.assert_allclose(np.array(outputs)[late], expected[late], atol=0.01)


@given(st.lists(st.floats(-20.0, 20.0), min_size=2, max_size=12), st.floats(0.2, 5.0), st.floats(0.1, 10.0))
def test_outputs_scale_with_the_gain_and_samples_with_the_times(pvs, time, gain):
    aims = [5.0] * len(pvs)
    plain, _ = outputs_and_integrals(PidSettings(PidGains(2.0, 4.0, 1.0, 0.3, 0.7)), pvs, aims, h=0.5)
    stretched = PidSettings(PidGains(2.0 * gain, 4.0 * time, 1.0 * time, 0.3 * time, 0.7))
    scaled, _ = outputs_and_integrals(stretched, pvs, aims, h=0.5 * time)
    np.testing.assert_allclose(scaled, gain * np.array(plain), rtol=1e-9, atol=1e-9)


@given(st.floats(-20.0, 20.0), st.floats(0.0, 1.0), st.floats(0.5, 50.0))
def test_a_mirrored_loop_mirrors_its_output(pv, b, Ti):
    up, _ = outputs_and_integrals(PidSettings(PidGains(2.0, Ti, 0.5, 0.2, b)), [pv, -pv], [3.0, 3.0])
    down, _ = outputs_and_integrals(PidSettings(PidGains(2.0, Ti, 0.5, 0.2, b)), [-pv, pv], [-3.0, -3.0])
    direct, _ = outputs_and_integrals(PidSettings(PidGains(-2.0, Ti, 0.5, 0.2, b)), [pv, -pv], [3.0, 3.0])
    np.testing.assert_allclose(down, -np.array(up), atol=1e-9)
    np.testing.assert_allclose(direct, -np.array(up), atol=1e-9)


def test_without_integral_action_there_is_nothing_to_unwind():
    assert math.isinf(PidSettings(PidGains(1.0)).tracking_time)
    assert math.isinf(PidSettings(PidGains(1.0, Td=2.0)).tracking_time)
