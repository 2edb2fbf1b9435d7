"""Effects of the actuator against the simulator's actuators, describing functions and symmetries."""

import math
from typing import ClassVar

import numpy as np
import pytest
import scipy
from hypothesis import given, settings
from hypothesis import strategies as st

from autotuner.core.diagnosis.effects.actuator.characteristics import characteristics
from autotuner.core.diagnosis.effects.actuator.friction import (
    backlash,
    bands_alike,
    friction_effects,
    slipped,
    stiction,
)
from autotuner.core.diagnosis.effects.actuator.saturation import approached, map_levels, rounded, saturations
from autotuner.core.diagnosis.effects.actuator.static_curve import static_curves
from autotuner.core.diagnosis.effects.actuator.textbook_forms import (
    actuator_effects,
    positioned,
    quantisation,
    rate_limit,
    rate_limited,
    softly_positioned,
    taken_over,
    updated_every,
)
from autotuner.core.diagnosis.record.dataset import dataset_of
from autotuner.core.model.step_responses import Lag
from autotuner.core.model.zoh_input import HeldInput
from autotuner.core.recording import Recording
from autotuner_sim import (
    ActuatorHold,
    Backlash,
    DirectionGain,
    EqualPercentage,
    HeStiction,
    KanoStiction,
    OutputQuantisation,
    PowerLaw,
    RateLimit,
    Saturation,
    SoftSaturation,
    Stiction,
)
from tests.diagnosis.simulated import LAG, OUTPUT0, PAIR, at_the_truth, left, moves, of_form, record

SWING = 16.0
QUICK = settings(max_examples=40)
levels = st.lists(st.integers(-60, 60), min_size=1, max_size=25).map(lambda of: np.array([0.0, *of]) / 4.0)


class Curve:
    """An actuator of the simulator that stands at `f` of its command, both as deviation from rest."""

    moves_by_itself: ClassVar[bool] = False

    def __init__(self, f):
        self.f, self.rests_at = f, 0.0

    def rest(self, output):
        self.rests_at = output

    def act(self, command, _elapsed_s):
        return self.rests_at + self.f(command - self.rests_at)


def held(u, step_s=1.0):
    return HeldInput(step_s * np.arange(len(u)), np.array(u, dtype=float))


def stands(actuator, u, at=0.0, scans=1):
    """Return where an actuator of the simulator stands at each command."""
    actuator.rest(at)
    return [[actuator.act(float(level), 1.0) for _ in range(scans)][-1] - at for level in u]


@QUICK
@given(levels, st.floats(0.1, 20.0), st.floats(-0.5, 0.5))
def test_play_is_the_simulators(u, width, seat):
    """Wherever it sits within the play at first."""
    assert backlash(held(u), width, seat).levels == pytest.approx(stands(Backlash(width), u, seat * width), abs=1e-9)


@QUICK
@given(levels, st.floats(0.1, 20.0))
def test_a_jump_to_the_command_is_stenmans(u, band):
    assert stiction(held(u), band, 0.0).levels == pytest.approx(stands(Stiction(band), u), abs=1e-9)


@QUICK
@given(levels, st.integers(1, 40), st.integers(0, 9))
def test_a_jump_short_of_the_command_is_hes(u, band, tenths):
    static = band + 0.11  # between all sums of levels, which both take differently
    kinetic = tenths / 10.0 * static
    assert stiction(held(u), static, kinetic).levels == pytest.approx(stands(HeStiction(static, kinetic), u), abs=1e-9)


@QUICK
@given(levels, st.integers(1, 40), st.integers(1, 10))
def test_a_slip_from_every_rest_is_kanos(u, band, tenths):
    """Two scans of each command: the second stops the stem."""
    S = band + 0.13
    J = tenths / 10.0 * S
    assert slipped(held(u), S, J).levels == pytest.approx(stands(KanoStiction(S, J), u, scans=2), abs=1e-9)


@QUICK
@given(levels, st.floats(0.1, 20.0), st.floats(-0.05, 0.05))
def test_play_without_a_tilt_is_even_and_a_tilt_is_mirrored(u, width, tilt):
    mirrored = backlash(held(-u), width, tilt=-tilt).levels
    assert mirrored == pytest.approx(-backlash(held(u), width, tilt=tilt).levels, abs=1e-9)


