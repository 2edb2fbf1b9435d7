"""Parts of the catalogue against sequences worked by hand and closed forms."""

import math

import numpy as np
import pytest
import scipy

from autotuner.core.diagnosis.effects.actuator.friction import backlash, slipped, stiction, turned, turns_of
from autotuner.core.diagnosis.effects.actuator.saturation import rounded, saturations, soft_limits
from autotuner.core.diagnosis.effects.actuator.textbook_forms import rate_limited, taken_over
from autotuner.core.diagnosis.effects.declared import lagged
from autotuner.core.diagnosis.effects.disturbance import behind_a_lag
from autotuner.core.diagnosis.effects.process.nonlinear_losses import excess
from autotuner.core.diagnosis.effects.process.shaped_stores import shaped_stores
from autotuner.core.diagnosis.effects.process.state_limits import overflowing_stores
from autotuner.core.diagnosis.effects.process.stepping import stepped, two_speeds, with_loss, with_loss_at_the_end
from autotuner.core.diagnosis.extended.effect import View
from autotuner.core.diagnosis.record.dataset import dataset_of, noise_at_rest, one_noise
from autotuner.core.model.step_responses import Lag, Pair, PairAndLag
from autotuner.core.model.zoh_input import HeldInput
from autotuner.core.recording import Recording


def held(*levels, step_s=1.0):
    return HeldInput(step_s * np.arange(len(levels)), np.array(levels, dtype=float))


def test_play_takes_up_its_width_at_each_reversal():
    # Full width 2: the position stays 1 behind the way it went last.
    assert backlash(held(0, 3, 2, 0, 4), 2.0, 0.0).levels.tolist() == [0.0, 2.0, 2.0, 1.0, 3.0]


def test_a_sticking_valve_jumps_when_the_command_is_beyond_its_band():
    assert stiction(held(0, 1, 2, 2.5, 0.4), 1.5, 0.5).levels.tolist() == [0.0, 0.0, 1.5, 1.5, 1.5]
    assert stiction(held(0, 2, -0.1), 1.5, 0.0).levels.tolist() == [0.0, 2.0, -0.1]


def test_a_stem_that_stops_at_every_rest_slips_from_there():
    """Band 2, jump 1: the first slip takes 1.5, one the same way 1, one the other way 2; each ends 0.5 short."""
    slips = slipped(held(0, 1.4, 2, 2.5, 3.2, 1.5, 1.0, -0.1), 2.0, 1.0)
    assert slips.levels.tolist() == pytest.approx([0.0, 0.0, 1.5, 1.5, 2.7, 2.7, 1.5, 0.4])


def test_a_stem_without_a_jump_of_its_own_is_play():
    moves = held(0, 3, 2, 0, 4, 1, -3)
    assert slipped(moves, 2.0, 1e-9).levels.tolist() == pytest.approx(backlash(moves, 2.0, 0.0).levels.tolist())


def test_turns_are_where_the_output_leaves_its_extremes():
    levels = np.array([0.0, 1.0, 2.0, 2.0, 1.0, 0.0, -1.0, 0.0, 1.0, 2.0])
    assert turns_of(levels, 1.5, 0.0) == [(4, 2), (7, 6)]
    # The position rests at the last turn's level; it has come up to 2, then down to -1.
    assert turned(HeldInput(np.arange(10.0), levels), (1.5, 0.0), 0.5, 0.0).levels.tolist() == [
        *[0.0] * 4,
        *[1.5] * 3,
        *[-0.5] * 3,
    ]


def test_no_turn_no_slip():
    assert not turned(held(0, 1, 2, 3), (1.5, 0.0), 0.5, 0.0).levels.any()


def test_a_limited_rate_arrives_when_the_way_is_covered():
    limited = rate_limited(held(0, 4, step_s=10.0), 2.0)
    assert limited.levels[-1] == pytest.approx(4.0)
    assert 11.8 < limited.times[-1] <= 12.0


def test_updates_wait_for_the_grid():
    waited = taken_over(HeldInput(np.array([0.0, 3.0, 7.0]), np.array([0.0, 1.0, 2.0])), 5.0, 0.0)
    assert waited.times.tolist() == pytest.approx([0.0, 5.0, 10.0], abs=1e-4)
    assert waited.levels.tolist() == [0.0, 1.0, 2.0]


