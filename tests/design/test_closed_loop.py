"""The simulated closed loop against the response of the process to its output, and against papers."""

import functools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotuner.core.design import FORMS, PidGains, Spans, apply_rule, design, from_device, to_device
from autotuner.core.design.simulation.closed_loop import Scenario, predict
from autotuner.core.design.simulation.pid import PidSettings
from autotuner.core.estimation.simulation import response
from autotuner.core.model.process import (
    Fopdt,
    Integrating,
    InverseResponse,
    SopdtOverdamped,
    SopdtUnderdamped,
    UnstableFopdt,
)
from autotuner.errors import InputError

MODELS = [
    Fopdt(2.0, 10.0, 1.3),
    Fopdt(2.0, 10.0, 2.0),
    SopdtOverdamped(2.0, 10.0, 3.0, 1.53),
    SopdtUnderdamped(1.0, 4.0, 1.0, 2.2),
    Integrating(0.1, 0.0, 2.1),
    Integrating(0.1, 3.0, 0.4),
    InverseResponse(1.0, 5.0, 2.0, 1.0, 0.7),
    UnstableFopdt(1.0, 10.0, 1.0),
]
designed = functools.cache(design)
"""The same gains, computed once: two tests judge them."""


@pytest.mark.one_of(2)
@pytest.mark.parametrize("model", MODELS, ids=str)
def test_process_moves_exactly_under_the_outputs_commanded(model):
    """Against the response of a process to a held input, computed elsewhere and in another way."""
    found = predict(model, PidSettings(designed(model).gains), Scenario(60.0, 0.5, 1.0, 0.3))
    np.testing.assert_allclose(found.pv, response(model, found.t, found.output + 0.3), atol=1e-9)


@pytest.mark.parametrize("model", MODELS, ids=str)
def test_quick_sampling_gives_the_error_of_the_design(model):
    found = designed(model)
    scale = model.D + 10.0
    prediction = predict(model, PidSettings(found.gains), Scenario(20.0 * scale, 0.005 * scale, load_step=1.0))
    assert prediction.iae == pytest.approx(found.iae, rel=0.03)


def test_slow_sampling_acts_as_half_a_sample_of_dead_time():
    gains = apply_rule("simc_pi", Fopdt(1.0, 10.0, 2.0)).gains
    sampled = predict(Fopdt(1.0, 10.0, 2.0), PidSettings(gains), Scenario(100.0, 1.0, load_step=1.0))
    quick = predict(Fopdt(1.0, 10.0, 2.5), PidSettings(gains), Scenario(100.0, 0.02, load_step=1.0))
    assert np.max(np.abs(sampled.pv)) == pytest.approx(np.max(np.abs(quick.pv)), rel=0.05)
    assert sampled.iae == pytest.approx(quick.iae, rel=0.05)


def test_simc_follows_a_set_point_as_its_paper_says():
    # tau_c = D = 1, Ti = T: after the dead time the PV follows 1 - e^{-t'/1} closely; overshoot a few percent.
    model = Fopdt(2.0, 10.0, 1.0)
    found = predict(model, PidSettings(apply_rule("simc_pi", model).gains), Scenario(60.0, 0.01, set_point_step=1.0))
    assert found.pv[np.searchsorted(found.t, 0.99)] == 0.0
    assert found.pv[np.searchsorted(found.t, 2.0)] == pytest.approx(0.5, abs=0.01)  # a ramp of slope 1/(tau_c + D)
    assert 0.0 < found.overshoot < 0.1
    assert found.settling_time_s < 12.0


def test_limited_output_slows_the_loop_and_does_not_wind_up():
    model = Fopdt(1.0, 10.0, 1.0)
    gains = apply_rule("simc_pi", model).gains
    free = predict(model, PidSettings(gains), Scenario(100.0, 0.1, set_point_step=1.0))
    limited = predict(model, PidSettings(gains, -1.2, 1.2), Scenario(100.0, 0.1, set_point_step=1.0))
    assert np.max(limited.output) == 1.2
    assert limited.settling_time_s > free.settling_time_s
    assert limited.overshoot < free.overshoot + 0.02


def test_an_actuator_acts_between_output_and_process():
    model = Fopdt(2.0, 10.0, 1.0)
    gains = apply_rule("simc_pi", model).gains
    half = predict(model, PidSettings(gains), Scenario(80.0, 0.1, 1.0), actuator=lambda output: output / 2.0)
    other = predict(Fopdt(1.0, 10.0, 1.0), PidSettings(gains), Scenario(80.0, 0.1, 1.0))
    np.testing.assert_allclose(half.pv, other.pv, atol=1e-9)


def test_noise_is_measured_not_lived():
    model = Fopdt(2.0, 10.0, 1.0)
    noise = 0.1 * np.random.default_rng(3).standard_normal(801)
    found = predict(model, PidSettings(PidGains(1e-9)), Scenario(80.0, 0.1), noise=noise)
    np.testing.assert_allclose(found.pv, noise, atol=1e-6)


@pytest.mark.parametrize("name", FORMS)
@settings(max_examples=5, deadline=None)
@given(st.floats(0.2, 1.0))
def test_a_controller_from_any_device_form_does_the_same(name, detune):
    model, spans = SopdtOverdamped(2.0, 10.0, 3.0, 1.5), Spans(200.0, 50.0)
    tuned = apply_rule("amigo_pi", model).gains
    gains = PidGains(detune * tuned.Kp, 2.0 * tuned.Ti, 0.2 * tuned.Ti, 0.5, 0.6)
    back = from_device(to_device(gains, FORMS[name], spans), FORMS[name], spans)
    scenario = Scenario(60.0, 0.5, 1.0, 0.5)
    ours, theirs = (predict(model, PidSettings(g, -2.0, 2.0), scenario) for g in (gains, back))
    np.testing.assert_allclose(theirs.pv, ours.pv, atol=1e-9)
    np.testing.assert_allclose(theirs.output, ours.output, atol=1e-9)


@pytest.mark.parametrize("field", ["duration_s", "sample_time_s"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_a_scenario_without_time_is_refused(field, value):
    times = {"duration_s": 10.0, "sample_time_s": 1.0, field: value}
    with pytest.raises(InputError) as caught:
        Scenario(**times)
    assert caught.value.field == f"scenario.{field}"
