"""Effects of the process against the simulator's physics, general solvers and closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy
from hypothesis import given, settings
from hypothesis import strategies as st

from autotuner.core.diagnosis.effects.declared import declared_effects, lagged
from autotuner.core.diagnosis.effects.disturbance import load_at_the_input
from autotuner.core.diagnosis.effects.process.friction import process_friction
from autotuner.core.diagnosis.effects.process.gain_in_time import times_curve
from autotuner.core.diagnosis.effects.process.stepping import averaged
from autotuner.core.diagnosis.effects.process.textbook_forms import further_lags, process_effects
from autotuner.core.diagnosis.extended.effect import View
from autotuner.core.diagnosis.record.dataset import dataset_of
from autotuner.core.model.step_responses import Integrator, Lag, LaggedIntegrator, Pair
from autotuner.core.model.zoh_input import HeldInput
from autotuner.core.recording import Recording
from autotuner_sim import (
    ConvectiveLoss,
    DirectionDynamics,
    Fopdt,
    GainDrift,
    Integrating,
    InverseResponse,
    LagChain,
    LoadStep,
    Overflow,
    Radiation,
    SopdtOverdamped,
    SquareRootOutflow,
    UnequalLag,
)
from tests.diagnosis.simulated import (
    INTEGRATOR,
    LAG,
    OUTPUT0,
    PAIR,
    PV0,
    RINGING,
    at_the_truth,
    left,
    moves,
    of_form,
    record,
)

SWING = 16.0
FINE_S = 0.05
LINEAR = [LAG, PAIR, RINGING]


def effects_of(recording, plant):
    return process_effects(dataset_of(recording), at_the_truth(recording, plant))


def with_effect(recording, plant, key, p):
    """Return the plant's model with an effect of the catalogue, or one that is tried in place of it."""
    effects = effects_of(recording, plant)
    every = {e.key: e for effect in effects for e in (effect, *effect.other_forms)}
    return at_the_truth(recording, plant, (every[key], p))


def added(*recordings):
    """Return a recording whose PV is the sum of those of several with the same output."""
    pv = sum(recording.pv - PV0 for recording in recordings)
    return Recording(recordings[0].t, recordings[0].output, PV0 + pv)


def arriving(u, delay_s):
    """Return the times at which an output changes, a dead time later, and the output from each of them on."""
    return [(0.0, 0.0), *((k + delay_s, float(u[k])) for k in np.flatnonzero(np.diff(u)) + 1)]


def solved(f, x0, edges, t):
    """Return the states of `x' = f(x, u)` at times, integrated from one change of the input to the next.

    Parameters
    ----------
    f : callable
        Slopes of the states.
    x0 : sequence of float
        States at first.
    edges : sequence of tuple of float
        Times at which the input changes, and the input from each of them on; the first is 0.
    t : array of float
        Times.
    """
    x, states = np.array(x0, dtype=float), np.zeros((len(x0), t.size))
    ends = [*(at for at, _ in edges[1:]), float(t[-1]) + 1e-9]
    for (start, u), end in zip(edges, ends, strict=True):
        inside = (t >= start) & (t < end)
        found = scipy.integrate.solve_ivp(
            lambda _t, x, u=u: f(x, u), (start, end), x, t_eval=np.append(t[inside], end), rtol=1e-7, atol=1e-7
        )
        states[:, inside], x = found.y[:, :-1], found.y[:, -1]
    return states


@pytest.mark.parametrize("plant", [*LINEAR, INTEGRATOR])
def test_a_process_alone_is_the_simulators(plant):
    recording = record(plant, moves())
    fitted = at_the_truth(recording, plant)
    assert left(fitted) < 1e-9
    assert fitted.process().parameters() == pytest.approx(
        {name: getattr(plant, name) for name in fitted.process().parameters()}
    )


# Of one loss law per power: the slope at rest is 1, b = (p - 1)/(2 L) with L the level at rest.
LOSSES = [
    ("nonlinear_loss", lambda K: ConvectiveLoss(40.0, 2.0, K), 1.0 / 80.0),
    ("nonlinear_loss:outflow", lambda K: SquareRootOutflow(40.0, K), -0.5 / 80.0),
    ("nonlinear_loss:radiation", lambda K: Radiation(1.0, 200.0, K), 3.0 / 400.0),
]


