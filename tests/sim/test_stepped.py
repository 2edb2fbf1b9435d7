"""The stepped plant: equal to the event-driven run, whatever the spacing of the calls, with its effects around it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotuner_sim import (
    Backlash,
    Drift,
    Fopdt,
    Integrating,
    InverseResponse,
    LagChain,
    LoadStep,
    Noise,
    OutputQuantisation,
    Quantisation,
    RateLimit,
    Relay,
    Saturation,
    SopdtOverdamped,
    SopdtUnderdamped,
    SteppedPlant,
    Stiction,
    UnstableFopdt,
    run_relay,
)

ALL = [
    Fopdt(2.0, 10.0, 1.5),
    SopdtOverdamped(1.0, 10.0, 2.0, 4.0),
    SopdtUnderdamped(1.0, 1.0, 0.4, 12.0),
    Integrating(0.3, 3.0, 2.0),
    UnstableFopdt(1.0, 10.0, 2.0),
    InverseResponse(1.0, 5.0, 3.0, 1.0, 0.0),
    LagChain(1.0, (1.0, 2.0, 3.0), 0.3),
]
moves = st.lists(st.tuples(st.integers(0, 2000).map(lambda n: n / 100.0), st.floats(-5.0, 5.0)), min_size=1, max_size=6)


def course(stepped: SteppedPlant, commands: list[tuple[float, float]], looks: list[float]) -> list[float]:
    """Command at the given times, look at the others, and return what was seen."""
    seen = []
    events = sorted([(t, 0, u) for t, u in commands] + [(t, 1, 0.0) for t in looks], key=lambda event: event[:2])
    for t, is_look, u in events:
        stepped.advance(t)
        if is_look:
            seen.append(stepped.pv)
        else:
            stepped.output = u
    return seen


@pytest.mark.parametrize("plant", ALL, ids=str)
def test_equals_the_event_driven_run(plant):
    relay = Relay(-1.0, 1.3, reference=0.05, hysteresis=0.05)
    run = run_relay(plant, relay, end_s=60.0, load_s=7.0, load=0.2)
    looks = np.random.default_rng(3).uniform(0.0, 60.0, 200)
    stepped = SteppedPlant(plant, output0=40.0, pv0=80.0, loads=[LoadStep(7.0, 0.2)])
    commands = [(t, 40.0 + u) for t, u in zip(run.times_s.tolist(), run.levels.tolist(), strict=True)]
    seen = course(stepped, commands, looks.tolist())
    assert len(run.times_s) > 3
    assert np.allclose(
        np.array(seen) - 80.0, run.pv(np.sort(looks)), rtol=0.0, atol=1e-12 * max(1.0, np.abs(seen).max())
    )


@pytest.mark.parametrize("plant", ALL, ids=str)
def test_equals_zero_order_hold_matrices(plant, oracle):
    dt = 0.1
    inputs = np.repeat(np.random.default_rng(4).normal(size=40), 5)
    stepped = SteppedPlant(plant)
    seen = []
    for k, u in enumerate(inputs):
        stepped.advance(k * dt)
        seen.append(stepped.pv)
        stepped.output = u
    delayed = np.concatenate((np.zeros(round(plant.D / dt)), inputs))[: len(inputs) - 1]
    expected = np.concatenate(([0.0], oracle.held_response(plant, delayed, dt)))
    assert np.allclose(seen, expected, rtol=0.0, atol=1e-9 * max(np.abs(expected).max(), 1.0))


@given(plant=st.sampled_from(ALL), commands=moves, looks=st.lists(st.floats(0.0, 40.0), max_size=30))
def test_the_pv_does_not_depend_on_how_often_it_was_looked_at(plant, commands, looks):
    """Bit for bit, with effects that have memory, a scan of their own and a load on the way."""

    def make() -> SteppedPlant:
        return SteppedPlant(
            plant,
            actuators=[Backlash(0.5), RateLimit(0.7)],
            loads=[LoadStep(11.0, 0.4)],
            offsets=[Drift(0.01)],
            actuator_scan_s=0.5,
        )

    assert course(make(), commands, [*looks, 41.0])[-1] == course(make(), commands, [41.0])[-1]


@given(plant=st.sampled_from(ALL), commands=moves)
def test_starting_later_and_resting_elsewhere_only_shifts(plant, commands):
    base = course(SteppedPlant(plant), commands, [25.0])[-1]
    shifted = SteppedPlant(plant, output0=50.0, pv0=20.0, start_s=1000.0)
    other = course(shifted, [(1000.0 + t, 50.0 + u) for t, u in commands], [1025.0])[-1]
    assert other - 20.0 == pytest.approx(base, abs=1e-9 * max(1.0, abs(base)))


def test_the_step_worked_by_hand():
    """K 2, T 10, D 1.5 from 80 at output 40: 12 s after a step of 5 it has had 10.5 s, so 80 + 10 (1 - e^-1.05)."""
    plant = SteppedPlant(Fopdt(2.0, 10.0, 1.5), output0=40.0, pv0=80.0)
    plant.advance(3.0)
    plant.output = 45.0
    plant.advance(4.5)
    assert plant.pv == 80.0
    plant.advance(15.0)
    assert plant.pv == pytest.approx(80.0 + 10.0 * -math.expm1(-1.05), rel=1e-15)
    assert (plant.t, plant.output, plant.position) == (15.0, 45.0, 45.0)


def test_rest_is_kept_by_every_plant():
    for plant in ALL:
        stepped = SteppedPlant(plant, output0=12.0, pv0=-3.0)
        stepped.advance(1e4)
        assert stepped.pv == -3.0


def test_noise_is_the_same_for_the_same_seed_and_of_its_size():
    def readings(seed: int) -> np.ndarray:
        plant = SteppedPlant(Fopdt(1.0, 1.0, 1.0), pv0=5.0, sensors=[Noise(0.2, seed=seed)])
        return np.array([plant.measure() for _ in range(4000)])

    assert np.array_equal(readings(1), readings(1))
    assert not np.array_equal(readings(1), readings(2))
    assert readings(1).mean() == pytest.approx(5.0, abs=4.0 * 0.2 / math.sqrt(4000.0))
    assert readings(1).std() == pytest.approx(0.2, rel=0.05)


def test_one_list_of_effects_serves_two_plants_without_coupling_them():
    actuators, sensors = [Backlash(4.0)], [Noise(1.0, seed=9)]
    one, other = (SteppedPlant(Fopdt(1.0, 1.0, 0.0), actuators=actuators, sensors=sensors) for _ in range(2))
    one.output = 10.0
    assert one.position == 8.0
    assert other.position == 0.0
    assert one.measure() == other.measure()


def test_the_reading_is_noise_on_the_drifting_pv_then_rounded():
    plant = SteppedPlant(Fopdt(1.0, 1.0, 0.0), pv0=1.0, offsets=[Drift(0.1, from_s=2.0)], sensors=[Quantisation(0.25)])
    plant.advance(5.0)
    assert plant.pv == pytest.approx(1.3)
    assert plant.measure() == 1.25


def test_a_command_outside_of_its_limits_is_held_at_them():
    plant = SteppedPlant(Fopdt(1.0, 1.0, 0.0), output0=50.0, output_limits=(0.0, 100.0))
    plant.output = 130.0
    assert plant.output == plant.position == 100.0
    plant.output = -1.0
    assert plant.output == 0.0


def test_a_scanned_actuator_acts_on_its_scan():
    plant = SteppedPlant(Fopdt(1.0, 1.0, 0.0), actuators=[RateLimit(2.0)], actuator_scan_s=0.5)
    plant.advance(0.2)
    plant.output = 10.0
    assert plant.position == 0.0
    positions = []
    for t in (0.4, 0.5, 0.9, 1.0, 5.0, 5.5):
        plant.advance(t)
        positions.append(plant.position)
    assert positions == [0.0, 1.0, 1.0, 2.0, 10.0, 10.0]


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"actuators": [RateLimit(1.0)]}, "actuator_scan_s"),
        ({"actuator_scan_s": 0.0}, "actuator_scan_s"),
        ({"output0": 120.0, "output_limits": (0.0, 100.0)}, "output0"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings, named):
    with pytest.raises(ValueError, match=named):
        SteppedPlant(Fopdt(1.0, 1.0, 1.0), **settings)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_an_output_that_is_no_number_is_refused(value):
    plant = SteppedPlant(Fopdt(1.0, 1.0, 1.0), output0=3.0)
    with pytest.raises(ValueError, match="output"):
        plant.output = value
    assert plant.output == 3.0


@pytest.mark.parametrize("t", [4.9, math.nan, math.inf, -1.0])
def test_time_runs_forward_only(t):
    plant = SteppedPlant(Fopdt(1.0, 1.0, 1.0))
    plant.advance(5.0)
    with pytest.raises(ValueError, match="backward"):
        plant.advance(t)
    assert plant.t == 5.0


def positions(actuator, commands: list[float], elapsed_s: float = 1.0) -> list[float]:
    actuator.rest(0.0)
    return [actuator.act(command, elapsed_s) for command in commands]


@pytest.mark.parametrize(
    ("actuator", "commands", "expected"),
    [
        (Backlash(2.0), [0.5, 3.0, 2.5, 1.5, 0.5, 0.0], [0.0, 2.0, 2.0, 2.0, 1.5, 1.0]),
        (Stiction(1.0), [0.5, 1.0, 1.5, 1.0, 0.4], [0.0, 0.0, 1.5, 1.5, 0.4]),
        (Saturation(-1.0, 2.0), [3.0, 0.5, -4.0], [2.0, 0.5, -1.0]),
        (RateLimit(0.5), [2.0, 2.0, -2.0], [0.5, 1.0, 0.5]),
        (OutputQuantisation(0.5), [0.2, 0.3, -0.8], [0.0, 0.5, -1.0]),
    ],
    ids=lambda value: type(value).__name__ if not isinstance(value, list) else "",
)
def test_actuators_worked_by_hand(actuator, commands, expected):
    assert positions(actuator, commands) == pytest.approx(expected)


@settings(max_examples=50)
@given(commands=st.lists(st.floats(-10.0, 10.0), min_size=1, max_size=40), size=st.floats(0.01, 5.0))
def test_actuators_keep_their_promise(commands, size):
    play = np.abs(np.array(positions(Backlash(size), commands)) - commands)
    sticking = np.abs(np.array(positions(Stiction(size), commands)) - commands)
    travel = np.abs(np.diff(positions(RateLimit(size), commands), prepend=0.0))
    rounding = np.abs(np.array(positions(OutputQuantisation(size), commands)) - commands)
    slack = 1e-12
    assert play.max() <= size / 2.0 + slack
    assert sticking.max() <= size
    assert travel.max() <= size + slack
    assert rounding.max() <= size / 2.0 + slack


@pytest.mark.parametrize("effect", [Backlash, Stiction, RateLimit, OutputQuantisation, Quantisation, Noise])
@pytest.mark.parametrize("size", [0.0, -1.0, math.nan])
def test_an_effect_without_a_size_is_refused(effect, size):
    with pytest.raises(ValueError, match=effect.__name__):
        effect(size)
