"""A start away from steady state: refused with advice, or followed; the process is found all the same."""

from dataclasses import replace

import numpy as np
import pytest

from autotuner import identify
from autotuner.application.analysis.procedure import analyse
from autotuner.core.design import PidGains
from autotuner.core.experiment.baseline import Line, grows, line_of
from autotuner.core.experiment.experiment import Experiment
from autotuner.core.experiment.phases import Phase
from autotuner.core.experiment.refusals import drifting
from autotuner.core.experiment.settings import ExperimentSettings, Limits
from autotuner.core.identification import running_model
from autotuner.core.model import process
from autotuner.core.recording import Recording, Sample
from autotuner.core.signals.quiet import QuietMeasurement
from autotuner.errors import InputError
from autotuner_sim import (
    Fopdt,
    Integrating,
    LoadRamp,
    LoadStep,
    Noise,
    SopdtOverdamped,
    SteppedPlant,
    find_limit_cycle,
    symmetric_relay,
)
from autotuner_sim.effects import Drift

AMPLITUDE, OUTPUT0, PV0 = 10.0, 40.0, 80.0


def conduct(plant, settings, loads=(), offsets=(), sigma=0.0, longest=20_000, *, integrating=None):
    """Run an experiment as the runtime does, the running model included; return it with its recording."""
    sensors = [Noise(sigma, seed=3)] if sigma else []
    loop = SteppedPlant(plant, output0=OUTPUT0, pv0=PV0, loads=loads, offsets=offsets, sensors=sensors)
    experiment, samples, output, model = Experiment(settings, OUTPUT0), [], OUTPUT0, None
    for k in range(longest):
        t = k * settings.sample_time_s
        loop.advance(t)
        pv = loop.measure()
        command = experiment.step(Sample(t, pv, output))
        if command.phase is Phase.RESTORE:
            return experiment, samples and Recording.from_samples(samples, experiment.settings_so_far())
        loop.output = output = command.output
        samples.append(Sample(t, pv, output))
        if command.estimate is not None and command.estimate.half_period >= 2:
            seen = experiment.settings_so_far()
            begun = None if model is None else model.model
            model = running_model(Recording.from_samples(samples, seen), seen["noise_sigma"], begun)
            error = np.inf if model is None else model.relative_error
            experiment.inform(error, integrating=integrating)
    raise AssertionError("the experiment did not end")


def model_of(recording, plant):
    """Return the process of a record whose structure is known: which one it is has tests of its own."""
    return identify(recording, structure=plant.structure, profile=False).model


def oscillation(plant):
    """Return period and PV amplitude under the relay, from the simulator's exact cycle."""
    cycle = find_limit_cycle(plant, symmetric_relay())
    return cycle.period_s, AMPLITUDE * cycle.peak


@pytest.mark.one_of(2)
@pytest.mark.parametrize(
    "plant",
    [
        *(Fopdt(2.0, 10.0, D) for D in (1.0, 10.0, 50.0)),
        pytest.param(SopdtOverdamped(2.0, 10.0, 5.0, 3.0), marks=pytest.mark.long),
    ],
)
@pytest.mark.parametrize("drift", [pytest.param(-1.0, marks=pytest.mark.long), 0.2, 1.0])
def test_a_drift_is_followed_and_does_not_touch_the_process(plant, drift):
    """`drift` in amplitudes a period, with default settings."""
    Pu, A = oscillation(plant)
    settings = ExperimentSettings(sample_time_s=Pu / 80.0, amplitude=AMPLITUDE)
    experiment, recording = conduct(plant, settings, offsets=[Drift(drift * A / Pu)], sigma=0.01 * A)
    assert experiment.verdict is None
    assert recording.duration_s < 25.0 * Pu
    identification = identify(recording, structure=plant.structure, profile=False)
    model = identification.model
    assert "drift" in identification.estimates["least_squares"].evidence["background"]
    assert pytest.approx(plant.K, rel=0.05) == model.K
    assert pytest.approx(plant.D, rel=0.05) == model.D
    if plant.structure == "fopdt":
        assert pytest.approx(plant.T, rel=0.05) == model.T


def on_the_way_to_another_rest(load):
    plant = Fopdt(2.0, 10.0, 1.0)
    Pu, A = oscillation(plant)
    settings = ExperimentSettings(sample_time_s=Pu / 80.0, amplitude=AMPLITUDE, drift_compensation=True)
    experiment, recording = conduct(plant, settings, loads=[LoadStep(0.0, load)], sigma=0.01 * A)
    assert experiment.verdict is None
    return plant, recording


def test_a_process_on_its_way_to_another_rest_is_found():
    plant, recording = on_the_way_to_another_rest(4.0)
    model = model_of(recording, plant)
    assert pytest.approx((2.0, 10.0, 1.0), rel=0.05) == (model.K, model.T, model.D)


@pytest.mark.long  # the process is found above
@pytest.mark.parametrize("load", [-4.0, 4.0])
def test_a_process_on_its_way_to_another_rest_is_tuned_too(load):
    _, recording = on_the_way_to_another_rest(load)
    analysis = analyse(recording)
    model = analysis.identification.model
    assert pytest.approx((2.0, 10.0, 1.0), rel=0.05) == (model.K, model.T, model.D)
    assert not any(text.startswith("diagnosis") for text in analysis.warnings)
    assert analysis.diagnosis.verdict == "adequate" or any("diagnosis" in text for text in analysis.notes)