@pytest.mark.parametrize("plant", LINEAR)
@pytest.mark.parametrize(("key", "loss", "per_pv"), LOSSES)
def test_a_loss_is_the_simulators(plant, key, loss, per_pv):
    recording = record(plant, moves(), couplings=[loss(plant.K)], step_s=FINE_S)
    fitted = with_effect(recording, plant, key, (per_pv * SWING * plant.K,))
    assert left(fitted) < 2e-3
    assert left(at_the_truth(recording, plant)) > 0.012
    assert fitted.sizes()[0]["loss_per_pv"] == pytest.approx(per_pv, rel=2e-3)


@pytest.mark.parametrize(
    ("key", "p"),
    [
        ("nonlinear_loss", (0.0,)),
        ("nonlinear_loss:outflow", (0.0,)),
        ("nonlinear_loss:radiation", (0.0,)),
        ("nonlinear_loss:cubic", (0.0, 0.0)),
        ("nonlinear_loss:of the last store", (1.0, 0.0, 0.0)),
        ("nonlinear_loss:outflow of the last store", (0.0, 0.0)),
        ("nonlinear_loss:radiation of the last store", (1.0, 0.0)),
        ("state_saturation:spills", (0.0, -2.0)),
        ("state_saturation:high", (0.0,)),
        ("state_saturation:low", (0.0,)),
        ("direction_dynamics", (0.0,)),
    ],
)
@pytest.mark.parametrize("plant", [LAG, PAIR])
def test_without_its_size_it_is_the_process_alone(plant, key, p):
    """The PV of two lags stays within the output's own range times the gain."""
    recording = record(plant, moves())
    assert left(with_effect(recording, plant, key, p)) < 1e-6


def loss_of(form, level):
    """Return what a store loses at `w`, of slope 1 at rest: by Torricelli, or by Stefan and Boltzmann."""
    if form == "outflow":
        return lambda w: 2.0 * level * (math.sqrt(1.0 + w / level) - 1.0)
    if form == "exponential":
        return lambda w: level * math.expm1(w / level)
    return lambda w: level * ((1.0 + w / level) ** 4 - 1.0) / 4.0


@pytest.mark.parametrize(("form", "twice_b"), [("outflow", -0.5), ("radiation", 3.0), ("exponential", 1.0)])
@pytest.mark.parametrize("slow_last", [0.0, 1.0])
def test_a_loss_of_the_last_of_two_stores_is_that_of_a_general_solver(form, twice_b, slow_last):
    """T1 x' = u - x, T2 w' = x - h(w), behind the dead time; `h` loses more, or less, than in proportion."""
    u, level = moves(), 25.0
    first, last = (PAIR.T2, PAIR.T1) if slow_last else (PAIR.T1, PAIR.T2)
    edges = arriving(u, PAIR.D)
    h = loss_of(form, level)
    t = np.arange(300.0)
    w = solved(lambda x, v: [(v - x[0]) / first, (x[0] - h(x[1])) / last], [0.0, 0.0], edges, t)[1]
    recording = Recording(t, OUTPUT0 + u, PV0 + PAIR.K * w)
    b = twice_b / (2.0 * level)
    fitted = with_effect(recording, PAIR, f"nonlinear_loss:{form} of the last store", (slow_last, b * SWING))
    assert left(fitted) < 2e-3
    assert left(at_the_truth(recording, PAIR)) > 0.012
    assert fitted.sizes()[0]["loss_per_pv"] == pytest.approx(b / PAIR.K, rel=2e-3)


@pytest.mark.parametrize("slow_last", [None, 0.0, 1.0])
def test_the_heat_of_a_reaction_is_that_of_a_general_solver(slow_last):
    """What is left of the loss, of slope 1, less what the heat grows by over its slope at rest."""
    u, c, heat = moves(), 0.05, 0.4
    plant = LAG if slow_last is None else PAIR
    lags = (LAG.T,) if slow_last is None else (PAIR.T2, PAIR.T1) if slow_last else (PAIR.T1, PAIR.T2)
    edges = arriving(u, plant.D)

    def left_of_loss(w):
        return w - heat * (math.expm1(c * w) - c * w) / c

    def f(x, v):
        inputs = [v, *x[:-1]]
        return [(inputs[k] - (left_of_loss(x[k]) if k == len(lags) - 1 else x[k])) / T for k, T in enumerate(lags)]

    t = np.arange(300.0)
    recording = Recording(t, OUTPUT0 + u, PV0 + plant.K * solved(f, [0.0] * len(lags), edges, t)[len(lags) - 1])
    which, form = ((), "reaction") if slow_last is None else ((slow_last,), "reaction of the last store")
    fitted = with_effect(recording, plant, f"nonlinear_loss:{form}", (*which, c * SWING, heat))
    assert left(fitted) < 2e-3
    assert left(at_the_truth(recording, plant)) > 0.012
    assert fitted.sizes() == [pytest.approx({"heat_share": 0.4 / 1.4, "growth_per_pv": c / plant.K}, rel=2e-3)]
    assert fitted.is_meaningful()