@QUICK
@given(levels, st.floats(0.05, 30.0), st.floats(0.05, 30.0))
def test_a_rate_limit_is_mirrored_and_covers_no_more_than_its_rate(u, up, down):
    there, mirrored = rate_limited(held(u), up, down), rate_limited(held(-u), down, up)
    assert mirrored.levels == pytest.approx(-there.levels, abs=1e-9)
    assert mirrored.times == pytest.approx(there.times)
    assert np.all(np.diff(there.times) >= 0.0)
    # Its small steps are at the middle of the parts of a ramp: at most one step ahead of the rate.
    steps, passed = np.diff(there.levels), np.diff(there.times)
    assert np.all(steps <= up * passed + np.abs(steps) / 2.0 + np.abs(np.append(0.0, steps[:-1])) / 2.0 + 1e-9)


@pytest.mark.parametrize(("rate", "lag_s"), [(2.0, 0.5), (3.0, 2.0), (0.4, 4.0), (50.0, 3.0)])
def test_a_positioner_is_that_of_a_general_solver(rate, lag_s):
    """Limited over the whole way, at its beginning only, at no time, and cut off by the next command."""
    u = np.repeat([0.0, 6.0, -4.0, -3.5, 5.0, 0.0], 6)

    def f(t, x):
        return [min(max((u[min(int(t), u.size - 1)] - x[0]) / lag_s, -rate), rate), (x[0] - x[1]) / 3.0]

    t = np.arange(1.0, u.size, 0.5)
    exact = scipy.integrate.solve_ivp(f, (0.0, t[-1]), [0.0, 0.0], t_eval=t, max_step=0.01, rtol=1e-8).y[1]
    behind_it = Lag(3.0).forced(positioned(held(u), rate, lag_s), t)[0][0]
    assert behind_it == pytest.approx(exact, abs=0.01 * np.ptp(u))


@pytest.mark.parametrize(("rate", "lag_s"), [(2.0, 0.5), (3.0, 2.0), (0.4, 4.0), (50.0, 3.0)])
def test_a_soft_limit_of_the_rate_is_that_of_a_general_solver(rate, lag_s):
    u = np.repeat([0.0, 6.0, -4.0, -3.5, 5.0, 0.0], 6)

    def f(t, x):
        return [rate * math.tanh((u[min(int(t), u.size - 1)] - x[0]) / (rate * lag_s)), (x[0] - x[1]) / 3.0]

    t = np.arange(1.0, u.size, 0.5)
    exact = scipy.integrate.solve_ivp(f, (0.0, t[-1]), [0.0, 0.0], t_eval=t, max_step=0.01, rtol=1e-8).y[1]
    behind_it = Lag(3.0).forced(softly_positioned(held(u), rate, lag_s), t)[0][0]
    assert behind_it == pytest.approx(exact, abs=0.003 * np.ptp(u))


@QUICK
@given(levels, st.floats(0.05, 30.0), st.floats(0.0, 1.0))
def test_a_valve_slips_alike_with_all_bands_between_two_limits(u, band, share):
    command, left = held(u), share * band
    low, high = bands_alike(command, band, left)
    as_it_is = stiction(command, band, left).levels
    for alike in (low, band, low + 0.999 * (min(high, 1e3) - low)):
        assert np.array_equal(stiction(command, alike, left).levels, as_it_is)
    if high < np.inf:
        assert not np.array_equal(stiction(command, high, left).levels, as_it_is)


@QUICK
@given(levels, st.floats(0.05, 30.0), st.floats(0.1, 20.0), st.sampled_from([positioned, softly_positioned]))
def test_a_positioner_is_mirrored_and_ends_between_its_commands(u, rate, lag_s, moved):
    there, mirrored = moved(held(u), rate, lag_s), moved(held(-u), rate, lag_s)
    assert mirrored.levels == pytest.approx(-there.levels, abs=1e-9)
    assert np.all(np.diff(there.times) >= 0.0)
    assert u.min() - 1e-9 <= there.levels.min() <= there.levels.max() <= u.max() + 1e-9


CHARACTERISTICS = [
    ("power", (1.8,), PowerLaw(1.8), OUTPUT0 / 1.8 * (100.0 / OUTPUT0) ** 1.8),
    ("equal percentage", (math.log(20.0) * SWING / 100.0,), EqualPercentage(20.0), 100.0 / math.log(20.0) * 20.0**0.6),
]
"""Form, its number, the simulator's actuator, which ends at 1, and what makes its slope at rest one."""


