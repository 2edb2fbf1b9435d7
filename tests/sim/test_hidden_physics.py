"""Hidden physics against closed forms, against a general ODE solver and against sequences worked by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from autotuner_sim import (
    ActuatorHold,
    BiasStep,
    ChoudhuryStiction,
    ColouredNoise,
    ConvectiveLoss,
    CurvedDrift,
    DirectionDynamics,
    DirectionGain,
    EqualPercentage,
    Fopdt,
    Fouling,
    Freeze,
    GainDrift,
    HeavyTailedNoise,
    HeStiction,
    Jitter,
    KanoStiction,
    LoadRamp,
    Measured,
    Overflow,
    PeriodicLoad,
    PeriodicOffset,
    PlugFlow,
    PositionBacklash,
    PowerLaw,
    Radiation,
    RationalPlant,
    SendOnDelta,
    SoftRateLimit,
    SoftSaturation,
    SopdtOverdamped,
    SopdtUnderdamped,
    Spikes,
    SquareRootOutflow,
    SteppedPlant,
    Thermostat,
    TimeProportioned,
    UnequalLag,
    UnequalWait,
    Weir,
)

K, T = 2.0, 10.0
PLANT = Fopdt(K, T, 0.0)


def after_step(size, looks, plant=PLANT, **physics):
    """PV of a plant from rest at output 0 and PV 0 whose output steps by `size` at time 0."""
    stepped = SteppedPlant(plant, **physics)
    stepped.output = size
    seen = []
    for t in looks:
        stepped.advance(t)
        seen.append(stepped.pv)
    return np.array(seen)


def solved(slope, looks, y0=0.0):
    """The same by a general solver, `y' = slope(t, y)`."""
    run = solve_ivp(slope, (0.0, looks[-1]), [y0], t_eval=looks, rtol=1e-10, atol=1e-12)
    return run.y[0]


LOOKS = np.linspace(0.5, 60.0, 40)
LAWS = {
    "radiation": (
        Radiation(0.6, 320.0, K),
        lambda y: 0.4 * y + 0.6 * ((320.0 + y) ** 4 - 320.0**4) / (4.0 * 320.0**3),
    ),
    "square root": (SquareRootOutflow(30.0, K), lambda y: 60.0 * (math.sqrt(1.0 + y / 30.0) - 1.0)),
    "convection": (ConvectiveLoss(25.0, 1.25, K), lambda y: 25.0 * ((1.0 + y / 25.0) ** 1.25 - 1.0) / 1.25),
    "weir": (Weir(6.0, 0.8, K), lambda y: y + 0.8 * max(y - 6.0, 0.0) ** 1.5),
}


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("size", [8.0, -5.0])
def test_losses_equal_a_general_solver(name, size):
    coupling, loss = LAWS[name]
    seen = after_step(size, LOOKS, couplings=[coupling], step_s=0.02)
    expected = solved(lambda _t, y: [(K * size - loss(y[0])) / T], LOOKS)
    assert seen == pytest.approx(expected, abs=2e-4)
    end = after_step(size, [400.0], couplings=[coupling], step_s=0.05)[0]
    assert end == pytest.approx(brentq(lambda y: K * size - loss(y), -20.0, 40.0), abs=1e-6)


def test_the_outflow_of_a_tank_in_closed_form():
    """2 L (sqrt(1 + y/L) - 1) = K u has the root y = L ((1 + K u/(2 L))^2 - 1)."""
    end = after_step(8.0, [400.0], couplings=[SquareRootOutflow(30.0, K)], step_s=0.05)[0]
    assert end == pytest.approx(30.0 * ((1.0 + 16.0 / 60.0) ** 2 - 1.0), abs=1e-6)


def test_a_loss_changes_nothing_at_rest_and_little_near_it():
    for coupling, _ in LAWS.values():
        small = after_step(1e-4, LOOKS, couplings=[coupling], step_s=0.05)
        assert small == pytest.approx(K * 1e-4 * -np.expm1(-LOOKS / T), rel=1e-4)


def test_couplings_converge_with_the_square_of_the_step():
    errors = []
    expected = solved(lambda _t, y: [(K * 8.0 - LAWS["radiation"][1](y[0])) / T], LOOKS)
    for step_s in (1.0, 0.5, 0.25):
        seen = after_step(8.0, LOOKS, couplings=[LAWS["radiation"][0]], step_s=step_s)
        errors.append(np.abs(seen - expected)[20:].max())
    assert errors[0] / errors[2] > 8.0


def test_the_pv_does_not_depend_on_how_often_it_was_looked_at():
    physics = {"couplings": [GainDrift(0.01), LAWS["radiation"][0]], "bounds": [Overflow(9.0)], "step_s": 0.3}
    assert after_step(8.0, [1.1, 7.77, 20.0], **physics)[-1] == after_step(8.0, [20.0], **physics)[-1]


def test_a_drifting_gain_in_closed_form():
    """T y' = K u (1 + r t) - y: y = K u ((1 - r T)(1 - e^{-t/T}) + r t)."""
    r, size = 0.004, 5.0
    seen = after_step(size, LOOKS, couplings=[GainDrift(r)], step_s=0.02)
    expected = K * size * ((1.0 - r * T) * -np.expm1(-LOOKS / T) + r * LOOKS)
    assert seen == pytest.approx(expected, abs=1e-4)