def test_a_rounded_limit_is_the_hard_one_far_from_its_corner():
    assert rounded(np.array([-9.0, 0.0, 9.0]), -1.0, 1.0, 0.01) == pytest.approx([-1.0, 0.0, 1.0], abs=1e-6)


def recording(output, pv, step_s=1.0):
    return Recording(step_s * np.arange(len(pv)), np.array(output, dtype=float), np.array(pv, dtype=float))


def test_limits_are_shares_of_the_swing():
    rng = np.random.default_rng(1)
    dataset = dataset_of(recording([0.0] * 20 + [10.0] * 20 + [0.0] * 20, rng.normal(size=60)))
    both = next(effect for effect in saturations(dataset) if effect.form == "both")
    assert both.position(dataset.data.held, (0.0, 0.25), dataset).levels.tolist() == [0.0, 7.5, 0.0]


def test_limits_stay_where_they_are_though_the_output_goes_further_later():
    rng = np.random.default_rng(1)
    early, whole = [0.0] * 20 + [10.0] * 20 + [0.0] * 20, [0.0] * 20 + [10.0] * 20 + [-5.0, 30.0] * 10
    dataset, longer = (dataset_of(recording(output, rng.normal(size=60))) for output in (early, whole))
    for effect in (*saturations(dataset), *soft_limits(dataset)):
        start = effect.starts[-1]
        known, further = (effect.position(d.data.held, start, d) for d in (dataset, longer))
        assert further.at(np.array([30.0])) == pytest.approx(known.at(np.array([30.0]))), effect.form


