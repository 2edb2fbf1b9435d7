"""Margins against published tables, closed-loop poles, and their own definition: what they allow is stable, no more."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from autotuner.core.design import PidGains, apply_rule, controller_response, is_stable, margins, ultimate_point
from autotuner.core.model.process import (
    Fopdt,
    Integrating,
    InverseResponse,
    SopdtOverdamped,
    SopdtUnderdamped,
    UnstableFopdt,
    frequency_response,
)

EPS = 1e-6


def test_simc_margins_are_those_of_its_paper():
    # Skogestad, J. Process Control 13, 2003, table 1: tau_c = D, first-order process with tau_1 <= 8 D.
    model = Fopdt(1.0, 1.0, 1.0)
    found = margins(model, apply_rule("simc_pi", model).gains)
    assert found.gain_margin == pytest.approx(math.pi, rel=1e-9)
    assert found.phase_margin_deg == pytest.approx(90.0 - 90.0 / math.pi, rel=1e-9)
    assert found.delay_margin_s == pytest.approx(math.pi - 1.0, rel=1e-9)
    assert found.Ms == pytest.approx(1.59, abs=0.005)
    assert found.Mt == pytest.approx(1.0, abs=1e-6)


def test_simc_margins_for_an_integrator_are_those_of_its_paper():
    model = Integrating(1.0, 0.0, 1.0)
    found = margins(model, apply_rule("simc_pi", model).gains)
    shown = (found.gain_margin, found.phase_margin_deg, found.delay_margin_s, found.Ms, found.Mt)
    assert shown == pytest.approx((2.96, 46.9, 1.59, 1.70, 1.30), abs=0.05)


def polynomial_loop(model, gains):
    """Return numerator and denominator of the loop without dead time, ascending."""
    r = model.rational()
    controller = np.array([gains.Ki, gains.Kp, gains.Kd])
    lag = np.array([0.0, 1.0, gains.Tf, gains.Tf**2 / 2.0])
    if gains.Ki == 0.0:
        controller, lag = controller[1:], lag[1:]
    return np.convolve(controller, r.b), np.convolve(lag, r.a)


@settings(max_examples=100)
@given(st.data())
def test_stability_agrees_with_the_poles(any_gains, data):
    gains = replace(data.draw(any_gains), Tf=data.draw(st.floats(1e-3, 10.0)))
    time, fraction = st.floats(0.1, 10.0), data.draw(st.floats(0.05, 0.95))
    K, T = data.draw(st.floats(-10.0, 10.0).filter(lambda k: abs(k) > 0.1)), data.draw(time)
    model = data.draw(
        st.sampled_from(
            [
                Fopdt(K, T, 0.0),
                SopdtOverdamped(K, T, fraction * T, 0.0),
                SopdtUnderdamped(K, T * T, 1.9 * fraction * T, 0.0),
                Integrating(K, fraction * T, 0.0),
                UnstableFopdt(K, T, 0.0),
                InverseResponse(K, T, fraction * T, T, 0.0),
            ]
        )
    )
    numerator, denominator = polynomial_loop(model, gains)
    size = max(numerator.size, denominator.size)
    closed = np.pad(numerator, (0, size - numerator.size)) + np.pad(denominator, (0, size - denominator.size))
    poles = np.roots(closed[::-1])
    assume(np.min(np.abs(poles.real) / (np.abs(poles) + 1e-300)) > 1e-7)
    assert is_stable(model, gains) == bool(np.all(poles.real < 0.0))


@settings(max_examples=25)
@given(st.data())
def test_each_margin_is_the_edge_of_stability(stable_models, data):
    model = data.draw(stable_models)
    D = model.D
    detune = data.draw(st.floats(0.05, 0.6))
    point = ultimate_point(model)
    gains = PidGains(detune * point.Ku, data.draw(st.floats(0.6, 5.0)) * point.Pu, 0.1 * point.Pu, 0.02 * point.Pu)
    found = margins(model, gains)
    assume(found.stable)
    if math.isfinite(found.gain_margin):
        assert is_stable(model, replace(gains, Kp=gains.Kp * found.gain_margin * (1.0 - EPS)))
        assert not is_stable(model, replace(gains, Kp=gains.Kp * found.gain_margin * (1.0 + EPS)))
    if math.isfinite(found.delay_margin_s):
        assert is_stable(replace(model, D=D + found.delay_margin_s * (1.0 - EPS)), gains)
        assert not is_stable(replace(model, D=D + found.delay_margin_s * (1.0 + EPS)), gains)


@settings(max_examples=25)
@given(st.data())
def test_peaks_agree_with_a_fine_grid(stable_models, data):
    model = data.draw(stable_models)
    point = ultimate_point(model)
    gains = PidGains(data.draw(st.floats(0.05, 0.5)) * point.Ku, 1.5 * point.Pu, 0.1 * point.Pu, 0.02 * point.Pu)
    found = margins(model, gains)
    assume(found.stable)

    def highest(function):
        w = np.geomspace(1e-3, 1e3, 30_001) * 2.0 * math.pi / point.Pu
        for _ in range(3):  # close to instability a peak is narrower than the first grid
            C = controller_response(gains, w)
            size = np.abs(function(C, C * frequency_response(model, w)))
            k = int(np.clip(np.argmax(size), 1, w.size - 2))
            w = np.linspace(w[k - 1], w[k + 1], 2_001)
        return float(np.max(size))

    assert found.Ms == pytest.approx(highest(lambda _, L: 1.0 / (1.0 + L)), rel=1e-7)
    assert found.Mt == pytest.approx(max(1.0, highest(lambda _, L: L / (1.0 + L))), rel=1e-7)
    at_rest = 0.0 if isinstance(model, Integrating) else 1.0 / abs(model.K)
    assert found.noise_gain == pytest.approx(max(at_rest, highest(lambda C, L: C / (1.0 + L))), rel=1e-7)


@given(st.floats(0.05, 0.8))
def test_unstable_process_is_stable_between_two_gains(ratio):
    model = UnstableFopdt(2.0, 5.0, 5.0 * ratio)
    upper = ultimate_point(model).Ku
    gain = math.sqrt(upper * 0.5)
    found = margins(model, PidGains(gain))
    assert found.gain_margin == pytest.approx(upper / gain, rel=1e-6)
    assert found.gain_reduction_margin == pytest.approx(0.5 / gain, rel=1e-6)
    assert not is_stable(model, PidGains(0.5 * (1.0 - EPS)))
    assert not is_stable(model, PidGains(-gain))


def test_wrong_action_is_unstable():
    assert not is_stable(Fopdt(1.0, 10.0, 1.0), PidGains(-0.5, 10.0))
    assert not is_stable(Fopdt(-1.0, 10.0, 1.0), PidGains(0.5, 10.0))
    assert is_stable(Fopdt(-1.0, 10.0, 1.0), PidGains(-0.5, 10.0))


def test_unstable_loop_has_no_figures():
    found = margins(Fopdt(1.0, 10.0, 1.0), PidGains(100.0, 10.0))
    assert not found.stable
    assert found.to_dict() == {name: False if name == "stable" else None for name in found.__slots__}


def test_unlimited_figures_are_null_in_json():
    found = margins(Fopdt(1.0, 10.0, 0.0), PidGains(2.0, 10.0, 1.0))
    assert math.isinf(found.gain_margin)
    assert math.isinf(found.noise_gain)
    assert json.loads(json.dumps(found.to_dict(), allow_nan=False))["gain_margin"] is None


def test_unfiltered_derivative_on_a_lag_is_limited_by_the_gain_at_infinity():
    # L -> Kp Td K/T = 0.5 and turns for ever with the dead time: Ms is at least 1/(1 - 0.5).
    found = margins(Fopdt(1.0, 10.0, 1.0), PidGains(1.0, 20.0, 5.0))
    assert found.Ms == pytest.approx(2.0, rel=1e-3)
    assert not is_stable(Fopdt(1.0, 10.0, 1.0), PidGains(2.1, 20.0, 5.0))


def test_a_slow_loop_is_resolved_over_many_decades():
    found = margins(Fopdt(1.0, 1.0, 1e-4), PidGains(0.5, 1e5))
    assert found.stable
    assert found.Ms == pytest.approx(1.0, abs=1e-3)


@given(st.floats(1e-3, 1e3), st.floats(0.1, 10.0))
def test_margins_do_not_depend_on_units(time, gain):
    model, gains = SopdtOverdamped(2.0, 10.0, 4.0, 3.0), PidGains(0.6, 12.0, 3.0, 0.3)
    plain = margins(model, gains)
    scaled = margins(
        SopdtOverdamped(2.0 * gain, 10.0 * time, 4.0 * time, 3.0 * time),
        PidGains(0.6 / gain, 12.0 * time, 3.0 * time, 0.3 * time),
    )
    assert scaled.Ms == pytest.approx(plain.Ms, rel=1e-6)
    assert scaled.delay_margin_s == pytest.approx(plain.delay_margin_s * time, rel=1e-6)
    assert scaled.noise_gain == pytest.approx(plain.noise_gain / gain, rel=1e-6)
