"""A controller beside the stages: worked by hand, within its limits, taken apart again, and a whole experiment."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotuner.core.design.gains import PidGains
from autotuner.core.experiment.experiment import Experiment
from autotuner.core.experiment.parallel_controller import Parallel, relay_part
from autotuner.core.experiment.phases import Phase
from autotuner.core.experiment.settings import ExperimentSettings, Limits
from autotuner.core.recording import Recording, Sample
from autotuner.errors import InputError
from autotuner_sim.effects import Noise
from autotuner_sim.plants import Fopdt
from autotuner_sim.stepped import SteppedPlant

CONTROLLER = PidGains(Kp=4.2, Ti=3.67, Td=0.92, Tf=0.092)
PROPORTIONAL = PidGains(Kp=2.0)
SETTINGS = ExperimentSettings(sample_time_s=0.1, amplitude=10.0, online=CONTROLLER)


def conduct(settings, output0=40.0, noise=0.0, plant=None):
    """Step the experiment over a plant until it wants to restore; return it with its recording."""
    loop = SteppedPlant(
        plant or Fopdt(1.0, 10.0, 2.0), output0=output0, pv0=80.0, sensors=[Noise(noise, seed=1)] if noise else []
    )
    experiment, samples, output = Experiment(settings, output0), [], output0
    for k in range(20_000):
        t = k * settings.sample_time_s
        loop.advance(t)
        pv = loop.measure()
        command = experiment.step(Sample(t, pv, output))
        if command.phase is Phase.RESTORE:
            assert command.output == output0
            return experiment, Recording.from_samples(samples, experiment.settings_so_far()) if samples else None
        loop.output = output = command.output
        samples.append(Sample(t, pv, output))
    raise AssertionError("the experiment did not end")


def test_a_proportional_controller_by_hand():
    """Rest at PV 80 and output 40; a PV of 81 takes 2 off, the relay's 50 adds 10."""
    beside = Parallel(PROPORTIONAL, 40.0, (0.0, 100.0))
    assert beside.step(Sample(0.0, 80.0, 40.0), 40.0, resting=True) == 40.0
    assert beside.step(Sample(1.0, 81.0, 40.0), 50.0, resting=False) == 48.0


def test_the_set_point_is_the_mean_of_the_rest():
    beside = Parallel(PROPORTIONAL, 40.0, (0.0, 100.0))
    for t, pv in enumerate([79.0, 80.0, 81.0]):
        beside.step(Sample(float(t), pv, 40.0), 40.0, resting=True)
    moved = beside.step(Sample(3.0, 82.0, 40.0), 40.0, resting=False)
    # the bias was 40 with set point and PV at 79; the set point is 80 by now
    assert moved == pytest.approx(40.0 + 2.0 * (80.0 - 82.0))


def test_integral_action_by_hand():
    """Over each second at an error of -1 the integral loses Kp/Ti; over the first the error goes from 0 to -1."""
    beside = Parallel(PidGains(Kp=2.0, Ti=4.0), 40.0, (0.0, 100.0))
    outputs = [beside.step(Sample(0.0, 80.0, 40.0), 40.0, resting=True)]
    outputs += [beside.step(Sample(t, 81.0, 40.0), 40.0, resting=False) for t in (1.0, 2.0, 3.0)]
    assert outputs == pytest.approx([40.0, 40.0 - 2.0 - 0.25, 40.0 - 2.0 - 0.75, 40.0 - 2.0 - 1.25])


@given(
    st.floats(0.1, 50.0),
    st.floats(0.1, 1e3),
    st.floats(0.0, 5.0),
    st.lists(st.tuples(st.floats(-1e3, 1e3), st.sampled_from([25.0, 40.0, 60.0])), min_size=1, max_size=30),
)
def test_it_starts_without_a_bump_and_keeps_the_sum_within_limits(Kp, Ti, Td, course):
    beside = Parallel(PidGains(Kp, Ti, Td, Td / 10.0), 40.0, (0.0, 100.0))
    assert beside.step(Sample(0.0, course[0][0], 40.0), 40.0, resting=True) == 40.0
    for k, (pv, wanted) in enumerate(course):
        output = beside.step(Sample(k + 1.0, pv, 40.0), wanted, resting=False)
        assert -1e-9 <= output <= 100.0 + 1e-9