@pytest.mark.parametrize(("form", "p", "valve", "slope"), CHARACTERISTICS)
def test_a_characteristic_is_the_simulators(form, p, valve, slope):
    u = np.array([0.0, 8.0, -8.0, 3.0])
    dataset = dataset_of(record(LAG, np.repeat(u, 15)))
    curve = of_form(characteristics(dataset), f"static_nonlinearity:{form}")
    expected = [slope * (valve.curve(OUTPUT0 + v) - valve.curve(OUTPUT0)) for v in u]
    assert curve.position(held(u), p, dataset).levels == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    ("form", "p"),
    [("power", (1.8,)), ("equal percentage", (-0.7,)), ("equal percentage", (0.0,)), ("S-shaped", (0.6, 0.4))],
)
def test_a_characteristic_has_slope_one_at_rest_and_sizes_of_the_closest_cubic(form, p):
    dataset = dataset_of(record(LAG, moves()))
    curve = of_form(characteristics(dataset), f"static_nonlinearity:{form}")
    small = 1e-6
    assert curve.position(held([0.0, small]), p, dataset).levels[1] == pytest.approx(small, rel=1e-5)
    u = np.linspace(-8.0, 8.0, 101)
    x = curve.position(held([0.0, *u]), p, dataset).levels[1:]
    sizes = curve.sizes(p, (), 1.0)
    cubic = sizes["slope_at_rest"] * u + sizes["curvature"] * u**2 + sizes["third"] * u**3
    for nearby in (0.99, 1.01):
        assert np.sum((x - cubic) ** 2) <= np.sum((x - nearby * cubic) ** 2)


def test_an_output_from_zero_has_no_power():
    recording = record(LAG, moves())
    below = Recording(recording.t, recording.output - OUTPUT0, recording.pv)
    assert {e.form for e in characteristics(dataset_of(below))} == {"equal percentage", "S-shaped", "smooth"}


def test_a_quick_actuator_follows_at_once():
    u = moves()
    quick = rate_limited(held(u), 1e6)
    stands_at = quick.levels[np.searchsorted(quick.times, np.arange(u.size) + 0.5, side="right") - 1]
    assert stands_at == pytest.approx(u, abs=1e-6)


def test_a_move_as_small_as_a_number_can_be_takes_no_time():
    """5e-324 over a rate of 10 is 0 s."""
    limited = rate_limited(held(np.array([0.0, 5e-324, 4.0])), 10.0)
    assert limited.at(np.array([1.5, 3.0])) == pytest.approx([0.0, 4.0])


@QUICK
@given(levels, st.floats(0.3, 7.0), st.floats(0.0, 1.0))
def test_updates_take_over_the_last_command_before_each(u, period, phase):
    """By asking at every update for the command that stands there, and before the next one for the same."""
    seen = taken_over(held(u), period, phase)
    grid = period * (np.arange(math.ceil((len(u) + 9.0) / period)) + phase)
    coincides = np.abs(grid - np.round(grid)) < 1e-3  # a command at an update may come before or after
    at = grid[(grid > 0.0) & ~coincides & ~np.append(coincides[1:], np.array([False]))]
    command = u[np.minimum(at, len(u) - 1).astype(int)]
    for later in (1e-4, period - 1e-4):
        assert seen.levels[np.searchsorted(seen.times, at + later, side="right") - 1] == pytest.approx(command)


SINE = 10.0 * np.sin(2.0 * np.pi * np.arange(4 * 2000 + 1) / 2000.0)


def describing(position):
    """Return the first harmonic of a position over that of a sine, over the last of four periods."""
    turn = np.exp(-2j * np.pi * np.arange(2000) / 2000.0)
    return complex((position[-2000:] @ turn) / (SINE[-2000:] @ turn))


def test_the_describing_function_of_a_limiter():
    """(2/pi) (asin s + s sqrt(1 - s^2)), s limit over amplitude."""
    dataset = dataset_of(record(LAG, SINE[:2001:20]))
    s = 0.6
    both = next(effect for effect in saturations(dataset) if effect.form == "both")
    found = describing(both.position(held(SINE), (0.2, 0.2), dataset).levels)  # 20 % of a swing of 20 off either end
    assert found == pytest.approx(2.0 / math.pi * (math.asin(s) + s * math.sqrt(1.0 - s * s)), abs=1e-3)


