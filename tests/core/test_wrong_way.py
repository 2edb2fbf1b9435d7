"""A first move against the declared action: an inverse response is waited for, a process of the other sign refused."""

import re

import numpy as np
import pytest

from autotuner.core.experiment.experiment import Experiment
from autotuner.core.experiment.phases import Phase
from autotuner.core.experiment.relay_phase.action_check import inverse_sign
from autotuner.core.experiment.settings import ExperimentSettings, Limits
from autotuner.core.recording import Sample
from autotuner_sim.effects import Noise
from autotuner_sim.plants import Fopdt, Integrating, InverseResponse, SopdtUnderdamped
from autotuner_sim.stepped import SteppedPlant

HYSTERESIS, AT_REST = 0.1, 80.0


def conduct(plant, settings, output=40.0, sigma=0.005):
    """Step the experiment until it wants to restore; return it and how far the first push went the wrong way."""
    device = SteppedPlant(plant, output0=output, pv0=AT_REST, sensors=[Noise(sigma, seed=1)] if sigma else [])
    experiment, worst, up = Experiment(settings, output), 0.0, 1.0 if settings.direct else -1.0
    levels = [output]
    for k in range(100_000):
        t = k * settings.sample_time_s
        device.advance(t)
        pv = device.measure()
        if len(levels) == 2:
            worst = max(worst, up * (AT_REST - pv) * (1.0 if output > levels[0] else -1.0))
        command = experiment.step(Sample(t, pv, output))
        device.output = output = command.output
        levels += [output] if output != levels[-1] else []
        if command.phase is Phase.RESTORE:
            return experiment, worst
    raise AssertionError("the experiment did not end")


def asking(**more):
    return ExperimentSettings(sample_time_s=0.1, amplitude=10.0, hysteresis=HYSTERESIS, **more)


@pytest.mark.parametrize(
    "plant",
    [
        Fopdt(-2.0, 10.0, 1.5),
        Fopdt(-0.15, 10.0, 1.5),
        Fopdt(-2.0, 1.0, 60.0),
        Integrating(-0.05, 2.0, 1.0),
        SopdtUnderdamped(-0.5, 9.0, 2.4, 1.0),
    ],
    ids=str,
)
def test_a_process_of_the_other_sign_is_refused_after_twenty_hystereses_at_most(plant):
    experiment, worst = conduct(plant, asking(response_limit_s=120.0))
    assert experiment.verdict is not None
    assert experiment.verdict.code == "wrong_action"
    # One sample more than twenty hystereses, however fast the process.
    assert worst < 20.0 * HYSTERESIS + 0.1 * abs(plant.K) * 20.0


@pytest.mark.parametrize("zero", [1.0, 3.0])
@pytest.mark.parametrize("direct", [True, False])
def test_a_process_that_only_starts_the_wrong_way_is_tuned(zero, direct):
    sign = 1.0 if direct else -1.0
    experiment, worst = conduct(InverseResponse(0.5 * sign, 4.0, 3.0, zero, 0.5), asking(direct=direct))
    assert experiment.verdict is None
    assert list(experiment.segments) == ["relay", "half_relay", "staircase", "tail"]
    assert (zero > 2.0) == (worst > 10.0 * HYSTERESIS)


@pytest.mark.parametrize("sigma", [0.0, 0.005])
@pytest.mark.parametrize("zero", [0.5, 3.7, 6.0])
@pytest.mark.parametrize("sample_time_s", [0.05, 0.2])
def test_with_default_settings_an_inverse_response_is_waited_for(zero, sigma, sample_time_s):
    plant = InverseResponse(0.5, 4.0, 3.0, zero, 0.5)
    experiment, _ = conduct(plant, ExperimentSettings(sample_time_s=sample_time_s, amplitude=10.0), sigma=sigma)
    assert experiment.verdict is None


@pytest.mark.parametrize("sigma", [0.0, 0.005])
@pytest.mark.parametrize(
    "plant", [Fopdt(-2.0, 10.0, 1.5), Fopdt(-2.0, 1.0, 6.0), Integrating(-0.05, 2.0, 1.0)], ids=str
)
def test_with_default_settings_a_wrong_action_is_refused(plant, sigma):
    settings = ExperimentSettings(sample_time_s=0.1, amplitude=10.0)
    experiment, _ = conduct(plant, settings, sigma=sigma)
    assert experiment.verdict is not None
    assert experiment.verdict.code == "wrong_action"


def test_a_wrong_action_is_refused_half_way_to_a_pv_limit():
    limits = Limits(pv=(AT_REST - 2.0, AT_REST + 2.0))
    experiment, worst = conduct(Integrating(-0.05, 2.0, 1.0), ExperimentSettings(0.1, limits, amplitude=10.0))
    assert experiment.verdict.code == "wrong_action"
    assert worst < 1.3


@pytest.mark.parametrize(("zero", "seen"), [(3.7, "has turned"), (4.5, "slows down")])
def test_an_inverse_response_that_is_refused_is_named_with_what_lets_it_pass(zero, seen):
    """A dip of some 15 hystereses: it turns after a dip that is too long, or is caught short of its turning."""
    plant = InverseResponse(0.5, 4.0, 3.0, zero, 0.5)
    refused, _ = conduct(plant, asking())
    assert refused.verdict.code == "wrong_action"
    assert f"the response is inverse: the PV {seen}" in refused.verdict.message
    wanted = float(re.search(r"relay.hysteresis to ([\d.]+)", refused.verdict.remedy)[1])
    tuned, _ = conduct(plant, ExperimentSettings(sample_time_s=0.1, amplitude=10.0, hysteresis=wanted))
    assert tuned.verdict is None


@pytest.mark.parametrize("plant", [Fopdt(-2.0, 10.0, 1.5), Integrating(-0.05, 2.0, 1.0)], ids=str)
def test_a_process_of_the_other_sign_is_not_called_inverse(plant):
    experiment, _ = conduct(plant, asking())
    assert "inverse" not in experiment.verdict.message + experiment.verdict.remedy


WAY = np.arange(1.0, 21.0)


@pytest.mark.parametrize(
    ("away", "noise_sigma", "seen"),
    [
        (WAY, 0.0, ""),
        (WAY**2, 0.0, ""),
        (np.sqrt(WAY), 0.0, ""),  # a ramp behind a lag does so, too
        (1.0 - np.exp(-WAY / 5.0), 0.0, "slows down on its way"),
        (1.0 - np.exp(-WAY / 5.0), 0.2, ""),
        (np.concatenate((WAY, WAY[:-4:-1])), 0.0, "has turned and is on its way back"),
        (np.concatenate((WAY, WAY[:-4:-1])), 0.3, "has turned and is on its way back"),
        (np.concatenate((WAY, WAY[:-4:-1])), 1.0, ""),
        (WAY[:4], 0.0, ""),
    ],
)
def test_what_a_way_shows(away, noise_sigma, seen):
    assert inverse_sign(away.tolist(), noise_sigma) == seen
