"""The experiment stepped by hand, against the simulator's exact plant; the phase table; relay placement."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotuner.core.experiment.experiment import Experiment
from autotuner.core.experiment.phases import PHASES, TRANSITIONS, Phase, PhaseEvent, next_phase
from autotuner.core.experiment.relay import Relay, place_levels
from autotuner.core.experiment.relay_phase.adjustment import TARGET_DUTY, is_lopsided, recentred
from autotuner.core.experiment.settings import ExperimentSettings, Limits
from autotuner.core.experiment.stages import Approach
from autotuner.core.recording import Sample
from autotuner.core.state_table import IllegalTransitionError
from autotuner.core.verdict import aborted
from autotuner.errors import InputError
from autotuner_sim.effects import LoadStep, Noise, Quantisation
from autotuner_sim.plants import Fopdt, Integrating
from autotuner_sim.stepped import SteppedPlant


def conduct(plant, settings, output0=40.0, longest=30_000):
    """Step the experiment over a plant until it wants to restore; return it with its samples."""
    experiment, samples, output = Experiment(settings, output0), [], output0
    for k in range(longest):
        t = k * settings.sample_time_s
        plant.advance(t)
        command = experiment.step(Sample(t, plant.measure(), output))
        plant.output = output = command.output
        samples.append((t, output, command.phase))
        if command.phase is Phase.RESTORE:
            return experiment, samples
    raise AssertionError("the experiment did not end")


def heater(noise=0.05, output0=40.0, **parameters):
    plant = Fopdt(**({"K": 2.0, "T": 10.0, "D": 1.5} | parameters))
    return SteppedPlant(plant, output0=output0, pv0=80.0, sensors=[Noise(noise, seed=1)] if noise else [])


def test_a_whole_experiment_visits_the_phases_in_order():
    experiment, samples = conduct(heater(), ExperimentSettings(sample_time_s=0.1, amplitude=10.0))
    phases = list(dict.fromkeys(phase for _, _, phase in samples))
    assert phases == [Phase.QUIET, Phase.RELAY, Phase.CHECK, Phase.RESTORE]
    assert list(experiment.segments) == ["relay", "half_relay", "staircase", "tail"]
    assert experiment.verdict is None
    assert experiment.warnings == []
    experiment.restored()
    assert experiment.phase is Phase.ENDED


def test_the_check_moves_less_than_the_relay():
    experiment, samples = conduct(heater(), ExperimentSettings(sample_time_s=0.1, amplitude=10.0))
    start = experiment.segments["half_relay"]
    relay = [u for t, u, _ in samples if t < start]
    check = [u for t, u, phase in samples if t >= start and phase is Phase.CHECK]
    assert min(relay) <= min(check)
    assert max(check) <= max(relay)
    assert len(set(check)) > 8


def test_the_check_can_be_left_out():
    experiment, _ = conduct(heater(), ExperimentSettings(sample_time_s=0.1, amplitude=10.0, check=False))
    assert list(experiment.segments) == ["relay"]


def test_a_loop_at_the_end_of_its_range_is_pushed_off_first():
    experiment, samples = conduct(
        SteppedPlant(Fopdt(2.0, 10.0, 1.5), output0=0.0, pv0=20.0, sensors=[Noise(0.05, seed=1)]),
        ExperimentSettings(sample_time_s=0.1, amplitude=10.0),
        output0=0.0,
    )
    assert Phase.APPROACH in {phase for _, _, phase in samples}
    assert experiment.verdict is None
    assert {u for t, u, _ in samples if t < experiment.segments["half_relay"]} == {0.0, 20.0}


def test_an_integrating_process_is_tuned_too():
    plant = SteppedPlant(Integrating(0.05, 2.0, 1.0), output0=40.0, pv0=80.0, sensors=[Noise(0.02, seed=1)])
    experiment, _ = conduct(plant, ExperimentSettings(sample_time_s=0.1, amplitude=10.0))
    assert experiment.verdict is None


@pytest.mark.parametrize("load", [-6.0, 6.0])
def test_a_lopsided_relay_is_moved_to_the_middle(load):
    """A load step in the first oscillations leaves the relay far off its equilibrium."""
    plant = SteppedPlant(
        Fopdt(2.0, 30.0, 1.5), output0=40.0, pv0=80.0, loads=[LoadStep(20.0, load)], sensors=[Noise(0.02, seed=1)]
    )
    settings = ExperimentSettings(sample_time_s=0.1, amplitude=10.0, response_limit_s=2000.0)
    experiment, samples = conduct(plant, settings)
    assert experiment.verdict is None
    start, end = experiment.segments["half_relay"] - 30.0, experiment.segments["half_relay"]
    late = [u for t, u, _ in samples if start <= t < end]
    assert not is_lopsided(sum(u == max(late) for u in late) / len(late))


@pytest.mark.parametrize("load", [0.0, 0.3])
def test_an_integrating_process_at_the_end_of_its_range_is_not_carried_away(load):
    """No reference makes the periods equal: it is moved once, and not in proportion again and again."""
    plant = SteppedPlant(Integrating(0.02, 60.0, 3.0), output0=1.0 + load, pv0=50.0, sensors=[Noise(0.005, seed=1)])
    experiment, _ = conduct(plant, ExperimentSettings(sample_time_s=1.0), output0=1.0 + load)
    assert experiment.verdict is None
    assert abs(plant.measure() - 50.0) < 40.0


def test_the_reference_is_not_moved_near_a_limit_of_the_pv():
    """From 20 at rest with a limit at 26, the middle of the way is the farthest."""
    moved = recentred(Relay(0.0, 20.0, 22.0), 0.05, (0.0, 20.0), (0.0, 100.0), (0.0, 26.0))
    assert moved.reference == 23.0


def test_the_end_is_reached_within_the_time_limit():
    settings = ExperimentSettings(sample_time_s=0.1, amplitude=10.0, time_limit_s=20.0)
    experiment, samples = conduct(heater(), settings)
    assert experiment.verdict.code == "time_limit"
    assert samples[-1][0] <= 20.0 + 2 * 0.1


def test_a_failure_to_oscillate_is_refused_with_numbers():
    plant = SteppedPlant(Integrating(1e-9, 0.0, 1.0), output0=40.0, pv0=80.0)
    experiment, _ = conduct(plant, ExperimentSettings(amplitude=10.0, hysteresis=0.1, response_limit_s=500.0))
    assert experiment.verdict.code == "no_oscillation"
    assert "500" in experiment.verdict.message


def test_a_pv_that_never_changes_gets_no_stronger_relay():
    """A dead sensor, or no answer: 500 samples and a minute at least, unless the settings say otherwise."""
    plant = SteppedPlant(Fopdt(1e-12, 10.0, 1.5), output0=40.0, pv0=80.0, sensors=[Quantisation(0.1)])
    experiment, samples = conduct(plant, ExperimentSettings(sample_time_s=0.2))
    assert experiment.verdict.code == "no_response"
    moved = [t for t, u, _ in samples if u != 40.0]
    assert moved[-1] - moved[0] == pytest.approx(100.0, abs=0.5)
    assert len({u for _, u, _ in samples}) == 2


@pytest.mark.parametrize(
    ("sample_time_s", "given_s", "limit_s"), [(1.0, None, 500.0), (0.02, None, 60.0), (0.02, 7.0, 7.0)]
)
def test_the_wait_for_an_answer_follows_the_sample_time(sample_time_s, given_s, limit_s):
    settings = ExperimentSettings(sample_time_s=sample_time_s, response_limit_s=given_s)
    assert settings.longest_response_s == limit_s


def test_the_first_verdict_stands():
    experiment = Experiment(ExperimentSettings(), 40.0)
    experiment.stop(aborted("first", "a", "b"))
    experiment.stop(aborted("second", "a", "b"))
    assert experiment.verdict.code == "first"


@pytest.mark.parametrize("phase", Phase)
@pytest.mark.parametrize("event", PhaseEvent)
def test_an_event_that_the_table_lacks_raises(phase, event):
    if (phase, event) in TRANSITIONS:
        assert next_phase(phase, event) is TRANSITIONS[phase, event]
    else:
        with pytest.raises(IllegalTransitionError):
            next_phase(phase, event)


def test_every_phase_leads_to_the_end_through_restore():
    for phase in Phase:
        if phase is not Phase.ENDED:
            assert TRANSITIONS.get((phase, PhaseEvent.STOPPED)) is Phase.RESTORE
    assert {before for (before, _), after in TRANSITIONS.items() if after is Phase.ENDED} == {Phase.RESTORE}
    assert PHASES.mermaid().count("-->") == len(TRANSITIONS) + 2


@given(output=st.floats(0.0, 100.0), amplitude=st.floats(0.1, 50.0), ratio=st.floats(1.0, 5.0))
def test_levels_always_lie_within_the_limits(output, amplitude, ratio):
    levels = place_levels(output, amplitude, ratio, (0.0, 100.0))
    assert levels.high - levels.low == pytest.approx(2.0 * amplitude)
    assert levels.low >= -1e-9
    assert levels.high <= 100.0 + 1e-9
    if not levels.one_sided:
        assert levels.low <= output + 1e-9
        assert output <= levels.high + 1e-9


def test_levels_by_hand():
    placed = place_levels(40.0, 15.0, 2.0, (0.0, 100.0))
    assert (placed.low, placed.high, placed.one_sided) == (30.0, 60.0, False)
    mirrored = place_levels(85.0, 15.0, 2.0, (0.0, 100.0))
    assert (mirrored.low, mirrored.high, mirrored.one_sided) == (65.0, 95.0, False)
    cold = place_levels(0.0, 10.0, 2.0, (0.0, 100.0))
    assert (cold.low, cold.high, cold.one_sided) == (0.0, 20.0, True)
    assert place_levels(50.0, 60.0, 2.0, (0.0, 100.0)) is None


@given(pv=st.floats(-5.0, 5.0), is_high=st.booleans(), direct=st.booleans())
def test_relay_holds_inside_its_dead_zone_and_obeys_outside(pv, is_high, direct):
    relay = Relay(10.0, 30.0, 0.0, 1.0, direct=direct)
    switched = relay.switched(is_high=is_high, pv=pv)
    if abs(pv) <= 1.0:
        assert switched is is_high
    else:
        assert switched is ((pv < 0.0) is direct)
    assert (relay.amplitude, relay.bias) == (10.0, 20.0)


def test_recentring_by_hand():
    """Duty 0.1 between 40 and 60: equilibrium at 42, wanted at 0.36 of the swing, so the levels go to 34.8 and 54.8."""
    moved = recentred(Relay(40.0, 60.0, 80.0), 0.1, (45.0, 80.0), (0.0, 100.0))
    assert (moved.low, moved.high) == pytest.approx((34.8, 54.8))
    assert moved.reference == 80.0


def test_recentring_at_a_limit_moves_the_reference():
    """Levels at 0 and 20 cannot go lower: the reference, a tenth of the way from rest, goes to TARGET_DUTY of it."""
    moved = recentred(Relay(0.0, 20.0, 24.0), 0.1, (0.0, 20.0), (0.0, 100.0))
    assert (moved.low, moved.high) == (0.0, 20.0)
    assert moved.reference == pytest.approx(20.0 + 4.0 * TARGET_DUTY / 0.1)


@pytest.mark.parametrize(("T", "D"), [(100.0, 1.0), (10.0, 1.5), (2.0, 10.0)])
def test_approach_puts_the_reference_on_the_way(T, D):
    """Between a tenth and three quarters of the final rise, whatever the process."""
    approach, reference, t = Approach(0.0, 20.0, 0.3, 1.0), None, 0.0
    while reference is None:
        t += 0.05
        rise = 40.0 * (1.0 - math.exp(-(t - D) / T)) if t > D else 0.0
        reference = approach.step(t, 20.0 + rise)
    assert 0.01 <= (reference - 20.0) / 40.0 <= 0.76


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"sample_time_s": -1.0}, "sample_time_s"),
        ({"sample_time_s": math.nan}, "sample_time_s"),
        ({"amplitude": 0.0}, "amplitude"),
        ({"amplitude": 185.0}, "amplitude"),
        ({"ratio": 0.5}, "ratio"),
        ({"hysteresis": -0.1}, "hysteresis"),
        ({"min_periods": 1}, "min_periods"),
        ({"min_periods": 20}, "min_periods"),
        ({"accuracy": 0.0}, "accuracy"),
    ],
)
def test_settings_that_cannot_work_name_the_field(values, field):
    with pytest.raises(InputError) as caught:
        ExperimentSettings(**values)
    assert caught.value.field == field
    assert caught.value.remedy


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"output": (5.0, 5.0)}, "limits.output"),
        ({"output": (0.0, math.inf)}, "limits.output"),
        ({"pv": (10.0, 0.0)}, "limits.pv"),
        ({"output_slew_per_s": 0.0}, "limits.output_slew_per_s"),
        ({"safe_output": 120.0}, "limits.safe_output"),
    ],
)
def test_limits_that_cannot_hold_name_the_field(values, field):
    with pytest.raises(InputError) as caught:
        Limits(**values)
    assert caught.value.field == field