def test_a_spring_is_that_of_a_general_solver():
    """m y'' + n y' + y + a y^2 + b y^3 = K u, behind the dead time."""
    u, K, a, b = moves(), RINGING.K, 0.01, 0.002
    edges = arriving(u, RINGING.D)

    def f(x, u):
        return [x[1], (K * u - x[0] - a * x[0] ** 2 - b * x[0] ** 3 - RINGING.n * x[1]) / RINGING.m]

    t = np.arange(300.0)
    recording = Recording(t, OUTPUT0 + u, PV0 + solved(f, [0.0, 0.0], edges, t)[0])
    dataset, alone = dataset_of(recording), at_the_truth(recording, RINGING)
    half = np.ptp(recording.pv[dataset.fitted]) / 2.0  # numbers are relative to the linear part at half the range
    effect = of_form(process_effects(dataset, alone), "nonlinear_stiffness:cubic")
    scale = half / abs(float(alone.linear[0]))
    p = (b * (K * scale) ** 2, a * K * scale)
    fitted = at_the_truth(recording, RINGING, (effect, p))
    assert left(fitted) < 5e-3
    assert left(alone) > 0.1
    assert fitted.sizes()[0] == pytest.approx({"cubic_per_pv2": b, "square_per_pv": a}, rel=1e-2)


@pytest.mark.parametrize(("sign", "name"), [(1.0, "high"), (-1.0, "low")])
@pytest.mark.parametrize("plant", [LAG, RINGING])
def test_a_limit_of_the_state_is_the_simulators(plant, sign, name):
    """The mirror of a record with a limit above is one with a limit below."""
    bound = Overflow(9.0, slope=plant is RINGING)
    above = record(plant, moves(), bounds=[bound], step_s=FINE_S)
    recording = Recording(above.t, OUTPUT0 + sign * (above.output - OUTPUT0), PV0 + sign * (above.pv - PV0))
    fitted = with_effect(recording, plant, f"state_saturation:{name}", ((8.0 - 9.0 / plant.K) / SWING,))
    assert left(fitted) < 0.02
    assert left(at_the_truth(recording, plant)) > 0.05
    assert fitted.sizes()[0] == pytest.approx({"limit_above_rest": sign * 9.0}, rel=0.01)


def test_what_spills_over_an_edge_is_that_of_a_general_solver():
    u, edge, strength = moves(), 4.0, 3.0
    edges = arriving(u, LAG.D)
    t = np.arange(300.0)
    w = solved(lambda x, v: [(v - x[0] - strength * max(x[0] - edge, 0.0)) / LAG.T], [0.0], edges, t)[0]
    recording = Recording(t, OUTPUT0 + u, PV0 + LAG.K * w)
    fitted = with_effect(recording, LAG, "state_saturation:spills", ((8.0 - edge) / SWING, math.log(strength)))
    assert left(fitted) < 5e-3
    assert left(at_the_truth(recording, LAG)) > 0.1
    assert fitted.sizes()[0] == pytest.approx({"limit_above_rest": 8.0, "strength": 3.0}, rel=0.01)


@pytest.mark.parametrize("plant", [LAG, PAIR])
@pytest.mark.parametrize("ratio", [0.5, 2.5])
def test_a_quicker_rise_is_the_simulators(plant, ratio):
    recording = record(plant, moves(), couplings=[DirectionDynamics(ratio, plant.K)], step_s=FINE_S)
    fitted = with_effect(recording, plant, "direction_dynamics", (math.log(ratio),))
    # A pair that crosses its input within a sample changes over at its end.
    assert left(fitted) < 0.01
    assert left(at_the_truth(recording, plant)) > 0.05
    assert fitted.sizes() == [{"rise_over_fall": pytest.approx(ratio)}]