def test_fouling_equals_a_general_solver():
    seen = after_step(5.0, LOOKS, couplings=[Fouling(80.0, from_s=10.0)], step_s=0.02)
    expected = solved(lambda t, y: [(K * 5.0 / (1.0 + max(t - 10.0, 0.0) / 80.0) - y[0]) / T], LOOKS)
    assert seen == pytest.approx(expected, abs=2e-4)


def test_rising_and_falling_with_their_own_time_constants():
    coupling = DirectionDynamics(2.5, K)
    up = after_step(4.0, LOOKS, couplings=[coupling], step_s=0.02)
    down = after_step(-4.0, LOOKS, couplings=[coupling], step_s=0.02)
    assert up == pytest.approx(8.0 * -np.expm1(-LOOKS / 4.0), abs=2e-3)
    assert down == pytest.approx(-8.0 * -np.expm1(-LOOKS / T), abs=1e-9)


def test_a_full_tank_comes_down_at_once():
    plant = SteppedPlant(PLANT, bounds=[Overflow(6.0)], step_s=0.05)
    plant.output = 10.0
    plant.advance(50.0)
    assert plant.pv == 6.0
    plant.output = 0.0
    plant.advance(60.0)
    assert plant.pv == pytest.approx(6.0 * math.exp(-1.0), rel=1e-12)


def test_an_oscillating_plant_stops_at_the_bound():
    ringing = SopdtUnderdamped(2.0, 25.0, 4.0, 0.0)
    seen = after_step(5.0, np.linspace(0.1, 60.0, 600), ringing, bounds=[Overflow(11.0, slope=True)], step_s=0.05)
    free = after_step(5.0, np.linspace(0.1, 60.0, 600), ringing)
    assert free.max() > 12.0
    assert seen.max() == pytest.approx(11.0, abs=1e-3)
    assert seen.max() <= 11.0
    assert seen[-1] == pytest.approx(10.0, abs=0.1)


def test_a_thermostat_goes_on_and_off_by_itself():
    """Alone it needs tau ln((P/2 + b)/(P/2 - b)) from one end of its band to the other."""
    neighbour = Thermostat(20.0, 10.0, 2.0, pull=0.0, push=1.0)
    seen = np.array([neighbour.feed(t, 0.0, 0.0) for t in np.arange(0.0, 200.0, 0.01)])
    turns = np.flatnonzero(np.diff(np.sign(np.diff(seen))) != 0.0)
    assert np.diff(turns) * 0.01 == pytest.approx(20.0 * math.log(7.0 / 3.0), abs=0.05)
    assert np.abs(seen).max() == pytest.approx(2.0, abs=0.01)


def positions(actuator, commands, elapsed_s=1.0, rest=0.0):
    actuator.rest(rest)
    return [actuator.act(command, elapsed_s) for command in commands]


STICKING = [1.0, 2.0, 2.5, 4.0, 4.0, 4.5, 5.5, 4.0, 2.0]


