"""Noise does not switch the relay: of a loop that waits in the dead zone for its answer, at any sampling rate."""

import math
from statistics import NormalDist

import numpy as np
import pytest

from autotuner.core.experiment.experiment import Experiment
from autotuner.core.experiment.phases import Phase
from autotuner.core.experiment.relay import Relay, SwitchFilter
from autotuner.core.experiment.settings import ExperimentSettings
from autotuner.core.recording import Sample
from autotuner_sim import Fopdt, Noise, SteppedPlant

OUTPUT0, PV0, AMPLITUDE = 40.0, 80.0, 10.0


def conduct(seed, *, scale, rate, sigma):
    """Tune K 2, T 200, D 30 (times `scale`) with so many samples in a dead time; return experiment and switches."""
    plant = Fopdt(2.0, 200.0 * scale, 30.0 * scale)
    settings = ExperimentSettings(sample_time_s=plant.D / rate, amplitude=AMPLITUDE, check=False)
    loop = SteppedPlant(plant, output0=OUTPUT0, pv0=PV0, sensors=[Noise(sigma, seed=seed)])
    experiment, output, switches = Experiment(settings, OUTPUT0), OUTPUT0, []
    for k in range(40 * rate):
        t = k * settings.sample_time_s
        loop.advance(t)
        command = experiment.step(Sample(t, loop.measure(), output))
        if command.phase is Phase.RESTORE:
            return experiment, switches
        if command.output != output:
            switches.append(t)
        loop.output = output = command.output
    raise AssertionError("the experiment did not end")


@pytest.mark.one_of(2)
@pytest.mark.parametrize(("scale", "rate", "sigma"), [(1.0, 30, 0.05), (1.0, 300, 0.05), (0.1, 300, 0.3)])
def test_a_slow_noisy_loop_is_switched_by_its_process_alone(scale, rate, sigma):
    """The first move of the relay is that of the start; the next cannot come before the process has answered."""
    for seed in range(12):
        experiment, switches = conduct(seed, scale=scale, rate=rate, sigma=sigma)
        assert experiment.verdict is None, experiment.verdict
        assert np.diff(switches).min() > 30.0 * scale


def test_false_switches_are_as_rare_as_the_binomial_says():
    """With a dead zone of 1.5 sigma: three of five beyond it, 10 p^3 (1 - p)^2 + 5 p^4 (1 - p) + p^5 of readings."""
    pv = np.random.default_rng(1).standard_normal(200_000)
    switch_filter = SwitchFilter(1.5, 1.0, from_rest=True)
    beyond = np.mean([switch_filter.step(value) > 1.5 for value in pv.tolist()])
    p = 1.0 - NormalDist().cdf(1.5)
    wanted = sum(math.comb(5, k) * p**k * (1.0 - p) ** (5 - k) for k in (3, 4, 5))
    assert beyond == pytest.approx(wanted, rel=0.15)
    assert np.mean(pv > 1.5) > 20.0 * beyond


@pytest.mark.parametrize(("hysteresis", "sigma"), [(1.0, 0.0), (4.5, 1.0), (0.0, 0.0)])
def test_a_wide_dead_zone_believes_every_reading(hysteresis, sigma):
    switch_filter = SwitchFilter(hysteresis, sigma, from_rest=True)
    values = [0.0, 100.0, 0.0, -100.0]
    assert [switch_filter.step(value) for value in values] == values


def test_the_wider_the_longer_the_relay_has_not_switched():
    switch_filter = SwitchFilter(3.0, 1.0)
    assert [switch_filter.step(float(k)) for k in range(30)] == [float(k) for k in range(30)]
    assert [switch_filter.step(float(k)) for k in range(30, 100)] == [float(k - 1) for k in range(30, 100)]
    assert [switch_filter.step(float(k)) for k in range(100, 110)] == [float(k - 2) for k in range(100, 110)]
    relay = Relay(30.0, 50.0, 80.0, 3.0)
    assert [switch_filter.switched(relay, is_high=False, pv=pv) for pv in (70.0, 70.0, 70.0)] == [False, False, True]
    assert switch_filter.step(7.0) == 7.0