@pytest.mark.parametrize("plant", LINEAR)
def test_an_element_of_two_lags_is_the_simulators(plant):
    recording = record(plant, moves(), actuators=[UnequalLag(9.0, 3.0)], actuator_scan_s=FINE_S)
    fitted = with_effect(recording, plant, "direction_dynamics:element", (math.log(9.0), math.log(3.0)))
    assert left(fitted) < 0.01
    assert left(at_the_truth(recording, plant)) > 0.05
    assert fitted.sizes() == [{"rising_lag_s": pytest.approx(9.0), "falling_lag_s": pytest.approx(3.0)}]


@pytest.mark.parametrize("plant", LINEAR)
def test_a_quicker_way_against_the_first_is_a_second_plant_beside_it(plant):
    u, quick = moves(), Fopdt(-0.5 * plant.K, 4.0, plant.D)
    recording = added(record(plant, u), record(quick, u))
    fitted = with_effect(recording, plant, "inverse_response:a second way", (math.log(4.0),))
    assert left(fitted) < 1e-6
    assert left(at_the_truth(recording, plant)) > 0.05
    assert fitted.sizes() == [{"time_constant_s": pytest.approx(4.0), "share_against": pytest.approx(1.0)}]


@pytest.mark.parametrize("plant", LINEAR)
def test_a_slow_mode_is_a_second_plant_beside_the_first(plant):
    u, slow = moves(), Fopdt(0.9, 90.0, plant.D)
    recording = added(record(plant, u), record(slow, u))
    fitted = with_effect(recording, plant, "slow_mode", (math.log(90.0),))
    assert left(fitted) < 1e-9
    assert left(at_the_truth(recording, plant)) > 0.02
    assert fitted.sizes() == [{"time_constant_s": pytest.approx(90.0), "share": pytest.approx(0.9 / (0.9 + plant.K))}]
    assert fitted.is_meaningful()


@pytest.mark.parametrize(
    ("plant", "lags"),
    [(LAG, (LAG.T,)), (PAIR, (PAIR.T1, PAIR.T2)), (LagChain(1.2, (18.0, 7.0, 4.0), 5.0), (18.0, 7.0, 4.0))],
)
def test_a_recycle_is_the_sum_of_all_that_passes_once_twice_and_more_often(plant, lags):
    """What passes the process `k + 1` times has its lags as often, and comes `k` return times later."""
    u, share, back_s = moves(), 0.5, 37.4
    often = [LagChain(plant.K * share**k, lags * (k + 1), plant.D + k * back_s) for k in range(8)]
    recording = added(*(record(one, u) for one in often))
    fitted = with_effect(recording, plant, "recycle", (share, math.log(back_s)))
    assert left(fitted) < 1e-3
    assert left(at_the_truth(recording, plant)) > 0.05
    assert fitted.sizes() == [{"share": pytest.approx(share), "return_time_s": pytest.approx(back_s)}]
    assert pytest.approx(plant.K, rel=1e-3) == fitted.process().K


def test_a_recycle_through_a_tank_passes_its_lag_each_time():
    u, share, back_s, in_tank = moves(), 0.5, 40.0, 0.3
    often = [
        LagChain(LAG.K * share**k, (LAG.T,) * (k + 1) + (in_tank * back_s,) * k, LAG.D + k * (1.0 - in_tank) * back_s)
        for k in range(11)
    ]
    recording = added(*(record(one, u) for one in often))
    fitted = with_effect(recording, LAG, "recycle:through a tank", (share, math.log(back_s), in_tank))
    assert left(fitted) < 1e-3
    assert pytest.approx(LAG.K, rel=1e-3) == fitted.process().K


def test_heat_that_spreads_has_two_modes():
    u = moves()
    recording = added(record(LAG, u), record(Fopdt(0.6, 90.0, LAG.D), u), record(Fopdt(0.3, 18.0, LAG.D), u))
    fitted = with_effect(recording, LAG, "slow_mode:spread", (math.log(90.0),))
    assert left(fitted) < 1e-9
    # The mean time constant, by the gains.
    assert fitted.sizes()[0] == pytest.approx({"time_constant_s": (0.6 * 90.0 + 0.3 * 18.0) / 0.9, "share": 0.9 / 2.9})