def test_without_the_setting_it_is_refused_with_numbers_and_both_ways_out():
    plant = Fopdt(2.0, 10.0, 1.0)
    settings = ExperimentSettings(sample_time_s=0.1, amplitude=AMPLITUDE)
    experiment, _ = conduct(plant, settings, offsets=[Drift(1.0)], sigma=0.01)
    assert experiment.verdict.code == "pv_drifts"
    assert "60" in experiment.verdict.message
    assert "while the output is held" in experiment.verdict.message
    assert "drift_compensation" in experiment.verdict.remedy


def test_a_small_drift_is_followed_without_the_setting():
    """A tenth of the amplitude in each period, and 0.001 a minute on a PV without noise."""
    plant = Fopdt(2.0, 10.0, 1.0)
    Pu, A = oscillation(plant)
    settings = ExperimentSettings(sample_time_s=Pu / 80.0, amplitude=AMPLITUDE)
    for drift_per_s, sigma in ((0.1 * A / Pu, 0.01 * A), (0.001 / 60.0, 0.0)):
        experiment, recording = conduct(plant, settings, offsets=[Drift(drift_per_s)], sigma=sigma)
        assert experiment.verdict is None
        model = model_of(recording, plant)
        assert pytest.approx((2.0, 10.0, 1.0), rel=0.05) == (model.K, model.T, model.D)


@pytest.mark.long  # a drift that grows, below, shows the same
@pytest.mark.parametrize("load", [-2.0, 3.0])
def test_an_integrator_that_drifts_at_rest_is_tuned_about_a_fixed_value(load):
    """An unknown load of a fifth and more of the relay: the PV never rests, and a line runs away from its start."""
    plant = Integrating(0.2, 4.0, 0.8)
    Pu, A = oscillation(plant)
    settings = ExperimentSettings(sample_time_s=Pu / 40.0, amplitude=AMPLITUDE)
    known = process.Integrating(0.2, 4.0, 0.8)
    experiment, recording = conduct(plant, settings, loads=[LoadStep(0.0, load)], sigma=0.005 * A, integrating=known)
    assert experiment.verdict is None
    returned = np.abs(recording.pv[recording.t >= recording.segments["return"]] - PV0)
    assert returned[-1] < 0.9 * returned[0]  # within four periods, and with the last dead time still to come
    assert any("fixed value" in warning for warning in experiment.warnings)
    assert "drift_per_s" not in recording.settings
    model = model_of(recording, plant)
    assert pytest.approx((0.2, 4.0, 0.8), rel=0.05) == (model.K, model.T, model.D)


def test_a_drift_that_grows_is_worked_against():
    plant = Integrating(0.2, 4.0, 0.4)
    Pu, A = oscillation(plant)
    settings = ExperimentSettings(sample_time_s=Pu / 60.0, amplitude=AMPLITUDE)
    ramp = LoadRamp(0.0, 0.5 * AMPLITUDE, 50.0 * Pu)
    experiment, recording = conduct(plant, settings, loads=[ramp], sigma=0.005 * A)
    assert experiment.verdict is None
    assert recording.segments["relay"] < 8.0 * settings.quiet_duration_s
    model = model_of(recording, plant)
    assert pytest.approx((0.2, 4.0, 0.4), rel=0.05) == (model.K, model.T, model.D)


def test_an_integrator_at_a_limit_of_the_output_is_told_to_move_its_operating_point():
    settings = ExperimentSettings(sample_time_s=0.2, amplitude=AMPLITUDE, limits=Limits(output=(OUTPUT0, 100.0)))
    experiment, _ = conduct(Integrating(0.2, 4.0, 0.8), settings, sigma=0.01)
    assert experiment.verdict.code == "no_oscillation"
    assert "operating point at which the output rests inside" in experiment.verdict.remedy
    assert "amplitude" not in experiment.verdict.remedy


def test_only_a_drift_that_becomes_faster_grows():
    t = np.linspace(0.0, 1.0, 100)
    noise = 1e-3 * np.random.default_rng(2).standard_normal(t.size)
    assert grows(t, -(t**2) + noise)
    assert not grows(t, t + noise)
    assert not grows(t, 1.0 - np.exp(-t) + noise)


def test_beside_a_controller_the_refusal_speaks_of_the_controller():
    plant = Fopdt(2.0, 10.0, 1.0)
    settings = ExperimentSettings(sample_time_s=0.1, amplitude=AMPLITUDE, online=PidGains(0.01))
    experiment, _ = conduct(plant, settings, offsets=[Drift(1.0)], sigma=0.01)
    assert experiment.verdict.code == "pv_drifts"
    assert "output is held" not in experiment.verdict.message
    assert "controller" in experiment.verdict.remedy


def test_it_does_not_go_with_a_controller_beside_the_relay():
    with pytest.raises(InputError) as caught:
        ExperimentSettings(drift_compensation=True, online=PidGains(0.1))
    assert caught.value.field == "drift_compensation"


