"""Relay beside a controller: exact inversion, hand formulas, the sampled controller, whole experiments, Monte Carlo."""

import cmath
import dataclasses
import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from autotuner.core.design.gains import PidGains
from autotuner.core.design.simulation.pid import PidSettings, started, step
from autotuner.core.experiment.experiment import Experiment
from autotuner.core.experiment.parallel_controller import relay_part
from autotuner.core.experiment.phases import Phase
from autotuner.core.experiment.settings import ExperimentSettings, Limits
from autotuner.core.identification import identify
from autotuner.core.identification.limit_cycle import describing_function, online_relay
from autotuner.core.identification.limit_cycle.from_cycle import Known, by_describing_function
from autotuner.core.identification.limit_cycle.online_relay import controller_beside
from autotuner.core.recording import Recording, Sample
from autotuner.errors import InputError
from autotuner_sim import plants
from autotuner_sim.effects import ColouredNoise, Noise
from autotuner_sim.relay import symmetric_relay
from autotuner_sim.relay.parallel_pid import Pid, run_parallel_relay
from autotuner_sim.stepped import SteppedPlant

CONTROLLER = PidGains(Kp=4.2, Ti=3.67, Td=0.92, Tf=0.092)
PLANT = plants.Fopdt(1.0, 10.0, 2.0)
SETTINGS = ExperimentSettings(sample_time_s=0.05, amplitude=10.0, ratio=1.0, check=False, online=CONTROLLER)

lengths = st.floats(0.05, 50.0)
amplitudes = st.floats(0.05, 20.0)


def conduct(settings, plant=PLANT, noise=0.0, seed=1, sensors=()):
    """Step an experiment over a plant; return its recording."""
    white = [Noise(noise, seed=seed)] if noise else []
    loop = SteppedPlant(plant, output0=40.0, pv0=80.0, sensors=[*white, *sensors])
    experiment, samples, output = Experiment(settings, 40.0), [], 40.0
    while True:
        t = len(samples) * settings.sample_time_s
        loop.advance(t)
        pv = loop.measure()
        command = experiment.step(Sample(t, pv, output))
        if command.phase is Phase.RESTORE:
            assert experiment.verdict is None
            return Recording.from_samples(samples, experiment.settings_so_far())
        loop.output = output = command.output
        samples.append(Sample(t, pv, output))


def relay_gain(h, A, eps):
    return 4.0 * h / (math.pi * A) * cmath.exp(-1j * math.asin(eps / A))


@given(
    lengths,
    st.floats(0.1, 10.0),
    st.floats(0.3, 0.95),
    amplitudes,
    amplitudes,
    st.floats(0.0, 0.9),
    st.sampled_from([1, -1]),
)
def test_a_first_order_process_is_recovered_from_any_controller(T, K, turn, h, A, share, sign):
    """Any controller that, with the relay, makes `(N + Gc) G = -1` at a frequency where the phase of G is known."""
    D = T / 2.0
    w = turn * math.pi / D
    plant = plants.Fopdt(K, T, D)
    assume(w * D + math.atan(w * T) < 2.0 * math.pi)
    controller = -1.0 / plant.transfer(1j * w) - relay_gain(h, A, share * A)
    found = describing_function.fopdt(sign * K, h, A, 2.0 * math.pi / w, share * A, controller)
    assert pytest.approx((sign * K, T, D), rel=1e-6) == (found.K, found.T, found.D)


@given(
    lengths,
    st.floats(0.05, 1.0),
    st.floats(0.1, 10.0),
    st.floats(0.1, 3.0),
    amplitudes,
    amplitudes,
    st.floats(0.0, 0.9),
)
def test_a_second_order_process_is_recovered_from_any_controller(T1, part, K, wT, h, A, share):
    T2, D, w = part * T1, 0.3 * T1, wT / T1
    plant = plants.SopdtOverdamped(K, T1, T2, D)
    controller = -1.0 / plant.transfer(1j * w) - relay_gain(h, A, share * A)
    found = describing_function.sopdt(K, D, h, A, 2.0 * math.pi / w, share * A, controller)
    m, n = (found.m, found.n) if found.structure == "sopdt_underdamped" else (found.T1 * found.T2, found.T1 + found.T2)
    assert (m, n) == pytest.approx((T1 * T2, T1 + T2), rel=1e-5)