@pytest.mark.parametrize(("K", "T"), [(-0.9, 90.0), (0.9, 5.0)])
def test_a_mode_that_opposes_or_is_quicker_is_not_a_slow_one(K, T):
    u = moves()
    recording = added(record(LAG, u), record(Fopdt(K, T, LAG.D), u))
    fitted = with_effect(recording, LAG, "slow_mode", (math.log(T),))
    assert left(fitted) < 1e-9
    assert not fitted.is_meaningful()


def lags_that_are_declared(recording):
    return declared_effects(dataset_of(recording), at_the_truth(record(LAG, moves()), LAG).process())


BESIDE_A_LOAD = {
    "slow_mode": (LAG, [LAG, Fopdt(0.9, 90.0, LAG.D)], lambda r: effects_of(r, LAG), (math.log(90.0),)),
    "inverse_response": (PAIR, [InverseResponse(1.5, 20.0, 8.0, 6.0, 5.0)], lambda r: effects_of(r, PAIR), ()),
    "extra_lag": (LAG, [SopdtOverdamped(2.0, 12.0, 4.0, 3.0)], lags_that_are_declared, (math.log(4.0),)),
}
"""Plant, the plants whose sum has the effect, the effects of a record, and the numbers of this one."""


@pytest.mark.parametrize("key", BESIDE_A_LOAD)
def test_a_load_at_the_input_passes_through_the_effect_too(key):
    plant, whole, effects, p = BESIDE_A_LOAD[key]
    u = moves()
    recording = added(*(record(one, u, loads=[LoadStep(140.0, 3.0)]) for one in whole))
    dataset = dataset_of(recording)
    load = (load_at_the_input(dataset), (140.0 / dataset.span_s, 3.0 / dataset.swing))
    fitted = at_the_truth(recording, plant, load, (of_form(effects(recording), key), p))
    assert left(fitted) < 1e-9


@pytest.mark.parametrize("Z", [6.0, 25.0])
def test_a_zero_on_the_wrong_side_is_the_simulators(Z):
    plant = InverseResponse(PAIR.K, PAIR.T1, PAIR.T2, Z, PAIR.D)
    recording = record(plant, moves())
    fitted = with_effect(recording, PAIR, "inverse_response", ())
    assert left(fitted) < 1e-9
    assert left(at_the_truth(recording, PAIR)) > 0.05
    assert fitted.sizes() == [{"Z": pytest.approx(Z)}]
    assert fitted.is_meaningful()


def test_a_zero_on_the_right_side_is_no_inverse_response():
    """K (1 + 12 s)/((20 s + 1)(8 s + 1)) in parts: gains K (12 - T)/(T' - T) of the lags alone."""
    u, K = moves(), PAIR.K
    parts = [Fopdt(K * (20.0 - 12.0) / 12.0, 20.0, PAIR.D), Fopdt(K * (12.0 - 8.0) / 12.0, 8.0, PAIR.D)]
    recording = added(*(record(part, u) for part in parts))
    fitted = with_effect(recording, PAIR, "inverse_response", ())
    assert left(fitted) < 1e-9
    assert fitted.sizes() == [{"Z": pytest.approx(-12.0)}]
    assert not fitted.is_meaningful()


@pytest.mark.parametrize(
    ("which", "lags"),
    [
        pytest.param(0, (6.0,), id="a third"),
        pytest.param(1, (6.9, 5.1), id="a fourth, too: 15 % on either side of 6 s"),
    ],
)
def test_further_lags_are_the_simulators(which, lags):
    plant = LagChain(PAIR.K, (PAIR.T1, PAIR.T2, *lags), PAIR.D)
    recording = record(plant, moves())
    effect = further_lags(dataset_of(recording), at_the_truth(recording, PAIR))[which]
    fitted = at_the_truth(recording, PAIR, (effect, (math.log(6.0),)))
    assert left(fitted) < 1e-6
    assert left(at_the_truth(recording, PAIR)) > 0.05
    assert fitted.sizes() == [{"time_constant_s": pytest.approx(sum(lags))}]