def test_a_line_dies_away_by_its_exponential():
    """`pv(t) = 5 + 2 * 3 (1 - e^{-t/3})`, by hand."""
    line = Line(10.0, 5.0, 2.0, 3.0)
    assert line.at(10.0) == 5.0
    assert line.at(13.0) == pytest.approx(5.0 + 6.0 * (1.0 - np.exp(-1.0)))
    assert line.slope_at(13.0) == pytest.approx(2.0 * np.exp(-1.0))


def test_slope_and_decay_are_read_off_the_rest():
    t = np.linspace(0.0, 1.0, 200)
    noise = 1e-4 * np.random.default_rng(1).standard_normal(t.size)
    line = line_of(t, 7.0 - 4.0 * np.exp(-t / 5.0) + noise)
    assert line.slope_per_s == pytest.approx(0.8 * np.exp(-0.2), rel=0.02)
    assert line.decay_s == pytest.approx(5.0, rel=0.1)


@pytest.mark.parametrize("pv", [lambda t: 3.0 * (1.0 - np.exp(-t / 0.5)), lambda t: t**2])
def test_a_bend_that_cannot_be_foreseen_is_waited_for(pv):
    t = np.linspace(0.0, 1.0, 100)
    assert line_of(t, pv(t)) is None


def test_a_noise_that_is_only_rounding_is_told_as_none():
    """A register in tenths of a PV that falls evenly: between its steps nothing is left but the last digits."""
    quiet = QuietMeasurement(80.0, 5e-15, -1.0, 0.01, 0.1, 0.1, 0.0, 5.09157)
    assert "(watched for 5.09 s, noise 0)" in drifting(quiet, ExperimentSettings()).message
    assert "noise 0.02)" in drifting(replace(quiet, noise_sigma=0.02), ExperimentSettings()).message


def test_a_load_step_that_falls_into_the_rest_is_waited_out():
    """A line through it would be straight, but the PV is not on it; followed, the reference would run away."""
    settings = ExperimentSettings(sample_time_s=1.0, amplitude=AMPLITUDE)
    plant = Fopdt(2.0, 4.0, 6.0)
    experiment, recording = conduct(plant, settings, loads=[LoadStep(18.0, -3.0)], sigma=0.4)
    assert experiment.verdict is None
    assert recording.segments["relay"] > 60.0
    assert abs(recording.settings.get("drift_per_s", 0.0)) < 0.02
    assert pytest.approx(plant.K, rel=0.1) == model_of(recording, plant).K


@pytest.mark.parametrize("load", [15.0, pytest.param(-15.0, marks=pytest.mark.long)])
def test_the_levels_follow_a_load_that_is_larger_than_the_relay(load):
    """Neither level brings the PV back then: both move by an amplitude, and the relay goes on."""
    plant = Fopdt(2.0, 10.0, 1.0)
    Pu, A = oscillation(plant)
    settings = ExperimentSettings(sample_time_s=Pu / 40.0, amplitude=AMPLITUDE)
    experiment, recording = conduct(plant, settings, loads=[LoadStep(4.0 * Pu, load)], sigma=0.02 * A)
    assert experiment.verdict is None
    ends_s = recording.segments["half_relay"]
    relay = (recording.t > recording.segments["relay"]) & (recording.t < ends_s)
    lowest, highest = recording.output[relay].min(), recording.output[relay].max()
    assert pytest.approx(160.0 / 3.0 if load > 0.0 else 100.0 / 3.0) == (highest if load > 0.0 else lowest)
    moves = (highest - lowest) / AMPLITUDE - 2.0
    assert pytest.approx(round(moves)) == moves >= 1.0
    last = recording.pv[relay & (recording.t > ends_s - 2.0 * Pu)]
    assert last.min() < PV0 < last.max()


@pytest.mark.long  # a load larger than the relay, above, is followed the same way
def test_a_drift_unseen_at_rest_that_carries_a_long_dead_time_off_is_followed():
    """Beside a dead time half periods stay equal while the PV leaves: only a level that no longer returns it shows."""
    plant = Fopdt(2.0, 1.0, 7.0)
    Pu, A = oscillation(plant)
    settings = ExperimentSettings(sample_time_s=Pu / 40.0, amplitude=AMPLITUDE)
    drift = Drift(0.08 * A / Pu)
    experiment, recording = conduct(plant, settings, offsets=[drift], sigma=0.04 * A)
    assert experiment.verdict is None
    assert "half_relay" in recording.segments


def test_an_output_at_its_limit_follows_no_load_beyond_it():
    plant = Fopdt(2.0, 10.0, 1.0)
    Pu, A = oscillation(plant)
    limits = Limits(output=(30.0, 60.0))
    settings = ExperimentSettings(sample_time_s=Pu / 40.0, amplitude=AMPLITUDE, limits=limits)
    experiment, recording = conduct(plant, settings, loads=[LoadStep(2.5 * Pu, 30.0)], sigma=0.02 * A)
    assert experiment.verdict.code == "no_oscillation"
    assert recording.output.min() >= 30.0