@pytest.mark.parametrize("half", [0.5, 2.0, 5.0, 8.0])
def test_the_describing_function_of_play(half):
    """Gelb and Vander Velde, Multiple-Input Describing Functions, 1968: k = 1 - 2 half/amplitude."""
    r = half / 10.0
    k = 1.0 - 2.0 * r
    real = (math.pi / 2.0 + math.asin(k) + k * math.sqrt(1.0 - k * k)) / math.pi
    exact = complex(real, -4.0 * r * (1.0 - r) / math.pi)
    assert describing(backlash(held(SINE), 2.0 * half, 0.0).levels) == pytest.approx(exact, abs=3e-3)


@pytest.mark.parametrize("step", [1.0, 3.0, 8.0])
def test_the_describing_function_of_steps(step):
    """4 step/(pi A) times the sum of sqrt(1 - ((2 i - 1) step/(2 A))^2) over the risers that are reached."""
    dataset = dataset_of(record(LAG, SINE[:2001:20]))
    grid = quantisation(dataset, "", []).position
    reached = (2.0 * np.arange(1, 30) - 1.0) * step / 20.0
    exact = 4.0 * step / (10.0 * math.pi) * float(np.sqrt(1.0 - reached[reached < 1.0] ** 2).sum())
    assert describing(grid(held(SINE), (step / 20.0, 0.0), dataset).levels) == pytest.approx(exact, abs=3e-3)


def test_the_describing_function_of_a_rate_limit_that_is_never_done():
    """A triangle of slope R: 4 R/(pi w A), late by arccos(pi R/(2 w A))."""
    w, rate = 2.0 * math.pi / 2000.0, 0.012
    limited = rate_limited(held(SINE), rate)
    stands_at = limited.levels[np.searchsorted(limited.times, np.arange(SINE.size), side="right") - 1]
    found = describing(stands_at)
    assert abs(found) == pytest.approx(4.0 * rate / (math.pi * w * 10.0), rel=5e-3)
    assert -np.angle(found) == pytest.approx(math.acos(math.pi * rate / (2.0 * w * 10.0)), abs=5e-3)


@QUICK
@given(levels, st.floats(0.05, 3.0), st.floats(-10.0, 10.0))
def test_a_rounded_limit_is_the_simulators_and_its_own_mirror(u, width, high):
    soft = stands(SoftSaturation(high, width), u)
    ours = map_levels(held(u), lambda at: rounded(at, -1e6, high, width)).levels
    assert ours == pytest.approx(soft, abs=1e-6)
    assert rounded(-u, -high - 20.0, -high, width) == pytest.approx(
        -rounded(u, high, high + 20.0, width), abs=40.0 * width * math.exp(-20.0 / width) + 1e-9
    )


@QUICK
@given(levels, st.floats(-60.0, -1.0), st.floats(1.0, 60.0))
def test_a_smooth_limit_is_a_logistic_curve_between_its_ends(u, low, high):
    """tanh(x) = 2/(1 + e^(-2 x)) - 1: slope 1 in the middle, and either end is approached, never passed."""
    ours = approached(u, low, high)
    logistic = scipy.special.expit(4.0 * (u - (low + high) / 2.0) / (high - low))
    assert ours == pytest.approx(low + (high - low) * logistic, abs=1e-9 * (high - low))
    assert low <= ours.min() <= ours.max() <= high


def effects_of(recording):
    return actuator_effects(dataset_of(recording), [], {})


@pytest.mark.parametrize("plant", [LAG, PAIR])
@pytest.mark.parametrize(
    ("key", "p", "ends"),
    [
        ("saturation:high", (0.25,), {"high": 44.0}),
        ("saturation:low", (0.125,), {"low": 34.0}),
        ("saturation:both", (0.125, 0.25), {"low": 34.0, "high": 44.0}),
    ],
)
def test_limits_leave_nothing_of_the_simulators_record(plant, key, p, ends):
    recording = record(plant, moves(), actuators=[Saturation(**{"low": 0.0, "high": 100.0, **ends})])
    fitted = at_the_truth(recording, plant, (of_form(saturations(dataset_of(recording)), key), p))
    assert left(fitted) < 1e-9
    assert left(at_the_truth(recording, plant)) > 0.05
    assert fitted.sizes() == [pytest.approx(ends)]
    assert pytest.approx(plant.K) == fitted.process().K


