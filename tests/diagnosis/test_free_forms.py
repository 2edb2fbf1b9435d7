"""Forms that no textbook has, and physics on the process side, against recordings integrated here by Runge-Kutta."""

import math

import numpy as np
import pytest
import scipy

from autotuner import Recording, diagnose
from autotuner.core.diagnosis.effects.actuator.static_curve import static_curves
from autotuner.core.diagnosis.effects.free_forms import by_chance, shape_of
from autotuner.core.diagnosis.effects.process.friction import _Axis, _course
from autotuner.core.diagnosis.effects.waves import slow_wave
from autotuner.core.diagnosis.extended.base import base_of
from autotuner.core.diagnosis.extended.fit_context import bench_of
from autotuner.core.diagnosis.record.dataset import dataset_of
from autotuner.core.diagnosis.search.search import extend
from autotuner.core.estimation.initial_guesses import ringing_shapes
from autotuner.core.model.zoh_input import smooth_input

pytestmark = pytest.mark.usefixtures("without_gains")

N, H = 700, 1.0


def steps(size=8.0, seed=2, hold=20):
    random = np.random.default_rng(seed)
    output = np.repeat(random.choice([-1.0, -0.5, 0.5, 1.0], N // hold), hold) * size
    output[:hold] = 0.0
    return output


def integrated(f, output, x0, pieces=5):
    """Return the states at the samples of `x' = f(x, u, t)`, by the classical Runge-Kutta method."""
    x, states, h = np.array(x0), [np.array(x0)], H / pieces
    for k, u in enumerate(output[:-1]):
        for j in range(pieces):
            t = k * H + j * h
            a = f(x, u, t)
            b = f(x + h / 2 * a, u, t + h / 2)
            c = f(x + h / 2 * b, u, t + h / 2)
            d = f(x + h * c, u, t + h)
            x = x + h / 6 * (a + 2 * b + 2 * c + d)
        states.append(x)
    return np.array(states)


def recorded(output, pv, sigma, seed=1):
    noise = np.random.default_rng(seed).normal(0.0, sigma, output.size)
    return Recording(np.arange(float(output.size)) * H, 40.0 + output, 60.0 + pv + noise)


@pytest.mark.parametrize(("ratio", "first"), [(1.0, 0.0), (2.5, 0.0), (0.5, 0.7), (1.0, -0.7)])
def test_the_course_with_dry_friction_is_that_of_a_general_solver(ratio, first):
    """A smooth, steep friction law stands for the jump of the sign. Viscous friction: `ratio` up over down."""
    force = [2.0, -1.0, 0.3, 0.05, -2.0, 0.0]
    at = np.arange(len(force) + 1) * 1.5
    velocity, position = _course(at[:-1], np.array(force), 0.8, _Axis(0.4, math.log(ratio), first), at)

    def f(t, x):
        u = force[min(int(t / 1.5), len(force) - 1)]
        viscous = math.sqrt(ratio if x[0] > 0.0 else 1.0 / ratio)
        return [(u - 0.4 * math.tanh(x[0] / 1e-4) - viscous * x[0]) / 0.8, x[0]]

    how = {"method": "LSODA", "max_step": 0.002, "rtol": 1e-8}
    found = scipy.integrate.solve_ivp(f, (0.0, at[-1]), [first, 0.0], t_eval=at, **how)
    np.testing.assert_allclose(velocity, found.y[0], atol=2e-3)
    np.testing.assert_allclose(position, found.y[1], atol=5e-3)


def test_a_hardening_spring_is_named_with_its_size(among):
    """Duffing: m x'' + n x' + x + b x^3 = K u."""
    among("nonlinear_stiffness", "nonlinear_loss", "extra_lag", "slow_mode")
    output = steps(hold=12)

    def duffing(x, u, _t):
        return np.array([x[1], (1.5 * u - x[0] - 0.004 * x[0] ** 3 - 3.0 * x[1]) / 25.0])

    states = integrated(duffing, output, [0.0, 0.0])
    found = diagnose(recorded(output, states[:, 0], 0.03))
    assert found.effects[0].name == "nonlinear_stiffness"
    assert found.effects[0].parameters["cubic_per_pv2"] == pytest.approx(0.004, rel=0.1)
    assert found.verdict == "explained"


@pytest.mark.parametrize("drift", [0.02, pytest.param(0.0, marks=pytest.mark.long)])
def test_an_inverse_response_is_found_where_dead_time_stood_for_it(among, drift):
    """Two paths, 1.6/(30 s + 1) - 0.6/(6 s + 1): a zero at Z = 0.6 30 - 1.6 6 = 8.4 s, behind a dead time of 5 s."""
    among("inverse_response", "extra_lag", "slow_mode", "flow_delay", "drift")
    output = steps()
    late = np.concatenate((np.zeros(5), output[:-5]))

    def two_paths(x, u, _t):
        return np.array([(1.6 * 2.0 * u - x[0]) / 30.0, (-0.6 * 2.0 * u - x[1]) / 6.0])

    pv = integrated(two_paths, late, [0.0, 0.0]).sum(axis=1) + drift * np.arange(N) * H
    found = diagnose(recorded(output, pv, 0.05))
    named = {effect.name: effect.parameters for effect in found.effects}
    assert set(named) == {"inverse_response", *(["drift"] if drift else [])}
    assert named["inverse_response"]["Z"] == pytest.approx(8.4, rel=0.05)
    assert pytest.approx(5.0, rel=0.05) == found.process.D


@pytest.mark.long  # lags by hand are in test_extended_models
def test_lags_in_a_row_are_a_further_lag_and_its_time_is_in_the_sum(among):
    among("extra_lag", "inverse_response", "slow_mode", "flow_delay")
    output = steps(hold=25)
    lags = (14.0, 11.0, 9.0, 7.0)

    def row(x, u, _t):
        return (np.array([2.0 * u, *x[:-1]]) - x) / np.array(lags)

    found = diagnose(recorded(output, integrated(row, output, [0.0] * 4)[:, -1], 0.05))
    assert [effect.name for effect in found.effects] == ["extra_lag"]
    process = found.process
    assert found.verdict == "explained"
    pair = process.n if hasattr(process, "n") else process.T1 + process.T2
    whole = pair + found.effects[0].parameters["time_constant_s"] + process.D
    assert whole == pytest.approx(sum(lags), rel=0.02)


def positioned(table, size, levels):
    """A lag of 15 s behind an actuator that stands at `table` of the outputs `levels`."""
    random = np.random.default_rng(5)
    output = np.repeat(random.choice(levels, N // 14), 14) * size
    output[:14] = 0.0
    return output, table(output)


def lag(x, v, _t):
    return (2.0 * v - x) / 15.0


@pytest.mark.long  # equal steps are in test_effects_are_named
def test_steps_of_unequal_size_are_named_first_or_as_what_no_record_tells_from_the_first(among):
    among("output_quantisation", "static_nonlinearity", "saturation", "direction_gain")
    edges = np.array([-9.0, -4.5, 0.0, 1.5, 6.5, 8.0])
    output, stands = positioned(
        lambda u: edges[np.argmin(np.abs(edges - u[:, None]), axis=1)], 8.0, [-1.0, -0.4, 0.4, 1.0]
    )
    found = diagnose(recorded(output, integrated(lag, stands, [0.0])[:, 0], 0.05))
    first = found.effects[0]
    assert len(found.effects) == 1
    assert "output_quantisation" in {first.name, *first.indistinguishable}
    assert found.error["fitted"].after < 1.3 * 0.05 < 0.2 * found.error["fitted"].before


@pytest.mark.long  # curves by hand follow, and the spring above shows the search
def test_a_curve_of_many_levels_is_a_static_nonlinearity(among):
    among("static_nonlinearity", "saturation", "direction_gain", "output_quantisation")
    output, stands = positioned(lambda u: 5.0 * np.tanh(u / 5.0), 8.0, np.linspace(-1.0, 1.0, 41))
    found = diagnose(recorded(output, integrated(lag, stands, [0.0])[:, 0], 0.05))
    assert [effect.name for effect in found.effects] in (["static_nonlinearity"], ["saturation"])
    assert found.error["fitted"].after < 1.3 * 0.05 < 0.2 * found.error["fitted"].before


def test_a_curve_without_a_formula_passes_its_knots():
    random = np.random.default_rng(5)
    output = np.repeat(random.choice([-8.0, -3.0, 3.0, 8.0], N // 14), 14)
    output[:14] = 0.0
    dataset = dataset_of(recorded(output, output, 0.1))
    curve, steps_of_unequal_size = static_curves(dataset)
    at = np.array([-8.0, -3.0, 0.0, 3.0, 8.0])
    for k, spline in enumerate(curve.columns.splines(at).T):
        assert spline == pytest.approx(np.eye(5)[k + 1])
    assert steps_of_unequal_size.sizes((), (0.0, 2.0, -1.0), 2.0) == {"step": 2.0}
    # x = u - 0.01 u^3 has a slope of 0.36 between the end knots, to which the spline's numbers are relative.
    bends = (at - 0.01 * at**3) - 0.36 * at
    assert curve.sizes((), bends[1:-1].tolist(), 0.36) == pytest.approx(
        {"slope_at_rest": 1.0 / 0.36, "curvature": 0.0, "third": -0.01 / 0.36}, abs=1e-9
    )


def both_directions():
    """Return a motor's answer to a staircase up, down to the other direction, and back; atan of it, behind a lag."""
    levels = np.concatenate((np.linspace(0.0, 1.0, 11), np.linspace(0.9, -1.0, 20), np.linspace(-0.9, 0.0, 10)))
    output = np.repeat(levels, 10)
    states = integrated(lambda x, u, _t: (10.0 * math.atan(4.0 * u) - x) / 2.5, output, [0.0])
    noise = np.random.default_rng(1).normal(0.0, 0.05, output.size)
    return Recording(np.arange(float(output.size)), output, states[:, 0] + noise)


def test_an_odd_curve_shows_one_direction_by_the_other():
    """The fitted part ends at -0.6 of the output, the other at -1: a curve without symmetry does not know it."""
    context = bench_of(dataset_of(both_directions()))
    base = base_of(context, ("offset",), 1)
    curves = [extend(context, base.origins, [effect])[0] for effect in static_curves(context.dataset)]
    plain, odd = sorted(curves, key=context.held_out_error, reverse=True)
    assert odd.problem.effects[0].form == "free, odd, 11 knots"
    assert context.held_out_error(odd) < 1.3 * 0.05 < 0.2 * context.held_out_error(plain)
    assert odd.sizes()[0]["curvature"] == 0.0 < odd.sizes()[0]["slope_at_rest"]


def test_an_output_of_one_sign_has_no_odd_curve():
    output = np.repeat(np.random.default_rng(5).uniform(0.0, 8.0, N // 14), 14)
    forms = [effect.form for effect in static_curves(dataset_of(Recording(np.arange(float(N)), output, output)))]
    assert forms == ["free, 7 knots"]


@pytest.mark.long  # the two tests above show the curve
def test_an_odd_curve_is_a_static_nonlinearity():
    found = diagnose(both_directions())
    assert [effect.name for effect in found.effects] == ["static_nonlinearity"]
    assert found.error["held_out"].after < 1.5 * 0.05 < 0.2 * found.error["held_out"].before


@pytest.mark.long  # the next test shows the names of the shapes
def test_a_load_of_free_shape_is_called_ambient():
    output = steps()

    def lag(x, u, t):
        return (2.0 * (u + 3.0 * math.sin(t / 90.0) + 1.5 * math.sin(t / 60.0 + 1.0)) - x) / 15.0

    states = integrated(lag, output, [0.0])
    found = diagnose(recorded(output, states[:, 0], 0.05))
    assert found.effects[0].name == "ambient"
    assert found.error["fitted"].after < 1.5 * 0.05 < 0.2 * found.error["fitted"].before


@pytest.mark.parametrize(
    ("curve", "name"),
    [
        (lambda x: np.where(x < 0.5, 0.0, 1.0), "load_step"),
        (lambda x: x, "drift"),
        (lambda x: x**2, "drift"),
        (lambda x: np.sin(5.0 * x), "ambient"),
        (lambda x: np.sin(40.0 * x), "periodic_disturbance"),
        (lambda x: 1.0 / (1.0 + np.exp(-60.0 * (x - 0.4))) + 0.02 * np.sin(40.0 * x), "load_step"),
    ],
)
def test_a_free_load_is_called_by_its_shape(curve, name):
    assert shape_of(curve(np.linspace(0.0, 1.0, 120))) == name


@pytest.mark.parametrize("rests_first", [True, False])
def test_a_slow_wave_is_named_with_its_period_and_predicts(among, rests_first):
    """A load of three quarters of a period in the record, from rest and from any state."""
    among("ambient", "load_step", "drift")
    output = steps()
    output[:20] = 0.0 if rests_first else 8.0

    def lag(x, u, t):
        return (2.0 * (u + 3.0 * math.sin(2.0 * math.pi * t / 930.0 + 0.5)) - x) / 15.0

    states = integrated(lag, output, [0.0 if rests_first else 16.0])
    found = diagnose(recorded(output, states[:, 0], 0.05))
    assert [(effect.name, effect.form) for effect in found.effects] == [("ambient", "slow wave")]
    assert found.effects[0].parameters["period_s"] == pytest.approx(930.0, rel=0.03)
    assert found.effects[0].parameters["amplitude"] == pytest.approx(6.0, rel=0.05)
    assert found.error["held_out"].after < 1.2 * 0.05


def test_a_wave_that_only_goes_one_way_in_a_record_is_no_slow_wave():
    output = steps()
    wave = slow_wave(dataset_of(recorded(output, output, 0.05)))
    assert wave.means((math.log(0.9),), (0.0, 1.0), 1.0, ())
    assert not wave.means((math.log(0.6),), (1.0, 0.0), 1.0, ())


def test_a_drift_that_bends_is_named_and_predicts(among):
    among("ambient", "load_step", "drift")
    output, t = steps(), np.arange(float(N))
    states = integrated(lambda x, u, _t: (2.0 * u - x) / 15.0, output, [0.0])
    found = diagnose(recorded(output, states[:, 0] + 6.0 * (t / N) ** 2.6, 0.05))
    assert [(effect.name, effect.form) for effect in found.effects] == [("drift", "accelerating")]
    assert found.effects[0].parameters["pv_in_all"] == pytest.approx(6.0 * 0.675**2.6, rel=0.05)  # of the fitted part
    assert found.effects[0].parameters["power"] == pytest.approx(2.6, rel=0.05)
    assert found.error["held_out"].after < 1.1 * 0.05


def test_dry_friction_of_an_axis_is_named_on_the_process_side():
    """By Euler's method in steps of 5 ms: a velocity that would change its sign within a step stops there."""
    output, h, T, coulomb = steps(), 0.005, 4.0, 2.0
    v, course = 0.0, []
    for u in output.tolist():
        course.append(1.5 * v)
        for _ in range(int(H / h)):
            if v == 0.0 and abs(u) <= coulomb:
                continue
            way = math.copysign(1.0, v or u)
            moved = v + h / T * (u - coulomb * way - v)
            v = 0.0 if moved * v < 0.0 else moved
    found = diagnose(recorded(output, np.array(course), 0.03))
    assert found.effects[0].name == "process_friction"
    assert found.effects[0].parameters["coulomb"] == pytest.approx(coulomb, rel=0.05)
    assert found.verdict == "explained"


def axis_moved_to_and_fro(seed=1):
    """A mass on rails by Euler's method in steps of 1 ms: viscous friction 60 % of the way down on the way up, a load
    that is switched, and a controller that follows a course, so that the force is never at rest."""
    random = np.random.default_rng(seed)
    h, steps_each, count = 0.001, 20, 1500
    levels = np.repeat(random.choice([-1.0, -0.6, -0.3, 0.3, 0.6, 1.0], count // 50), 50)
    v, x, target, output, pv = 0.0, 0.0, 0.0, [], []
    for k, level in enumerate(levels.tolist()):
        target += level * h * steps_each
        u = 40.0 * (target - x) + 12.0 * (level - v)
        output.append(u)
        pv.append(x)
        for j in range(steps_each):
            force = u + 0.6 * (1.0 if ((k * steps_each + j) * h / 1.7) % 1.0 < 0.5 else -1.0)
            viscous = 3.0 if v > 0.0 else 5.0
            if v == 0.0 and abs(force) <= 2.0:
                continue
            way = math.copysign(1.0, v or force)
            moved = v + h / 1.5 * (force - 2.0 * way - viscous * v)
            v = 0.0 if moved * v < 0.0 else moved
            x += h * v
    t = h * steps_each * np.arange(count)
    return Recording(t, np.array(output), np.array(pv) + random.normal(0.0, 2e-4, count))


@pytest.mark.long  # friction of the process without a switched load is in test_process_effects
def test_an_axis_has_friction_by_direction_and_a_load_that_is_switched():
    """An axis integrates its forces twice: what is left is a random walk, in which the load is hidden."""
    found = diagnose(axis_moved_to_and_fro())
    friction = next(effect for effect in found.effects if effect.name == "process_friction")
    assert friction.parameters["viscous_up_over_down"] == pytest.approx(0.6, rel=0.05)
    assert friction.parameters["coulomb"] == pytest.approx(2.0, rel=0.05)
    load = next(effect for effect in found.effects if effect.name == "periodic_disturbance")
    assert load.parameters["period_s"] == pytest.approx(1.7, rel=0.01)
    assert load.parameters["amplitude"] == pytest.approx(0.6, rel=0.1)


def waves(t):
    """Return a smooth output of 40 sines up to a fifth of the sampling rate, at any times."""
    random = np.random.default_rng(5)
    w, at = 2.0 * math.pi * random.uniform(0.01, 0.2, 40), random.uniform(0.0, 6.28, 40)
    return 0.15 * np.sin(np.outer(t, w) + at).sum(axis=1)


@pytest.mark.long  # the next test, and the spring under held moves, show its parts
def test_a_spring_is_named_where_the_output_moves_between_its_samples():
    """Duffing with a damping ratio of 0.05 and nine samples a period, which no grid of starts comes near."""
    output = waves(np.arange(N) * H)
    between = waves(np.arange(10 * N) * H / 10.0)  # the Runge-Kutta method asks for halves of its steps of a fifth

    def duffing(x, _u, t):
        u = between[min(round(10.0 * t / H), between.size - 1)]
        return np.array([x[1], (u - x[0] - 0.01 * x[0] ** 3 - 0.14 * x[1]) / 2.05])

    found = diagnose(recorded(output, integrated(duffing, output, [0.0, 0.0])[:, 0], 0.01))
    assert found.effects[0].name == "nonlinear_stiffness"
    assert found.effects[0].parameters["cubic_per_pv2"] == pytest.approx(0.01, rel=0.1)
    assert any("smoothly between its samples" in note for note in found.notes)
    assert found.error["held_out"].after < 0.1 * found.error["held_out"].before


def test_an_output_on_a_spline_has_the_means_of_the_curve():
    t = np.arange(0.0, 20.0, 0.1)
    held = smooth_input(t, np.sin(t))
    mean = (np.cos(held.times[1:-2]) - np.cos(held.times[2:-1])) / np.diff(held.times[1:-1])
    np.testing.assert_allclose(held.levels[1:-2], mean, atol=1e-4)


def test_a_process_that_rings_is_found_by_regression():
    """Free motion of `m y'' + n y' + y = 0` about a constant, in closed form."""
    n, m = 0.3, 4.0
    t, decay = np.arange(200) * 0.5, n / (2.0 * m)
    y = 3.0 + np.exp(-decay * t) * np.cos(math.sqrt(1.0 / m - decay**2) * t)
    assert ringing_shapes(t, np.zeros(t.size), y)[0] == pytest.approx((n, m / n), rel=1e-6)


@pytest.mark.parametrize(("begins_s", "chance"), [(105.0, False), (99.5, False), (250.0, True), (50.0, True)])
def test_what_begins_right_after_one_of_few_moves_is_an_answer_to_it(begins_s, chance):
    """Moves at 100 and 350 of 700 s: 5 s after one of them lie 10 s, 150 s after lie 300 s."""
    output = np.where(np.arange(N) < 100, 0.0, np.where(np.arange(N) < 350, 5.0, -2.0))
    dataset = dataset_of(recorded(output, np.zeros(N), 0.1))
    assert by_chance(dataset, begins_s) is chance


def test_a_load_that_enters_a_process_with_a_slow_mode_is_named_beside_it(among):
    """Two paths, 1.4/(10 s + 1) + 0.6/(80 s + 1), under an output and a load of 3 from 280 s: both take either path."""
    among("slow_mode", "load_step", "drift")
    output = steps()

    def two_paths(x, u, t):
        v = u + (3.0 if t >= 280.0 else 0.0)
        return np.array([(1.4 * v - x[0]) / 10.0, (0.6 * v - x[1]) / 80.0])

    found = diagnose(recorded(output, integrated(two_paths, output, [0.0, 0.0]).sum(axis=1), 0.05))
    named = {effect.name: effect.parameters for effect in found.effects}
    assert set(named) == {"slow_mode", "load_step"}
    assert named["slow_mode"]["time_constant_s"] == pytest.approx(80.0, rel=0.1)
    assert named["slow_mode"]["share"] == pytest.approx(0.3, rel=0.1)
    assert named["load_step"] == pytest.approx({"at_s": 280.0, "size": 3.0}, rel=0.02)
