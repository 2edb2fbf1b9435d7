"""From an exact limit cycle back to the process: the simulator solves the cycle forward, in another way."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st

from autotuner.core.identification import identify
from autotuner.core.identification.limit_cycle.inverse_cycle import (
    first_order_wave,
    integrating_of_cycle,
    integrating_wave,
    second_order_wave,
    sopdt_of_cycle,
    unstable_of_cycle,
)
from autotuner.errors import InputError
from autotuner_sim.plants import Integrating, SopdtOverdamped, SopdtUnderdamped, UnstableFopdt
from autotuner_sim.relay import Relay

gains = st.builds(lambda size, sign: sign * 10.0**size, st.floats(-1.0, 1.2), st.sampled_from([1.0, -1.0]))
times = st.floats(-2.0, 4.0).map(lambda decade: 10.0**decade)
ratios = st.floats(-1.3, 1.0).map(lambda decade: 10.0**decade)
biases = st.one_of(st.just(0.0), st.floats(-0.5, 0.5))
QUICK = settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def oscillating(cycle_of, plant, bias):
    try:
        return cycle_of(plant, Relay(bias - 1.0, bias + 1.0, direct=plant.K > 0.0))
    except ValueError:
        assume(False)


def equals(model, plant, Pu):
    """Whether every parameter is the plant's to 1e-6, a vanishing one to 1e-6 of what the period would show."""
    scale = {"m": Pu**2}
    for name, value in model.parameters().items():
        assert value == pytest.approx(getattr(plant, name), rel=1e-6, abs=1e-9 * scale.get(name, Pu)), name


@QUICK
@given(K=gains, T=times, d=ratios, log_damping=st.floats(math.log(0.2), math.log(3.0)), bias=biases)
@example(K=1.0, T=1.0, d=10.0, log_damping=-1.5, bias=0.0)  # a dead time that is longer than the period
def test_second_order(cycle_of, K, T, d, log_damping, bias):
    z = math.exp(log_damping)
    T1 = T * (z + math.sqrt(max(z * z - 1.0, 0.0)))
    plant = SopdtUnderdamped(K, T * T, 2.0 * z * T, d * T) if z < 0.999 else SopdtOverdamped(K, T1, T * T / T1, d * T)
    assume(abs(z - 1.0) > 1e-3)
    cycle = oscillating(cycle_of, plant, bias)
    model = sopdt_of_cycle(K, cycle)
    assert model.structure == plant.structure
    # With a dead time that is longer by a period, the cycle is the same.
    equals(model, replace(plant, D=plant.D - cycle.Pu * round((plant.D - model.D) / cycle.Pu)), cycle.Pu)


def test_two_roots_between_two_angles_of_the_grid(cycle_of):
    """A dead time far longer than the lags: the process and another one of the same peak lie side by side."""
    plant = SopdtOverdamped(0.11659679, 13204.578, 2334.4457, 47449.6855)
    cycle = oscillating(cycle_of, plant, 0.0)
    equals(sopdt_of_cycle(plant.K, cycle), plant, cycle.Pu)


@QUICK
@given(K=gains, T=st.one_of(st.just(0.0), times), d=ratios, bias=biases)
def test_integrating(cycle_of, K, T, d, bias):
    plant = Integrating(K, T, d * (T or 1.0))
    cycle = oscillating(cycle_of, plant, bias)
    equals(integrating_of_cycle(cycle, K), plant, cycle.Pu)


@QUICK
@given(K=gains, T=times, d=st.floats(0.05, 0.5), bias=st.one_of(st.just(0.0), st.floats(-0.2, 0.2)))
def test_unstable(cycle_of, K, T, d, bias):
    plant = UnstableFopdt(K, T, d * T)
    cycle = oscillating(cycle_of, plant, bias)
    equals(unstable_of_cycle(K, cycle), plant, cycle.Pu)


def test_hysteresis_is_in_the_pv_at_the_switches(cycle_of):
    plant = SopdtOverdamped(1.0, 10.0, 2.0, 4.0)
    cycle = cycle_of(plant, Relay(-1.0, 1.5, hysteresis=0.1))
    equals(sopdt_of_cycle(1.0, cycle), plant, cycle.Pu)


@pytest.mark.parametrize(
    ("wave", "plant"),
    [
        (lambda *x: second_order_wave(2.0, 9.0, 2.4, *x), SopdtUnderdamped(2.0, 9.0, 2.4, 1.0)),
        (lambda *x: second_order_wave(2.0, 20.0, 12.0, *x), SopdtOverdamped(2.0, 10.0, 2.0, 1.0)),
        (lambda *x: integrating_wave(0.3, 0.0, *x), Integrating(0.3, 0.0, 1.0)),
        (lambda *x: integrating_wave(0.3, 4.0, *x), Integrating(0.3, 4.0, 1.0)),
        (lambda *x: first_order_wave(-2.0, -0.1, *x), UnstableFopdt(2.0, 10.0, 1.0)),
    ],
)
def test_waves_repeat_and_move_as_their_equation_says(wave, plant):
    period, spans, levels = 14.0, (6.0, 8.0), (-1.0, 1.7)
    made = wave(levels, spans)
    t = np.linspace(0.01, period - 0.01, 57)
    values = np.array([made.at(s)[0] for s in t])
    assert made.at(period)[0] == pytest.approx(made.at(0.0)[0], abs=1e-12)
    assert made.at(6.0 - 1e-12)[0] == pytest.approx(made.at(6.0 + 1e-12)[0], abs=1e-9)
    # The fundamental of the wave is G(jw) times that of its input, whatever the equation.
    w = 2.0 * math.pi / period
    fine = (np.arange(20_000) + 0.5) / 20_000 * period
    turns = np.exp(-1j * w * fine)
    response = np.array([made.at(s)[0] for s in fine[::10]]) @ turns[::10]
    driven = np.where(fine < 6.0, 1.7, -1.0)[::10] @ turns[::10]
    expected = plant.transfer(1j * w) * np.exp(1j * w * plant.D)
    assert response / driven == pytest.approx(expected, rel=2e-3)
    lowest, highest = made.extremes()
    assert lowest <= values.min() + 1e-12
    assert highest >= values.max() - 1e-12


def test_a_cycle_that_no_such_process_has_is_refused(cycle_of):
    cycle = cycle_of(SopdtUnderdamped(1.0, 9.0, 1.0, 3.0), Relay(-1.0, 1.0))
    with pytest.raises(InputError, match="unstable"):
        unstable_of_cycle(0.1, cycle)
    with pytest.raises(InputError, match="second-order"):
        sopdt_of_cycle(1e-3, cycle)


@pytest.mark.one_of(2)
@pytest.mark.parametrize(
    "plant",
    [SopdtOverdamped(1.0, 10.0, 2.0, 4.0), Integrating(0.1, 5.0, 2.0), UnstableFopdt(1.0, 10.0, 2.0)],
    ids=str,
)
def test_the_closed_form_stands_beside_least_squares(record_relay, plant):
    estimate = identify(record_relay(plant, 0.02, switches=11)).estimates["closed_form"]
    assert estimate.model.structure == plant.structure
    assert pytest.approx(plant.D, rel=0.1) == estimate.model.D
    assert estimate.fit_percent > 90.0