def test_by_hand():
    """h 1, A 4/pi: N = 1; Gc = j, w = 1: M = 1 + j; K 2: T = sqrt(8 - 1), D = pi + pi/4 - atan(sqrt 7)."""
    found = describing_function.fopdt(2.0, 1.0, 4.0 / math.pi, 2.0 * math.pi, controller=1j)
    assert pytest.approx(math.sqrt(7.0)) == found.T
    assert pytest.approx(1.25 * math.pi - math.atan(math.sqrt(7.0))) == found.D
    second = describing_function.sopdt(2.0, 2.0, 1.0, 4.0 / math.pi, 2.0 * math.pi, controller=1j)
    angle = 2.0 - math.pi / 4.0
    m, n = 1.0 + 2.0 * math.sqrt(2.0) * math.cos(angle), 2.0 * math.sqrt(2.0) * math.sin(angle)
    assert (second.m, second.n) == pytest.approx((m, n))


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda: describing_function.fopdt(0.1, 1.0, 4.0 / math.pi, 1.0, controller=1.0), "K"),
        (lambda: describing_function.fopdt(10.0, 1.0, 4.0 / math.pi, 1.0, controller=-3.0 - 1.5j), "controller"),
        (lambda: describing_function.fopdt(1.0, 0.0, 1.0, 1.0, controller=1.0), "h"),
        (lambda: describing_function.sopdt(1.0, -1.0, 1.0, 1.0, 1.0, controller=1.0), "D"),
        (lambda: describing_function.sopdt(1.0, 0.5, 1.0, 1.0, 1.0, controller=1.0), "D"),
    ],
)
def test_what_no_process_can_have_produced_is_refused(call, field):
    with pytest.raises(InputError) as caught:
        call()
    assert caught.value.field == field
    assert caught.value.remedy


@pytest.mark.parametrize(
    "gains", [CONTROLLER, PidGains(3.0, 6.0), PidGains(-2.0), PidGains(2.0, 5.0, 1.0, 0.5)], ids=lambda g: g.controller
)
@pytest.mark.parametrize("interval_s", [0.02, 0.2])
def test_the_response_of_a_sampled_controller_to_a_sine(gains, interval_s):
    """The discrete controller on a sine of 8 s, after 40 s: what it does is what its held response says."""
    t = np.arange(0.0, 80.0 + interval_s / 2.0, interval_s)
    pv = np.sin(2.0 * math.pi / 8.0 * t)
    settings, state = PidSettings(gains), started(PidSettings(gains), 0.0, 0.0, 0.0, 0.0)
    output = [0.0]
    for now, value in zip(t[1:].tolist(), pv[1:].tolist(), strict=True):
        state = step(settings, state, now, value, 0.0)
        output.append(state.output)
    late = t >= 40.0 - interval_s / 2.0
    seen = online_relay.seen_response(t[late], pv[late], np.array(output)[late], 8.0)
    expected = math.copysign(1.0, gains.Kp) * online_relay.held_response(gains, 8.0, interval_s)
    # the controller takes the PV between samples for straight: (w d)^2/12 of the derivative part
    assert seen == pytest.approx(expected, rel=1e-3 if interval_s < 0.1 else 1e-2)


def test_a_continuous_controller_is_not_held():
    """P only: the gain itself; held for a quarter of the period: turned by 45 degrees, sinc(1/4)."""
    assert online_relay.held_response(PidGains(3.0), 8.0, 0.0) == pytest.approx(3.0)
    held = online_relay.held_response(PidGains(3.0), 8.0, 2.0)
    assert cmath.phase(held) == pytest.approx(-math.pi / 4.0)
    assert abs(held) == pytest.approx(3.0 * math.sin(math.pi / 4.0) / (math.pi / 4.0))