@pytest.mark.parametrize(
    ("actuator", "commands", "expected"),
    [
        (HeStiction(2.0, 1.0), [1.0, 2.0, 2.5, 3.0, 4.0, 1.0, 0.5], [0.0, 0.0, 1.5, 1.5, 3.0, 3.0, 1.5]),
        (HeStiction(1.0, 0.0), [0.5, 1.0, 1.5, 1.0, 0.4], [0.0, 0.0, 1.5, 1.5, 0.4]),
        (KanoStiction(3.0, 1.0), STICKING, [0.0, 0.0, 1.5, 3.0, 3.0, 3.0, 4.5, 4.5, 3.0]),
        (ChoudhuryStiction(3.0, 1.0), STICKING, [0.0, 1.0, 1.5, 3.0, 3.0, 3.0, 4.5, 4.5, 3.0]),
        (PositionBacklash(2.0, 0.1), [4.0, 3.0, -2.0], [2.6, 2.6, -1.2]),
    ],
    ids=["He", "He as Stenman", "Kano", "Choudhury", "backlash"],
)  # fmt: skip
def test_friction_worked_by_hand(actuator, commands, expected):
    assert positions(actuator, commands) == pytest.approx(expected)


@pytest.mark.parametrize("kind", [KanoStiction, ChoudhuryStiction])
def test_without_a_jump_friction_is_a_dead_band(kind):
    """A sine of amplitude a comes out S/2 lower on the way up and S/2 higher on the way down."""
    u = 5.0 * np.sin(np.linspace(0.0, 4.0 * math.pi, 4000))
    x = np.array(positions(kind(2.0, 0.0), u))
    play = np.array(positions(PositionBacklash(2.0, 0.0), u))
    assert x[1500:] == pytest.approx(play[1500:], abs=0.01)


def test_curves_keep_the_rest_point_with_slope_one():
    for actuator in (SoftSaturation(75.0, 5.0), EqualPercentage(30.0), PowerLaw(2.0), DirectionGain(1.4, 0.5)):
        assert positions(actuator, [40.0], rest=40.0) == pytest.approx([40.0])
    for actuator in (EqualPercentage(30.0), PowerLaw(1.7)):
        up, down = positions(actuator, [40.01, 39.99], rest=40.0)
        assert up - down == pytest.approx(0.02, rel=1e-6)


def test_curves_in_closed_form():
    assert positions(PowerLaw(2.0), [50.0], rest=40.0)[0] == pytest.approx(40.0 + 900.0 / 80.0)
    expected = 40.0 + 100.0 / math.log(30.0) * (30.0**0.1 - 1.0)
    assert positions(EqualPercentage(30.0), [50.0], rest=40.0)[0] == pytest.approx(expected)
    assert positions(DirectionGain(1.5), [50.0, 30.0], rest=40.0) == pytest.approx([55.0, 30.0])
    far = positions(SoftSaturation(50.0, 1.0), [90.0, 20.0], rest=20.0)
    assert far == pytest.approx([50.0, 20.0], abs=1e-6)


def test_a_soft_rate_limit_equals_a_general_solver():
    actuator = SoftRateLimit(0.5, 2.0)
    seen = positions(actuator, [10.0] * 60)
    t = np.arange(1.0, 61.0)
    expected = solved(lambda _t, x: [0.5 * math.tanh((10.0 - x[0]) / 1.0)], t)
    assert seen == pytest.approx(expected, abs=1e-6)
    assert positions(SoftRateLimit(0.5, 0.001), [10.0] * 3) == pytest.approx([0.5, 1.0, 1.5])


def test_an_element_warms_and_cools_with_its_own_lags():
    warm = positions(UnequalLag(4.0, 9.0), [10.0] * 3 + [0.0] * 2)
    top = 10.0 * -math.expm1(-3.0 / 4.0)
    assert warm[2:] == pytest.approx([top, top * math.exp(-1.0 / 9.0), top * math.exp(-2.0 / 9.0)])


def test_a_burner_waits_before_it_fires_harder():
    assert positions(UnequalWait(3.0), [5, 5, 5, 5, 2, 4, 4]) == [0, 0, 5, 5, 2, 2, 2]


def test_an_output_card_looks_every_period():
    assert positions(ActuatorHold(3.0), [1, 2, 3, 4, 5, 6, 7]) == [0, 0, 3, 3, 3, 6, 6]
    changes = np.flatnonzero(np.diff(positions(ActuatorHold(3.0, jitter=0.5, seed=1), range(3000))))
    assert np.diff(changes).mean() == pytest.approx(3.0, rel=0.05)
    assert len(set(np.diff(changes))) > 1