@pytest.mark.parametrize("plant", LINEAR)
@pytest.mark.parametrize("per_s", [1.0 / 600.0, -1.0 / 500.0])
def test_a_gain_that_drifts_is_the_simulators(plant, per_s):
    recording = record(plant, moves(), couplings=[GainDrift(per_s)], step_s=FINE_S)
    fitted = with_effect(recording, plant, "gain_drift", ())
    assert left(fitted) < 3e-3
    assert left(at_the_truth(recording, plant)) > 0.05
    assert fitted.sizes()[0]["relative_change_per_h"] == pytest.approx(3600.0 * per_s, rel=0.002)
    assert pytest.approx(plant.K, rel=0.002) == fitted.process().K  # that of the first moment, where it arrives


@pytest.mark.parametrize("plant", [LAG, PAIR])
def test_a_gain_that_settles_follows_an_exponential(plant):
    """The output times 1 - 0.4 (1 - exp(-t/80 s)), `t` a dead time later; in steps of 0.1 s for the simulator."""
    u, fine = moves(), np.arange(3000) * 0.1 + plant.D
    alone = record(plant, u)
    less = record(plant, np.repeat(u, 10) * 0.4 * np.expm1(-fine / 80.0), sample_s=0.1)
    recording = Recording(alone.t, alone.output, alone.pv + less.pv[::10] - PV0)
    fitted = with_effect(recording, plant, "gain_drift:settling", (math.log(80.0 / 299.0),))
    assert left(fitted) < 2e-3
    assert left(at_the_truth(recording, plant)) > 0.05
    assert fitted.sizes() == [pytest.approx({"relative_change": -0.4, "settles_over_s": 80.0}, rel=0.02)]
    assert pytest.approx(plant.K, rel=0.002) == fitted.process().K


@pytest.mark.parametrize("plant", [LAG, PAIR])
@pytest.mark.parametrize(
    ("form", "p", "curve", "expected"),
    [
        ("", (), lambda t: t / 299.0, {"relative_change_per_h": -0.4 / 299.0 * 3600.0}),
        ("jump ", (0.4,), lambda t: t > 0.4 * 299.0, {"relative_change": -0.4, "at_s": 0.4 * 299.0}),
        (
            "settling ",
            (math.log(80.0 / 299.0),),
            lambda t: -np.expm1(-t / 80.0),
            {"relative_change": -0.4, "settles_over_s": 80.0},
        ),
    ],
)
def test_a_gain_may_change_about_another_output_than_the_first(plant, form, p, curve, expected):
    """A part of all that the output makes of the PV is lost, and that is nothing at an output of 10 % only."""
    u, fine = moves(), np.arange(3000) * 0.1
    arrived = np.where(fine < plant.D, 0.0, u[np.maximum(fine - plant.D + 1e-9, 0.0).astype(int)])
    alone = record(plant, u)
    lost = record(replace(plant, D=0.0), (arrived + OUTPUT0 - 10.0) * 0.4 * curve(fine + 0.05), sample_s=0.1)
    recording = Recording(alone.t, alone.output, alone.pv - lost.pv[::10] + PV0)
    fitted = with_effect(recording, plant, f"gain_drift:{form}about another output", p)
    assert left(fitted) < 2e-3
    assert left(with_effect(recording, plant, f"gain_drift:{form}".strip(" :"), p)) > 0.05
    assert fitted.sizes() == [pytest.approx({**expected, "about_output": 10.0}, rel=0.02)]


def test_an_input_times_time_has_its_means():
    """Each small step is the mean of u t/span over it, to the next: the area below is that of the ramp."""
    held = HeldInput(np.array([0.0, 20.0, 50.0]), np.array([0.0, 4.0, -2.0]))
    drifted = times_curve(held, 100.0, 100.0, lambda t: t / 100.0)
    ends = np.append(drifted.times[1:], 100.0)
    area = float(np.sum(drifted.levels * np.maximum(np.minimum(ends, 100.0) - np.minimum(drifted.times, 100.0), 0.0)))
    exact = 4.0 * (50.0**2 - 20.0**2) / 200.0 - 2.0 * (100.0**2 - 50.0**2) / 200.0
    assert area == pytest.approx(exact, rel=1e-9)