def test_an_experiment_oscillates_as_the_exact_run_does():
    """Sampled at 10 ms with an ideal relay: within the samples' delay of the continuous loop."""
    settings = dataclasses.replace(SETTINGS, sample_time_s=0.01, hysteresis=0.0, min_periods=6, accuracy=1e-4)
    beside = controller_beside(conduct(settings))
    exact = run_parallel_relay(
        PLANT, symmetric_relay(10.0), Pid(CONTROLLER.Kp, CONTROLLER.Ti, CONTROLLER.Td, CONTROLLER.Tf), 150.0, 0.01
    )
    assert beside.cycle.Pu == pytest.approx(exact.period_s, rel=5e-3)
    assert pytest.approx(exact.peak, rel=2e-2) == beside.cycle.A
    assert pytest.approx(exact.fundamental, rel=2e-2) == beside.cycle.A1
    assert beside.seen == pytest.approx(beside.declared, rel=1e-3)
    assert not beside.cycle.alone
    assert math.isnan(beside.cycle.Ku)


@pytest.mark.one_of(2)
@pytest.mark.parametrize("K", [1.0, -1.0])
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_both_estimators_from_one_experiment(K, noise):
    gains = dataclasses.replace(CONTROLLER, Kp=math.copysign(CONTROLLER.Kp, K))
    settings = dataclasses.replace(SETTINGS, direct=K > 0.0, online=gains)
    found = identify(conduct(settings, plants.Fopdt(K, 10.0, 2.0), noise), known_gain=K)
    approximate = found.estimates["describing_function"]
    assert pytest.approx(10.0, rel=0.05) == approximate.model.T
    assert pytest.approx(2.0, rel=0.02) == approximate.model.D
    assert approximate.evidence["controller"] == pytest.approx(approximate.evidence["controller_seen"], rel=0.05)
    assert found.recommended == "least_squares"
    assert pytest.approx(10.0, rel=0.01) == found.model.T
    assert pytest.approx(2.0, rel=0.01) == found.model.D
    assert not any("controller" in warning for warning in found.warnings)
    assert "controller" in found.estimates["closed_form"].refusal


def test_the_bias_shrinks_with_the_relays_share():
    """T from the peak: without a controller 18.5 % low; the stronger the controller, the nearer to the truth."""
    errors = []
    for gains in (PidGains(1.0), PidGains(3.0, 10.0), CONTROLLER):
        beside = controller_beside(conduct(dataclasses.replace(SETTINGS, online=gains)))
        found = by_describing_function(beside.cycle, Known(1.0, "given"), None, "fopdt", "peak", beside)
        errors.append(10.0 - found.model.T)
    assert 1.85 > errors[0] > errors[1] > errors[2] > 0.0


@pytest.mark.parametrize("seed", range(3))
def test_the_relay_is_taken_out_as_it_switched_under_slow_noise(seed):
    """A proportional controller: what is left of the output is the relay, so the rest is the gain times the PV."""
    gains = PidGains(2.0)
    settings = dataclasses.replace(SETTINGS, online=gains, quiet_s=10.0)
    recording = conduct(settings, sensors=[ColouredNoise(0.1, 0.5, seed=seed)])
    assert recording.settings["disturbance_sigma"] > 1.5 * recording.settings["noise_sigma"]
    relay = relay_part(recording).recording
    rows = np.searchsorted(recording.t, relay.t)
    left = recording.output[rows] - relay.output + gains.Kp * relay.pv
    assert np.ptp(left) < 1e-6


def test_a_controller_held_back_by_a_limit_has_no_describing_function():
    narrow = dataclasses.replace(SETTINGS, limits=Limits(output=(28.0, 52.0)))
    found = identify(conduct(narrow), known_gain=1.0)
    assert "limit" in found.estimates["describing_function"].refusal
    assert pytest.approx(10.0, rel=1e-3) == found.model.T


@pytest.mark.long  # tests/service tunes a noisy loop beside its controller
def test_least_squares_has_no_bias_from_the_feedback_of_the_noise():
    """20 experiments: the mean of D and of K/T (what the relay shows) is the truth within its own error."""
    models = [identify(conduct(SETTINGS, noise=0.1, seed=seed), structure="fopdt").model for seed in range(20)]
    for values, truth in (([m.D for m in models], 2.0), ([m.K / m.T for m in models], 0.1)):
        assert np.mean(values) == pytest.approx(truth, abs=3.0 * np.std(values, ddof=1) / math.sqrt(len(values)))