def test_a_limit_does_not_wind_the_controller_up():
    """After 1000 s of a PV far too low the output is off its limit as soon as the PV is back above the set point."""
    beside = Parallel(PidGains(Kp=2.0, Ti=4.0), 40.0, (0.0, 100.0))
    beside.step(Sample(0.0, 80.0, 40.0), 40.0, resting=True)
    for t in range(1, 1001):
        assert beside.step(Sample(float(t), 20.0, 40.0), 40.0, resting=False) <= 100.0
    assert beside.step(Sample(1001.0, 82.0, 40.0), 40.0, resting=False) < 100.0


def test_what_was_added_up_comes_apart():
    """With a proportional controller the other part is `Kp (rest - pv)` at every sample."""
    experiment, recording = conduct(dataclasses.replace(SETTINGS, online=PROPORTIONAL), noise=0.02)
    part = relay_part(recording)
    start, end = experiment.segments["relay"], experiment.segments["half_relay"]
    rows = (recording.t >= start) & (recording.t < end)
    relay = part.recording.output[part.recording.t < end]
    rest = recording.pv[recording.t <= start].mean()
    bias = 40.0 + PROPORTIONAL.Kp * (rest - recording.pv[0])
    expected = bias - 40.0 + PROPORTIONAL.Kp * (recording.pv[0] - recording.pv[rows])
    assert set(relay) == {experiment.settings_so_far()["relay_low"], experiment.settings_so_far()["relay_high"]}
    assert recording.output[rows] - relay == pytest.approx(expected, abs=1e-9)
    assert part.gains == PROPORTIONAL


def test_a_recording_of_a_relay_alone_has_no_such_part():
    _, recording = conduct(dataclasses.replace(SETTINGS, online=None), noise=0.02)
    assert relay_part(recording) is None


def test_a_recording_that_ends_before_the_relay_has_no_such_part():
    _, recording = conduct(SETTINGS, noise=0.02)
    quiet = recording.window(0.0, 3.0)
    assert relay_part(quiet) is None
    assert relay_part(Recording(quiet.t, quiet.output, quiet.pv, settings={"online": CONTROLLER.to_dict()})) is None


def test_a_whole_experiment_beside_a_controller():
    experiment, recording = conduct(SETTINGS, noise=0.02)
    assert experiment.verdict is None
    assert list(experiment.segments) == ["relay", "half_relay", "staircase", "tail"]
    assert recording.settings["online"] == CONTROLLER.to_dict()
    relay_phase = (recording.t >= experiment.segments["relay"]) & (recording.t < experiment.segments["half_relay"])
    assert np.unique(recording.output[relay_phase]).size > 100
    assert recording.output.min() >= 0.0
    assert recording.output.max() <= 100.0


def test_the_controller_takes_the_bias_of_a_lopsided_relay_away():
    """The PV swings about its rest in the end."""
    experiment, recording = conduct(dataclasses.replace(SETTINGS, ratio=5.0, min_periods=6), noise=0.02)
    last = (recording.t > experiment.segments["half_relay"] - 14.0) & (recording.t < experiment.segments["half_relay"])
    assert recording.pv[last].mean() == pytest.approx(80.0, abs=0.3)


def test_a_loop_at_the_end_of_its_range_is_refused():
    experiment, _ = conduct(SETTINGS, output0=0.0)
    assert experiment.verdict.code == "no_room_beside_controller"
    assert "0" in experiment.verdict.message


def test_live_estimates_show_no_ultimate_gain_beside_a_controller():
    loop = SteppedPlant(Fopdt(1.0, 10.0, 2.0), output0=40.0, pv0=80.0)
    experiment, output, gains = Experiment(SETTINGS, 40.0), 40.0, []
    for k in range(400):
        loop.advance(k * 0.1)
        command = experiment.step(Sample(k * 0.1, loop.measure(), output))
        loop.output = output = command.output
        gains += [command.estimate.ultimate_gain] if command.estimate else []
    assert gains
    assert np.isnan(gains).all()


@pytest.mark.parametrize(("Kp", "direct"), [(-1.0, True), (1.0, False)])
def test_a_controller_that_would_run_away_is_refused(Kp, direct):
    with pytest.raises(InputError, match="run away") as caught:
        ExperimentSettings(direct=direct, online=PidGains(Kp))
    assert caught.value.field == "online.Kp"


def test_settings_are_dumped_with_the_controller():
    assert ExperimentSettings(online=PROPORTIONAL).to_dict()["online"] == {
        "controller": "P",
        "Kp": 2.0,
        "Ti": None,
        "Td": 0.0,
        "Tf": 0.0,
        "b": 1.0,
        "N": None,
    }
    assert ExperimentSettings(limits=Limits()).to_dict()["online"] is None