def test_a_heater_behind_a_relay_is_on_for_its_share_of_every_period():
    """Period 10 s, steps of 1 s: at 30 % three of ten; 75 %, commanded within a period, count from the next one on."""
    heater = TimeProportioned(10.0)
    heater.rest(30.0)
    assert [heater.act(30.0, 1.0) for _ in range(5)] == [100.0] * 3 + [0.0] * 2
    assert [heater.act(75.0, 1.0) for _ in range(5)] == [0.0] * 5
    assert [heater.act(75.0, 1.0) for _ in range(10)] == pytest.approx([100.0] * 7 + [50.0] + [0.0] * 2)
    assert heater.act(75.0, 25.0) == pytest.approx((7.5 + 7.5 + 5.0) / 25.0 * 100.0)


def test_a_pipe_is_left_sooner_when_it_flows_faster():
    """Rest 6 s; twice the flow from the step on: what the step brings arrives after 3 s."""
    pipe = PlugFlow(6.0, share=1.0, span=10.0)
    pipe.rest(0.0)
    pipe.send(5.0, 10.0)
    assert pipe.next_arrival_s() == pytest.approx(8.0)
    pipe.send(7.0, 0.0)
    assert pipe.next_arrival_s() == pytest.approx(9.0)
    assert pipe.receive(9.0) == 10.0
    assert pipe.next_arrival_s() == pytest.approx(13.0)
    assert pipe.receive(13.0) == 0.0


def test_a_pipe_of_constant_flow_is_a_dead_time():
    looks = np.linspace(0.0, 30.0, 61)
    delayed = Fopdt(K, T, 3.0)
    pipe = after_step(5.0, looks, delayed, transport=PlugFlow(3.0, share=0.0, span=1.0))
    assert pipe == pytest.approx(after_step(5.0, looks, delayed))


def test_a_ramped_load_in_closed_form():
    """During the ramp y = K a/w (t - T (1 - e^{-t/T})) for t from its beginning."""
    seen = after_step(0.0, [9.0, 15.0, 25.0], loads=[LoadRamp(5.0, 4.0, 20.0)])
    t = np.array([4.0, 10.0, 20.0])
    assert seen == pytest.approx(K * 4.0 / 20.0 * (t - T * -np.expm1(-t / T)), abs=2e-3)
    assert after_step(0.0, [300.0], loads=[LoadRamp(5.0, 4.0, 20.0)])[0] == pytest.approx(8.0)


def test_a_periodic_load_comes_out_as_the_frequency_response_says():
    looks = np.linspace(200.0, 240.0, 400)
    seen = after_step(0.0, looks, loads=[PeriodicLoad(3.0, 20.0)])
    w = 2.0 * math.pi / 20.0
    answer = PLANT.transfer(1j * w)
    assert seen == pytest.approx(3.0 * np.imag(answer * np.exp(1j * w * looks)), abs=0.01)


@pytest.mark.parametrize(("shape", "square"), [("sine", 0.5), ("triangle", 1.0 / 3.0), ("square", 1.0)])
def test_waves_have_amplitude_one_no_mean_and_begin_going_up(shape, square):
    t = (np.arange(2000) + 0.5) / 200.0
    w = np.array([PeriodicOffset(1.0, 10.0, shape).offset(x) for x in t])
    assert np.abs(w).max() == pytest.approx(1.0, abs=0.01)
    assert w.mean() == pytest.approx(0.0, abs=1e-12)
    assert (w**2).mean() == pytest.approx(square, abs=1e-3)
    assert w[5] > 0.0


def test_offsets_in_closed_form():
    assert CurvedDrift(3.0, 20.0, from_s=5.0).offset(25.0) == pytest.approx(3.0 * (1.0 - math.exp(-1.0)))
    assert [BiasStep(5.0, 0.7).offset(t) for t in (4.9, 5.0)] == [0.0, 0.7]


def test_a_measured_disturbance_comes_through_its_lag():
    """A ramp of slope s answers with g s (t - tau (1 - e^{-t/tau}))."""
    t = np.linspace(0.0, 50.0, 26)
    disturbance = Measured(t, 20.0 + 0.3 * t, gain=1.5, lag_s=8.0)
    expected = 1.5 * 0.3 * (t - 8.0 * -np.expm1(-t / 8.0))
    assert [disturbance.offset(x) for x in t] == pytest.approx(expected.tolist(), abs=1e-12)
    assert disturbance.signal(7.0) == pytest.approx(22.1)
    assert Measured(t, t, 2.0, 0.0).offset(3.0) == pytest.approx(6.0)


