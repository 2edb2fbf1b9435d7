"""Margins against closed forms, Routh's conditions, and their definitions in plain arithmetic on a dense grid."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from autotuner.core.design import PidGains, is_stable, margins, ultimate_point
from autotuner.core.design.nyquist import turned
from autotuner.core.design.rules.ultimate import phase
from autotuner.core.model.process import (
    Fopdt,
    Integrating,
    InverseResponse,
    InverseResponseUnderdamped,
    NLags,
    SopdtUnderdamped,
    ThirdOrder,
    ThirdOrderUnderdamped,
    UnstableFopdt,
)

size = st.floats(0.1, 10.0)
share = st.floats(0.05, 0.9)


@settings(max_examples=25, deadline=None)
@given(size, size, share)
def test_proportional_control_of_an_integrator_by_closed_form(K, D, share):
    """`L = k e^{-Ds}/s`: gain margin `pi/(2 k D)`, phase margin `90 deg - k D`, delay margin `pi/(2 k) - D`."""
    k = share * math.pi / (2.0 * D)
    found = margins(Integrating(K, 0.0, D), PidGains(k / K))
    assert found.gain_margin == pytest.approx(1.0 / share, rel=1e-8)
    assert found.phase_margin_deg == pytest.approx(90.0 * (1.0 - share), rel=1e-6)
    assert found.delay_margin_s == pytest.approx(math.pi / (2.0 * k) - D, rel=1e-6)
    assert found.gain_reduction_margin == 0.0


@settings(max_examples=25, deadline=None)
@given(size, size, st.floats(0.05, 2.0), share)
def test_a_cancelled_lag_has_the_margins_of_an_integrator(K, T, D_over_T, share):
    D = D_over_T * T
    k = share * math.pi / (2.0 * D)
    found = margins(Fopdt(-K, T, D), PidGains(-k * T / K, T))
    assert found.gain_margin == pytest.approx(1.0 / share, rel=1e-7)
    assert found.delay_margin_s == pytest.approx(math.pi / (2.0 * k) - D, rel=1e-6)


@settings(max_examples=25, deadline=None)
@given(size, st.floats(0.2, 1.0), st.floats(0.2, 1.0), st.floats(0.3, 0.95))
def test_three_lags_are_stable_up_to_the_gain_of_routh(T1, second, third, share):
    """`1 + K Ku = (T1 + T2 + T3)(1/T1 + 1/T2 + 1/T3)`; `wu^2 = (T1 + T2 + T3)/(T1 T2 T3)`."""
    T2 = second * T1
    T3 = third * T2
    lags = T1 + T2 + T3
    Ku = (lags * (1.0 / T1 + 1.0 / T2 + 1.0 / T3) - 1.0) / 2.0
    model = ThirdOrder(2.0, T1, T2, T3, 0.0)
    assert margins(model, PidGains(share * Ku)).gain_margin == pytest.approx(1.0 / share, rel=1e-8)
    assert not is_stable(model, PidGains(1.0001 * Ku))
    point = ultimate_point(model)
    assert point.Ku == pytest.approx(Ku, rel=1e-8)
    assert point.Pu == pytest.approx(2.0 * math.pi * math.sqrt(T1 * T2 * T3 / lags), rel=1e-8)


@settings(max_examples=25, deadline=None)
@given(size, size, size, st.floats(0.1, 5.0))
def test_an_integrator_with_a_lag_needs_an_integral_time_longer_than_it(K, T, Kp, ratio):
    """`T Ti s^3 + Ti s^2 + k Ti s + k`: stable for `Ti > T`, whatever the gain."""
    assume(abs(ratio - 1.0) > 1e-3)
    assert is_stable(Integrating(K, T, 0.0), PidGains(Kp / K, ratio * T)) is (ratio > 1.0)


@settings(max_examples=25, deadline=None)
@given(size, size, st.floats(1.05, 20.0), size)
def test_an_unstable_lag_may_lose_gain_down_to_one(K, T, loop_gain, Ti):
    """`T s^2 + (K Kp - 1) s + K Kp/Ti`: stable for `K Kp > 1`, so the gain may shrink to `1/(K Kp)` and grow freely."""
    found = margins(UnstableFopdt(K, T, 0.0), PidGains(loop_gain / K, Ti))
    assert found.stable
    assert found.gain_reduction_margin == pytest.approx(1.0 / loop_gain, rel=1e-7)
    assert math.isinf(found.gain_margin)
    assert not is_stable(UnstableFopdt(K, T, 0.0), PidGains(0.99 / K, Ti))


@settings(max_examples=25, deadline=None)
@given(size, size, st.floats(0.1, 3.0), share)
def test_a_zero_on_the_right_limits_the_gain(K, T1, zero, share):
    """P control without dead time: `T1 T2 s^2 + (T1 + T2 - k Z) s + 1 + k`, stable for `k < (T1 + T2)/Z`."""
    T2, Z = 0.5 * T1, zero * T1
    largest = 1.5 * T1 / Z
    found = margins(InverseResponse(K, T1, T2, Z, 0.0), PidGains(share * largest / K))
    assert found.gain_margin == pytest.approx(1.0 / share, rel=1e-7)


# Each process written out from its formula, as a product of factors in s; nothing of the product computes it.
PROCESSES = [
    (NLags(2.0, 3.0, 4.0, 1.0), lambda s: 2.0 * np.exp(-s) / (3.0 * s + 1.0) ** 4),
    (ThirdOrder(0.5, 8.0, 3.0, 1.0, 2.0), lambda s: 0.5 * np.exp(-2.0 * s) / (8 * s + 1) / (3 * s + 1) / (s + 1)),
    (
        ThirdOrderUnderdamped(-1.0, 9.0, 3.0, 2.0, 0.5),
        lambda s: -np.exp(-0.5 * s) / (9.0 * s**2 + 3.0 * s + 1.0) / (2.0 * s + 1.0),
    ),
    (
        InverseResponseUnderdamped(1.0, 4.0, 2.5, 0.8, 0.4),
        lambda s: (1.0 - 0.8 * s) * np.exp(-0.4 * s) / (4.0 * s**2 + 2.5 * s + 1.0),
    ),
    (SopdtUnderdamped(3.0, 4.0, 0.8, 1.0), lambda s: 3.0 * np.exp(-s) / (4.0 * s**2 + 0.8 * s + 1.0)),
    (Integrating(0.2, 2.0, 1.5), lambda s: 0.2 * np.exp(-1.5 * s) / (s * (2.0 * s + 1.0))),
    (UnstableFopdt(1.0, 10.0, 1.0), lambda s: np.exp(-s) / (10.0 * s - 1.0)),
]
CONTROLLERS = {
    "PI": lambda Ku, Pu: (PidGains(0.35 * Ku, 1.5 * Pu), 0.35 * Ku, 1.5 * Pu, 0.0, 0.0, math.inf),
    "PID, filtered PV": lambda Ku, Pu: (
        PidGains(0.3 * Ku, 1.4 * Pu, 0.15 * Pu, 0.02 * Pu),
        *(0.3 * Ku, 1.4 * Pu, 0.15 * Pu, 0.02 * Pu, math.inf),
    ),
    "PID, filtered derivative": lambda Ku, Pu: (
        PidGains(0.3 * Ku, 1.6 * Pu, 0.12 * Pu, N=8.0),
        *(0.3 * Ku, 1.6 * Pu, 0.12 * Pu, 0.0, 8.0),
    ),
}


@pytest.mark.parametrize("kind", CONTROLLERS)
@pytest.mark.parametrize(("model", "process"), PROCESSES, ids=lambda value: getattr(value, "structure", ""))
def test_every_figure_is_that_of_its_definition(model, process, kind):
    point = ultimate_point(model)
    gains, Kp, Ti, Td, Tf, N = CONTROLLERS[kind](point.Ku, point.Pu)
    s = 1j * np.geomspace(1e-4, 1e3, 400_000) * 2.0 * math.pi / point.Pu
    C = Kp * (1.0 + 1.0 / (Ti * s) + Td * s / (1.0 + Td * s / N)) / (1.0 + Tf * s + (Tf * s) ** 2 / 2.0)
    L = C * process(s)
    found = margins(model, gains)
    assert found.stable
    assert found.Ms == pytest.approx(np.abs(1.0 / (1.0 + L)).max(), rel=1e-4)
    assert found.Mt == pytest.approx(np.abs(L / (1.0 + L)).max(), rel=1e-4)
    assert found.noise_gain == pytest.approx(np.abs(C / (1.0 + L)).max(), rel=1e-4)
    crossed = np.flatnonzero((np.abs(L[:-1]) > 1.0) != (np.abs(L[1:]) > 1.0))
    angle = np.degrees(np.angle(-L[crossed]))
    assert found.phase_margin_deg == pytest.approx(np.abs(angle).min(), abs=0.02)
    delays = np.radians(angle % 360.0) / s.imag[crossed]
    assert found.delay_margin_s == pytest.approx(delays.min(), rel=2e-3)
    on_axis = np.flatnonzero((L.imag[:-1] > 0.0) != (L.imag[1:] > 0.0))
    distance = -L.real[on_axis]
    assert found.gain_margin == pytest.approx(1.0 / distance[(distance > 0.0) & (distance < 1.0)].max(), rel=1e-3)
    assert found.gain_reduction_margin == pytest.approx(max(1.0 / distance[distance > 1.0], default=0.0), rel=1e-3)


@pytest.mark.parametrize(("model", "process"), PROCESSES[:6], ids=lambda value: getattr(value, "structure", ""))
def test_the_phase_is_that_of_the_response_unwrapped(model, process):
    w = np.geomspace(1e-5, 10.0, 20_000)
    unwrapped = np.unwrap(np.angle(math.copysign(1.0, model.K) * process(1j * w)))
    for i in (0, 5_000, 12_000, 19_999):
        assert phase(model, float(w[i])) == pytest.approx(unwrapped[i], abs=1e-9)


@pytest.mark.parametrize("n", [3, 4, 7, 20])
def test_equal_lags_without_dead_time_by_closed_form(n):
    """`n atan(T wu) = pi`: `wu = tan(pi/n)/T`, `Ku = 1/(K cos^n(pi/n))`."""
    point = ultimate_point(NLags(0.5, 2.0, float(n), 0.0))
    assert point.Pu == pytest.approx(4.0 * math.pi / math.tan(math.pi / n), rel=1e-9)
    assert point.Ku == pytest.approx(2.0 / math.cos(math.pi / n) ** n, rel=1e-9)


@pytest.mark.parametrize("D", [0.2, 0.5, 5.5, 6.0])
def test_a_lively_pair_crosses_the_unit_circle_twice(D):
    """`0.5/(s^2 + 0.4 s + 1)`: `(1 - w^2)^2 + 0.16 w^2 = 0.25` at two frequencies, each with an angle and a delay."""
    w = np.sqrt(np.roots([1.0, -1.84, 0.75]))
    angle = np.angle(-0.5 * np.exp(-1j * w * D) / (1.0 - w**2 + 0.4j * w))
    found = margins(SopdtUnderdamped(1.0, 1.0, 0.4, D), PidGains(0.5))
    assert found.stable
    assert found.phase_margin_deg == pytest.approx(np.degrees(np.abs(angle).min()), rel=1e-9)
    assert found.delay_margin_s == pytest.approx((angle % (2.0 * math.pi) / w).min(), rel=1e-9)


def test_a_derivative_filter_bounds_the_noise_gain():
    """A slow process hardly answers fast noise, which meets `Kp (1 + N)`; without a filter there is no bound."""
    slow = Fopdt(0.5, 1e4, 1.0)
    assert margins(slow, PidGains(2.0, 1e3, 5.0, N=8.0)).noise_gain == pytest.approx(18.0, rel=0.01)
    assert math.isinf(margins(Fopdt(0.5, 1e4, 0.0), PidGains(2.0, 1e3, 5.0)).noise_gain)


@given(st.lists(st.tuples(st.floats(0.1, 10.0), st.floats(-3.1, 3.1)), min_size=2, max_size=40))
def test_a_path_turns_by_the_sum_of_its_steps(polar):
    """Each step is a ratio of two points; the sum of the angles of these ratios is what the path turns by."""
    sizes, turns = np.array(polar).T
    path = sizes * np.exp(1j * np.cumsum(turns))
    assert turned(path) == pytest.approx(float(np.sum(turns[1:])), abs=1e-9)