def test_stores_that_do_not_overflow_are_two_lags():
    """T1 20 s, T2 8 s: 1 - (20 e^{-t/20} - 8 e^{-t/8})/12 after a step."""
    rng = np.random.default_rng(2)
    dataset = dataset_of(recording([0.0] * 15 + [10.0] * 185, rng.normal(size=200)))
    effect = overflowing_stores(dataset)
    since = dataset.data.t
    view = View(dataset, since, 0.0, Pair(160.0, 28.0), HeldInput(np.array([0.0, 15.0]), np.array([0.0, 10.0])))
    after = np.maximum(since - 15.0, 0.0)
    exact = 10.0 * (1.0 - (20.0 * np.exp(-after / 20.0) - 8.0 * np.exp(-after / 8.0)) / 12.0)
    for slow_first in (0.0, 1.0):
        level = effect.response(view, (slow_first, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
        assert np.abs(level - exact).max() < 0.05


def test_a_store_stops_at_its_limit():
    rng = np.random.default_rng(2)
    dataset = dataset_of(recording([0.0] * 15 + [10.0] * 185, rng.normal(size=200)))
    view = View(
        dataset, dataset.data.t, 0.0, Pair(160.0, 28.0), HeldInput(np.array([0.0, 15.0]), np.array([0.0, 10.0]))
    )
    level = overflowing_stores(dataset).response(view, (1.0, 0.4, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert level.max() == pytest.approx(6.0, abs=0.01)  # the first store ends at 10 - 0.4 times the swing


def test_stores_of_any_shape_are_those_of_a_general_solver():
    """Both stores overflow: the levels over those at the middle flow of 55, where nothing flows at an output of 0."""
    rng = np.random.default_rng(2)
    output = [10.0] * 15 + [100.0] * 185 + [30.0] * 100
    dataset = dataset_of(recording(output, rng.normal(size=300)))
    first, second, share, p1, p2 = 1.5, 1.2, 0.6, 0.5, 0.8
    effect = shaped_stores(dataset, (1.0, 0.3, share, 0.3, 0.0, 0.0, 0.0))
    numbers = (1.0, math.log(first), share, math.log(second), p1, p2, math.log(10.0 / 90.0), 0.0, 0.0)
    seen = effect.response(View(dataset, dataset.data.t, 0.0, Pair(160.0, 28.0), dataset.data.held), numbers)

    def stores(t, h):
        f = (10.0 if t < 15.0 else 100.0 if t < 200.0 else 30.0) / 55.0
        full = h[0] >= first and f > first**p1
        spilled, out = (f - first**p1 if full else 0.0), min(h[0], first) ** p1
        rise = (out + share * spilled - h[1] ** p2) / (8.0 * p2)
        return [0.0 if full else (f - out) / (20.0 * p1), 0.0 if h[1] >= second and rise > 0.0 else rise]

    begin = [(10.0 / 55.0) ** (1.0 / p) for p in (p1, p2)]
    found = scipy.integrate.solve_ivp(stores, (0.0, 299.0), begin, t_eval=dataset.data.t, max_step=0.05, rtol=1e-6)
    assert seen == pytest.approx(55.0 * p2 * (found.y[1] - 1.0), abs=0.5)  # of 60 in all
    assert effect.sizes(numbers, (), 1.0)["no_flow_at"] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("motion", [Lag(20.0), Pair(160.0, 28.0)])
def test_a_loss_that_grows_with_the_square_ends_where_it_balances(motion):
    """w + b w^2 = v at rest; on the way there it is the walk from sample to sample."""
    rng = np.random.default_rng(2)
    dataset = dataset_of(recording([0.0] * 15 + [10.0] * 385, rng.normal(size=400)))
    view = View(dataset, dataset.data.t, 0.0, motion, dataset.data.held)
    response = with_loss(view, *excess(0.03, 2.0))
    assert response[-1] + 0.03 * response[-1] ** 2 == pytest.approx(10.0, rel=1e-4)
    assert response == pytest.approx(stepped(view, lambda _v, w: -0.03 * w * w), abs=0.02)


@pytest.mark.parametrize("slow_last", [True, False])
def test_a_loss_of_the_second_store_alone_is_that_of_a_general_solver(slow_last):
    rng = np.random.default_rng(2)
    dataset = dataset_of(recording([0.0] * 15 + [10.0] * 185 + [-6.0] * 100, rng.normal(size=300)))
    view = View(dataset, dataset.data.t, 3.0, Pair(160.0, 28.0), dataset.data.held)
    seen = with_loss_at_the_end(
        view, lambda w: -0.02 * w * w - 0.003 * w**3, lambda w: -0.04 * w - 0.009 * w * w, slow_last=slow_last
    )
    first, last = (8.0, 20.0) if slow_last else (20.0, 8.0)

    def stores(t, x):
        v = 0.0 if t < 18.0 else 10.0 if t < 203.0 else -6.0
        return [(v - x[0]) / first, (x[0] - x[1] - 0.02 * x[1] ** 2 - 0.003 * x[1] ** 3) / last]

    found = scipy.integrate.solve_ivp(stores, (0.0, 299.0), [0.0, 0.0], t_eval=dataset.data.t, max_step=0.5, rtol=1e-8)
    assert seen == pytest.approx(found.y[1], abs=0.01)


@pytest.mark.parametrize("slow_last", [True, False])
def test_a_loss_of_the_last_of_three_stores_is_that_of_a_general_solver(slow_last):
    rng = np.random.default_rng(2)
    dataset = dataset_of(recording([0.0] * 15 + [10.0] * 185 + [-6.0] * 100, rng.normal(size=300)))
    view = View(dataset, dataset.data.t, 3.0, PairAndLag(160.0, 28.0, 5.0), dataset.data.held)
    seen = with_loss_at_the_end(view, lambda w: -0.02 * w * w, lambda w: -0.04 * w, slow_last=slow_last)
    first, second, last = (5.0, 8.0, 20.0) if slow_last else (20.0, 8.0, 5.0)

    def stores(t, x):
        v = 0.0 if t < 18.0 else 10.0 if t < 203.0 else -6.0
        return [(v - x[0]) / first, (x[0] - x[1]) / second, (x[1] - x[2] - 0.02 * x[2] ** 2) / last]

    found = scipy.integrate.solve_ivp(stores, (0.0, 299.0), [0.0] * 3, t_eval=dataset.data.t, max_step=0.5, rtol=1e-8)
    assert seen == pytest.approx(found.y[2], abs=0.01)


def test_strong_radiation_is_that_of_a_general_solver_at_few_samples():
    """Every tenth second of a lag of 20 s that is three times as quick where it is hot."""
    rng = np.random.default_rng(2)
    dataset = dataset_of(recording([0.0] * 15 + [60.0] * 85 + [-18.0] * 200, rng.normal(size=300)))
    view = View(dataset, dataset.data.t[::10], 0.0, Lag(20.0), dataset.data.held)
    seen = with_loss(view, *excess(1.5 / 80.0, 4.0))  # (1 + w/80)^4

    def store(t, w):
        v = 0.0 if t < 15.0 else 60.0 if t < 100.0 else -18.0
        return [(v - 20.0 * ((1.0 + w[0] / 80.0) ** 4 - 1.0)) / 20.0]

    found = scipy.integrate.solve_ivp(store, (0.0, 299.0), [0.0], t_eval=view.t, max_step=0.5, rtol=1e-8)
    assert seen == pytest.approx(found.y[0], abs=0.15)  # of 65 in all


@pytest.mark.parametrize("power", [0.5, 2.0, 4.0])
def test_a_loss_ends_where_outflow_or_radiation_balances(power):
    """At rest h(w) = v: free outflow of L = 10: w = 10 ((1 + 10/20)^2 - 1); radiation of L = 100: (1 + w/L)^4 = 1.4."""
    level = {0.5: 10.0, 2.0: 50.0, 4.0: 100.0}[power]
    ends = {0.5: 12.5, 2.0: 50.0 * (math.sqrt(1.4) - 1.0), 4.0: 100.0 * (1.4**0.25 - 1.0)}[power]
    rng = np.random.default_rng(2)
    dataset = dataset_of(recording([0.0] * 15 + [10.0] * 585, rng.normal(size=600)))
    response = with_loss(
        View(dataset, dataset.data.t, 0.0, Lag(20.0), dataset.data.held), *excess((power - 1.0) / (2.0 * level), power)
    )
    assert response[-1] == pytest.approx(ends, rel=1e-4)


@pytest.mark.parametrize("motion", [Lag(20.0), Pair(0.02, 20.001)])
def test_a_process_of_two_speeds_rises_and_falls_by_its_own(motion):
    """Up 10 (1 - e^{-3 t/20}) for 30 s, then down as e^{-t/20}."""
    rng = np.random.default_rng(2)
    dataset = dataset_of(recording([0.0] * 10 + [10.0] * 30 + [0.0] * 60, rng.normal(size=100)))
    response = two_speeds(View(dataset, dataset.data.t, 0.0, motion, dataset.data.held), 3.0)
    rising = 10.0 * -np.expm1(-3.0 * np.arange(31.0) / 20.0)
    assert response[10:41] == pytest.approx(rising, abs=2e-3)
    assert response[40:] == pytest.approx(rising[-1] * np.exp(-np.arange(60.0) / 20.0), abs=2e-3)


def test_what_a_lag_makes_of_a_ramp():
    """d = 3 t behind a lag of 4 s: 3 (t - 4 (1 - e^{-t/4}))."""
    t = np.array([0.0, 0.5, 2.0, 2.5, 7.0])
    assert behind_a_lag(t, 5.0 + 3.0 * t, 4.0) == pytest.approx(3.0 * (t + 4.0 * np.expm1(-t / 4.0)))


def test_an_element_that_warms_and_cools_with_its_own_lags():
    element = lagged(HeldInput(np.array([0.0, 10.0, 30.0]), np.array([0.0, 8.0, 0.0])), 4.0, 9.0)
    up = 8.0 * -math.expm1(-20.0 / 4.0)
    after = np.array([14.0, 39.0])
    levels = element.levels[np.searchsorted(element.times, after, side="right") - 1]
    assert levels == pytest.approx([8.0 * -math.expm1(-1.0), up * math.exp(-1.0)], abs=0.2)


def test_a_wave_at_rest_is_no_noise():
    rng = np.random.default_rng(3)
    wave = 2.0 * np.sin(np.arange(60) / 4.0) + rng.normal(0.0, 0.1, 60)
    assert noise_at_rest(0.1, wave) == 0.1
    assert noise_at_rest(0.1, rng.normal(0.0, 0.15, 60)) == pytest.approx(0.15, rel=0.3)


@pytest.mark.parametrize(
    ("differences", "rest", "noise"), [(1.0, 0.1, 0.3), (1.0, 0.9, 1.0), (1.0, 3.0, 3.0), (1.0, 50.0, 6.0)]
)
def test_what_counts_as_noise(differences, rest, noise):
    assert one_noise(differences, rest) == pytest.approx(noise)


def test_the_end_of_a_sensors_range_is_seen():
    pv = np.minimum(5.0 + 6.0 * np.sin(np.arange(400) / 20.0) + np.random.default_rng(1).normal(0.0, 0.01, 400), 10.0)
    dataset = dataset_of(recording(np.arange(400) % 50, pv))
    assert dataset.top == pytest.approx(10.0 - dataset.pv0)
    assert math.isinf(dataset.bottom)
    assert not dataset.fitted[pv >= 10.0].any()