@pytest.mark.parametrize("plant", LINEAR)
def test_a_motion_before_the_record_is_taken_up_at_its_beginning(plant):
    """The record begins in the middle of another one, at a rest of the output, a dead time after its last move."""
    u = moves()
    whole = record(plant, u)
    first = 8 * 15 + 8  # of the ninth rest of 15 samples
    recording = Recording(whole.t[first:] - whole.t[first], whole.output[first:], whole.pv[first:])
    fitted = with_effect(recording, plant, "not_settled", ())
    assert left(fitted) < 1e-9
    assert left(at_the_truth(recording, plant)) > 0.01


def declared(recording, plant, model, key, p):
    return at_the_truth(recording, plant, (of_form(declared_effects(dataset_of(recording), model), key), p))


def test_a_lag_that_a_declared_model_lacks():
    model = at_the_truth(record(LAG, moves()), LAG).process()
    recording = record(SopdtOverdamped(2.0, 12.0, 4.0, 3.0), moves())
    fitted = declared(recording, LAG, model, "extra_lag", (math.log(4.0),))
    assert left(fitted) < 1e-9
    assert left(at_the_truth(recording, LAG)) > 0.05
    assert fitted.sizes() == [{"time_constant_s": pytest.approx(4.0)}]


def test_a_row_of_lags_that_a_declared_model_lacks():
    """Two lags of 4 s and 1.5 s later, of which the sum is reported."""
    model = at_the_truth(record(LAG, moves()), LAG).process()
    recording = record(LagChain(2.0, (12.0, 4.0, 4.0), 4.5), moves())
    fitted = declared(recording, LAG, model, "extra_lag:spread", (math.log(4.0), 1.5))
    assert left(fitted) < 5e-3
    assert left(at_the_truth(recording, LAG)) > 0.1
    assert fitted.sizes() == [{"time_constant_s": pytest.approx(9.5)}]


@pytest.mark.parametrize(("plant", "lag"), [(LAG, 0.0), (SopdtOverdamped(2.0, 30.0, 6.0, 3.0), 5.0)])
def test_a_process_that_integrates_in_place_of_a_lag(plant, lag):
    """Of a pair the lag m/n = 30 6/36 = 5 s stays."""
    model = at_the_truth(record(plant, moves()), plant).process()
    recording = record(Integrating(0.05, lag, plant.D), moves())
    fitted = declared(recording, plant, model, "integrating", ())
    assert left(fitted) < 1e-9
    assert left(at_the_truth(recording, plant)) > 0.05
    assert fitted.sizes() == [{"gain_per_s": pytest.approx(0.05)}]


def test_a_leak_is_a_lag_far_slower_than_the_declared_one():
    model = at_the_truth(record(LAG, moves()), LAG).process()
    recording = record(Fopdt(30.0, 300.0, LAG.D), moves())
    fitted = declared(recording, LAG, model, "integrating:leaking", (math.log(300.0),))
    assert left(fitted) < 1e-9
    assert left(at_the_truth(recording, LAG)) > 0.05
    assert fitted.sizes() == [{"gain_per_s": pytest.approx(0.1), "leak_s": pytest.approx(300.0)}]


def test_a_declared_integrator_lacks_no_integrator():
    recording = record(INTEGRATOR, moves())
    effects = declared_effects(dataset_of(recording), at_the_truth(recording, INTEGRATOR).process())
    assert {effect.name for effect in effects} == {"extra_lag"}


@settings(max_examples=30)
@given(
    st.lists(st.integers(-20, 20), min_size=1, max_size=12),
    st.floats(0.5, 20.0),
    st.floats(0.5, 20.0),
)
def test_a_lagged_input_is_mirrored_and_that_of_a_lag(steps, rising_s, falling_s):
    """Within one of its small steps of the exact exponentials."""
    u = np.array([0.0, *steps])
    held = HeldInput(5.0 * np.arange(u.size), u)
    there = lagged(held, rising_s, falling_s)
    mirrored = lagged(HeldInput(held.times, -u), falling_s, rising_s)
    assert mirrored.levels == pytest.approx(-there.levels, abs=1e-9)
    x = before = 0.0
    for k, level in enumerate(u.tolist()):
        # Until the first step of a new way, it stands at the last one of the way before.
        widest, before = max(abs(level - x), before), abs(level - x)
        for since in (0.3, 2.0, 4.9):
            exact = level + (x - level) * math.exp(-since / (rising_s if level > x else falling_s))
            at = there.levels[np.searchsorted(there.times, 5.0 * k + since, side="right") - 1]
            assert abs(at - exact) <= widest / 25.0 + 1e-6
        x = level + (x - level) * math.exp(-5.0 / (rising_s if level > x else falling_s))


