"""The relay amplitude, adapted to the oscillation: from far too small, from far too large, within every limit."""

import itertools

import pytest

from autotuner.core.experiment.relay_phase.steady_state_detector import SteadyStateDetector
from autotuner.core.experiment.settings import ExperimentSettings, Limits
from autotuner.core.identification import identify
from autotuner.errors import InputError
from autotuner_sim import Fopdt, SopdtUnderdamped, find_limit_cycle, symmetric_relay

from .test_drifting_start import conduct

PLANTS = (Fopdt(2.0, 10.0, 1.0), Fopdt(2.0, 10.0, 10.0), Fopdt(2.0, 10.0, 50.0), SopdtUnderdamped(2.0, 25.0, 4.0, 3.0))


def levels_of(recording):
    """Return half the swing before each pair of switches, in order, without repetition."""
    relay = recording.window(recording.settings["segments"]["relay"], recording.settings["segments"]["half_relay"])
    outputs = [u for u, _ in itertools.groupby(relay.output[:-1].tolist())]
    return [abs(b - a) / 2.0 for a, b in itertools.pairwise(outputs)]


@pytest.mark.one_of(2)
@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("start", [1.0, 40.0])
def test_the_amplitude_comes_to_the_wish(plant, start):
    """Ten times too small, and five times too large, for the wish of what a relay of 10, or of 8, makes."""
    cycle = find_limit_cycle(plant, symmetric_relay())
    spec = cycle.peak * (10.0 if start < 10.0 else 8.0)
    settings = ExperimentSettings(
        sample_time_s=cycle.period_s / 80.0, amplitude=start, pv_amplitude=spec, max_amplitude=max(start, 30.0)
    )
    experiment, recording = conduct(plant, settings, sigma=0.01 * spec)
    assert experiment.verdict is None
    reached = (recording.settings["relay_high"] - recording.settings["relay_low"]) / 2.0
    assert 8.0 / 2.0 < reached < 10.0 * 2.0
    assert recording.output.min() >= 0.0
    assert recording.output.max() <= 100.0
    swings = levels_of(recording)
    assert all(1.0 / 4.5 < b / a < 4.5 for a, b in itertools.pairwise(swings))
    identification = identify(recording, structure=plant.structure, profile=False)
    assert pytest.approx(plant.K, rel=0.03) == identification.model.K
    assert pytest.approx(plant.D, rel=0.03) == identification.model.D
    if identification.limit_cycle is not None:
        assert identification.limit_cycle.h == pytest.approx(reached)


@pytest.mark.one_of(2)
@pytest.mark.parametrize("plant", PLANTS)
def test_a_relay_that_is_lost_in_the_noise_is_made_stronger(plant):
    sigma = 0.2 * find_limit_cycle(plant, symmetric_relay()).peak
    period_s = find_limit_cycle(plant, symmetric_relay()).period_s
    settings = ExperimentSettings(sample_time_s=period_s / 80.0, amplitude=0.3, max_amplitude=30.0)
    experiment, recording = conduct(plant, settings, sigma=sigma)
    assert experiment.verdict is None
    assert recording.settings["relay_high"] - recording.settings["relay_low"] > 2.0 * 0.3
    assert pytest.approx(plant.K, rel=0.15) == identify(recording, structure=plant.structure, profile=False).model.K


def test_a_relay_that_is_given_grows_no_stronger_without_leave():
    settings = ExperimentSettings(sample_time_s=0.1, amplitude=1.0, pv_amplitude=50.0)
    experiment, recording = conduct(Fopdt(2.0, 10.0, 1.5), settings, sigma=0.01)
    assert experiment.verdict is None
    assert max(levels_of(recording)) == pytest.approx(1.0)


def test_a_wish_beyond_the_pv_limits_stops_half_way_to_them():
    limits = Limits(pv=(70.0, 90.0))
    settings = ExperimentSettings(
        sample_time_s=0.1, amplitude=1.0, pv_amplitude=30.0, max_amplitude=40.0, limits=limits
    )
    _, recording = conduct(Fopdt(2.0, 10.0, 1.5), settings, sigma=0.01)
    assert recording.pv.min() > 70.0
    assert recording.pv.max() < 90.0
    assert max(levels_of(recording)) > 2.0


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"pv_amplitude": 0.0}, "pv_amplitude"),
        ({"max_amplitude": 60.0}, "max_amplitude"),
        ({"amplitude": 20.0, "max_amplitude": 10.0}, "max_amplitude"),
        ({"side": "heat"}, "side"),
        ({"side": "cool", "amplitude": 60.0, "limits": Limits(output=(-100.0, 100.0))}, "amplitude"),
    ],
)
def test_settings_that_cannot_work_name_the_field(values, field):
    with pytest.raises(InputError) as caught:
        ExperimentSettings(**values)
    assert caught.value.field == field


def test_a_stall_is_an_answer_that_has_come_to_rest():
    silent, settled, moving = (
        SteadyStateDetector(0.0, 0.0),
        SteadyStateDetector(0.0, 0.0),
        SteadyStateDetector(0.0, 0.0),
    )
    assert not any(silent.step(0.0) for _ in range(300))
    assert [moved for k in range(300) if (moved := settled.step(min(k, 10.0)))] == [10.0] * 4
    assert not any(moving.step(float(k)) for k in range(300))