def test_a_limit_off_the_range_is_none():
    recording = record(LAG, moves())
    for effect, p in ((of_form(saturations(dataset_of(recording)), f"saturation:{k}"), p) for k, p in
                      (("high", (0.0,)), ("low", (0.0,)), ("both", (0.0, 0.0)))):  # fmt: skip
        assert left(at_the_truth(recording, LAG, (effect, p))) < 1e-9


@pytest.mark.parametrize("plant", [LAG, PAIR])
@pytest.mark.parametrize("share", [0.01, 0.05])
def test_a_rate_limit_leaves_little_of_the_simulators_record(plant, share):
    """The simulator moves in scans of 20 ms, ours in a dozen steps a ramp."""
    rate = 1.0 / (share * 300.0) * SWING
    recording = record(plant, moves(), actuators=[RateLimit(rate)], actuator_scan_s=0.02)
    fitted = at_the_truth(recording, plant, (rate_limit(dataset_of(recording)), (math.log(rate / SWING),)))
    assert left(fitted) < 2e-3
    assert left(at_the_truth(recording, plant)) > 0.02
    assert fitted.sizes() == [pytest.approx({"rate_per_s": rate})]


def test_two_rates_are_one_where_they_are_equal_and_each_its_own_else():
    class Unequal:
        moves_by_itself: ClassVar[bool] = True

        def rest(self, output):
            self.x = output

        def act(self, command, elapsed_s):
            self.x = min(max(command, self.x - 0.8 * elapsed_s), self.x + 3.0 * elapsed_s)
            return self.x

    recording = record(LAG, moves(), actuators=[Unequal()], actuator_scan_s=0.02)
    effect = of_form(effects_of(recording), "rate_limit:unequal")
    right = at_the_truth(recording, LAG, (effect, (math.log(3.0 / SWING), math.log(0.8 / SWING))))
    swapped = at_the_truth(recording, LAG, (effect, (math.log(0.8 / SWING), math.log(3.0 / SWING))))
    assert left(right) < 2e-3
    assert left(swapped) > 0.1
    assert right.sizes() == [pytest.approx({"rate_per_s": 3.0, "falling_rate_per_s": 0.8})]


def test_steps_of_the_actuator_leave_nothing():
    recording = record(PAIR, moves(), actuators=[OutputQuantisation(3.0)])
    effect = quantisation(dataset_of(recording), "from the rest", [])
    fitted = at_the_truth(recording, PAIR, (effect, (3.0 / SWING, 0.0)))
    assert left(fitted) < 1e-9
    assert left(at_the_truth(recording, PAIR)) > 0.02
    assert fitted.sizes() == [pytest.approx({"step": 3.0})]
    assert left(at_the_truth(recording, PAIR, (effect, (3.0 / SWING, 0.4)))) > 0.02


def test_an_actuator_that_reads_now_and_then_leaves_nothing():
    recording = record(LAG, moves(hold=10), actuators=[ActuatorHold(3.7)], actuator_scan_s=0.1)
    effect = updated_every(dataset_of(recording), [])
    fitted = at_the_truth(recording, LAG, (effect, (math.log(3.7), 0.0)))
    assert left(fitted) < 1e-6
    assert left(at_the_truth(recording, LAG)) > 0.05
    assert fitted.sizes() == [pytest.approx({"period_s": 3.7})]
    assert effect.lateness_s((math.log(3.7), 0.0)) == pytest.approx(3.7 / math.sqrt(12.0))