def test_coloured_noise_remembers_and_heavy_tails_are_heavy():
    coloured, heavy = ColouredNoise(0.3, 4.0, seed=1), HeavyTailedNoise(0.3, 4.0, seed=2)
    e = np.array([coloured.read(5.0, t) - 5.0 for t in np.arange(20000.0)])
    f = np.array([heavy.read(5.0, t) - 5.0 for t in np.arange(20000.0)])
    assert e.std() == pytest.approx(0.3, rel=0.05)
    assert f.std() == pytest.approx(0.3, rel=0.1)
    assert np.corrcoef(e[1:], e[:-1])[0, 1] == pytest.approx(math.exp(-0.25), abs=0.02)
    assert np.mean(np.abs(f) > 4.0 * 0.3) > 10.0 * 6.3e-5


def test_a_sensor_that_reports_by_difference():
    sensor = SendOnDelta(1.0)
    assert [sensor.read(pv, 0.0) for pv in (0.2, 0.9, 1.1, 1.2, 1.9, 2.3)] == [0.2, 0.2, 0.2, 1.2, 1.2, 2.3]


def test_spikes_come_alone_and_bursts_in_runs():
    def hits(run):
        sensor = Spikes(5.0, 0.02, run, seed=3)
        return np.array([sensor.read(0.0, t) for t in np.arange(10000.0)])

    assert np.mean(hits(1) != 0.0) == pytest.approx(0.02, rel=0.2)
    burst = hits(5)
    starts = np.flatnonzero(np.diff((burst != 0.0).astype(int)) == 1) + 1
    assert all(burst[s : s + 5].all() for s in starts)
    assert np.abs(burst[burst != 0.0]).mean() == pytest.approx(5.0, rel=0.05)


def test_a_sensor_that_freezes_goes_on_as_if_nothing_had_been():
    sensor = Freeze(3.0, 2.0)
    assert [sensor.read(float(t), float(t)) for t in range(7)] == [0.0, 1.0, 2.0, 3.0, 3.0, 5.0, 6.0]


def test_a_clock_that_is_late():
    clock = Jitter(0.5, seed=1)
    late = np.array([clock.moment(float(t)) - t for t in range(2000)])
    assert late.min() >= 0.0
    assert late.max() < 0.5
    assert late.mean() == pytest.approx(0.25, abs=0.02)


def test_a_rational_plant_is_the_plant_of_the_same_polynomials():
    looks = np.linspace(0.3, 60.0, 50)
    same = after_step(5.0, looks, RationalPlant((2.0,), (1.0, 14.0, 40.0), 1.5))
    assert same == pytest.approx(after_step(5.0, looks, SopdtOverdamped(2.0, 10.0, 4.0, 1.5)), abs=1e-9)


def test_a_slow_mode_beside_a_fast_one_in_closed_form():
    plant = RationalPlant((1.6,), (1.0, 5.0), 0.0).beside((0.4,), (1.0, 50.0))
    looks = np.linspace(0.3, 100.0, 50)
    expected = -1.6 * np.expm1(-looks / 5.0) - 0.4 * np.expm1(-looks / 50.0)
    assert after_step(1.0, looks, plant) == pytest.approx(expected, abs=1e-9)
    assert pytest.approx(2.0) == plant.K


def test_a_zero_on_the_wrong_side_starts_the_wrong_way():
    plant = RationalPlant((2.0,), (1.0, 10.0), 0.0).times((1.0, -3.0), (1.0, 4.0))
    assert after_step(1.0, [0.5], plant)[0] < 0.0
    assert plant.transfer(0.2j) == pytest.approx(2.0 * (1.0 - 0.6j) / ((1.0 + 2.0j) * (1.0 + 0.8j)))


@pytest.mark.parametrize("physics", [{"couplings": [GainDrift(0.1)]}, {"bounds": [Overflow(1.0)]}])
def test_what_is_not_linear_needs_a_step(physics):
    with pytest.raises(ValueError, match="step_s"):
        SteppedPlant(PLANT, **physics)