def test_an_averaged_input_keeps_the_area():
    """Up to each of its 299 even times; it begins at rest."""
    random = np.random.default_rng(3)
    times = np.append(0.0, np.sort(random.uniform(2.0, 500.0, 2000)))
    held = HeldInput(times, np.append(0.0, random.normal(size=2000)))
    few = averaged(held, 500.0)
    assert few.times == pytest.approx(500.0 / 299.0 * np.arange(299))
    ends, ours = np.append(times[1:], 500.0), np.cumsum(few.levels) * 500.0 / 299.0
    for k in range(1, 299, 37):
        exact = float(np.sum(held.levels * np.maximum(np.minimum(ends, few.times[k]) - times, 0.0)))
        assert ours[k - 1] == pytest.approx(exact, abs=1e-9)


def friction_view(motion, recording):
    dataset = dataset_of(recording)
    return dataset, View(dataset, dataset.data.t, 2.0, motion, dataset.data.held)


@pytest.mark.parametrize(("motion", "plain"), [(Lag(6.0), Lag(6.0)), (LaggedIntegrator(6.0), LaggedIntegrator(6.0))])
def test_an_axis_without_friction_is_a_lag(motion, plain):
    dataset, view = friction_view(motion, record(LAG, moves()))
    seen = process_friction(dataset).response(view, (0.0, 0.0))
    assert seen == pytest.approx(plain.forced(dataset.data.held, view.t - 2.0)[0][0], abs=1e-9)


@pytest.mark.parametrize("motion", [Pair(30.0, 12.0), Integrator()])
def test_a_process_of_another_order_has_no_such_friction(motion):
    dataset, view = friction_view(motion, record(LAG, moves()))
    seen = process_friction(dataset).response(view, (0.3, 0.1))
    assert seen == pytest.approx(view.forced(dataset.data.held))


def test_an_axis_stands_still_below_the_friction_and_is_mirrored():
    recording = record(LAG, moves())
    dataset, view = friction_view(Lag(6.0), recording)
    effect = process_friction(dataset)
    assert not effect.response(view, (0.51, 0.0)).any()  # 8.2 against a force of 8
    there = effect.response(view, (0.2, 0.1))
    turned, opposite = friction_view(Lag(6.0), Recording(recording.t, 2.0 * OUTPUT0 - recording.output, recording.pv))
    assert process_friction(turned).response(opposite, (0.2, -0.1)) == pytest.approx(-there, abs=1e-12)
    # At the end of a rest of 15 s: v = u + b - c sgn, reached as e^{-13/6}, from the extremes before.
    assert effect.sizes((0.2, 0.1), (), 1.0) == pytest.approx({"coulomb": 3.2, "constant": 1.6})


def test_an_axis_against_a_general_solver():
    """Where it never stops between its moves: T v' = u + b - c sgn(v) - v."""
    u, coulomb, constant = np.repeat([0.0, 8.0, 6.0, 8.0, 4.0], 20), 1.6, 0.8
    recording = record(LAG, u)
    dataset, view = friction_view(Lag(6.0), recording)
    seen = process_friction(dataset).response(view, (coulomb / 8.0, constant / 8.0))
    edges = [(0.0, None), *((20.0 * k + 2.0, level) for k, level in ((1, 8.0), (2, 6.0), (3, 8.0), (4, 4.0)))]
    found = solved(
        lambda x, f: [0.0 if f is None else (f + constant - coulomb - x[0]) / 6.0], [0.0], edges, view.t
    )  # the force at rest is below the friction
    assert seen == pytest.approx(found[0], abs=1e-6)


def test_a_hold_as_short_as_the_rounding_of_its_times_is_no_way():
    exact = lagged(HeldInput(np.array([0.0, 1.0, 4.0]), np.array([0.0, 5.0, 2.0])), 3.0, 6.0)
    rounded = lagged(HeldInput(np.array([0.0, 1.0, 4.0, 4.0 + 1e-15]), np.array([0.0, 5.0, -7.0, 2.0])), 3.0, 6.0)
    assert rounded.at(np.linspace(0.0, 30.0, 61)) == pytest.approx(exact.at(np.linspace(0.0, 30.0, 61)), abs=1e-6)