@pytest.mark.parametrize(
    ("key", "actuator", "p", "sizes"),
    [
        # (u/100)^2 stretched to slope 1 at rest: d + d^2/(2 rest), over the swing
        ("static_nonlinearity:square", PowerLaw(2.0), (), {"curvature": SWING / (2.0 * OUTPUT0)}),
        # d + d^2/rest + d^3/(3 rest^2)
        ("static_nonlinearity:cubic", PowerLaw(3.0), (), {"curvature": 0.4, "third": SWING**2 / (3.0 * OUTPUT0**2)}),
        ("direction_gain", DirectionGain(1.6), (), {"ratio": 1.6}),
        ("direction_gain", DirectionGain(0.4), (), {"ratio": 0.4}),
        (
            "direction_gain:bend",
            Curve(lambda u: u + 0.7 * 0.5 * (u + math.hypot(u, 1.6) - 1.6)),
            (0.1,),
            {"ratio": 1.7},
        ),
        (
            "direction_gain:kink elsewhere",
            Curve(lambda u: u + 0.5 * (max(u + 6.0, 0.0) - 6.0)),
            (0.125,),
            {"ratio": 1.5, "kink": OUTPUT0 - 6.0},
        ),
    ],
)
@pytest.mark.parametrize("plant", [LAG, PAIR])
def test_curves_have_the_simulators_sizes(plant, key, actuator, p, sizes):
    recording = record(plant, moves(), actuators=[actuator])
    effect = of_form(effects_of(recording), key)
    fitted = at_the_truth(recording, plant, (effect, p))
    assert left(fitted) < 1e-6
    assert left(at_the_truth(recording, plant)) > 0.005
    assert fitted.sizes() == [pytest.approx(sizes, rel=1e-5)]
    assert pytest.approx(plant.K, rel=1e-5) == fitted.process().K
    assert fitted.is_meaningful()


@pytest.mark.parametrize("key", ["static_nonlinearity:cubic", "direction_gain", "direction_gain:bend"])
def test_a_curve_has_no_size_where_there_is_none(key):
    recording = record(LAG, moves())
    effect = of_form(effects_of(recording), key)
    fitted = at_the_truth(recording, LAG, (effect, (0.2,) * len(effect.searched)))
    assert fitted.linear[1 : 1 + fitted.counts[0]] == pytest.approx(0.0, abs=1e-9)


def test_a_gain_that_turns_its_sign_is_not_one_of_direction():
    recording = record(LAG, moves(), actuators=[Curve(lambda u: u if u < 0.0 else -0.3 * u)])
    fitted = at_the_truth(recording, LAG, (of_form(effects_of(recording), "direction_gain"), ()))
    assert fitted.sizes() == [pytest.approx({"ratio": -0.3})]
    assert not fitted.is_meaningful()


def test_positions_without_a_formula_are_those_of_the_simulator():
    """Any position at each of the levels: the splines pass through all of them."""
    at = {-8.0: -9.0, -4.0: -2.5, 0.0: 0.0, 4.0: 5.5, 8.0: 7.0}
    recording = record(PAIR, moves(), actuators=[Curve(lambda u: at[round(u, 6)])])
    curve, steps = static_curves(dataset_of(recording))
    for effect in (curve, steps):
        fitted = at_the_truth(recording, PAIR, (effect, ()))
        assert left(fitted) < 1e-9
        assert left(at_the_truth(recording, PAIR)) > 0.05
    # The line between the ends is u - 1: the positions lie 0.5 and -1 ... off it, times its slope of 1.
    slope = (at[8.0] - at[-8.0]) / 16.0
    off = {u: x - at[-8.0] - slope * (u + 8.0) for u, x in at.items()}
    assert fitted.sizes() == [pytest.approx({"step": 2.0 * max(abs(x) for x in off.values()) / slope})]


@pytest.mark.parametrize(
    ("key", "actuator", "p", "sizes"),
    [
        ("backlash", Backlash(3.2), (0.2,), {"width": 3.2}),
        ("backlash:seated", Backlash(3.2), (0.2, 0.0), {"width": 3.2}),
        ("stiction", Stiction(4.8), (0.3, 0.0), {"band": 4.8, "jump": 4.8}),
        ("stiction", HeStiction(4.8, 1.2), (0.3, 0.25), {"band": 4.8, "jump": 3.6}),
    ],
)
def test_friction_leaves_nothing_of_the_simulators_record(key, actuator, p, sizes):
    recording = record(LAG, moves(), actuators=[actuator])
    fitted = at_the_truth(recording, LAG, (of_form(friction_effects(dataset_of(recording)), key), p))
    assert left(fitted) < 1e-9
    assert left(at_the_truth(recording, LAG)) > 0.02
    assert fitted.sizes() == [pytest.approx(sizes)]
