"""Intervals of gains and sizes: noise with a slow part, and forms that the record does not rule out.

Judges are repeated draws of noise on closed forms of the response, in which nothing of the program takes part.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from autotuner.core.diagnosis.effects.actuator.textbook_forms import actuator_effects
from autotuner.core.diagnosis.effects.declared import lagged
from autotuner.core.diagnosis.effects.process.gain_in_time import gains_in_time
from autotuner.core.diagnosis.effects.process.nonlinear_losses import losses
from autotuner.core.diagnosis.extended.fit_context import bench_of
from autotuner.core.diagnosis.extended.fitting import fit, tangent
from autotuner.core.diagnosis.extended.intervals import averaged, effect_intervals, process_covariance
from autotuner.core.diagnosis.record.dataset import dataset_of
from autotuner.core.diagnosis.search.neighbours import neighbours
from autotuner.core.diagnosis.search.simplify import with_best_moment
from autotuner.core.estimation.noise.slow_part import remembered, slow_part
from autotuner.core.model.step_responses import Lag
from autotuner.core.model.structures import SECOND_ORDER
from autotuner.core.model.zoh_input import HeldInput
from autotuner.core.recording import Recording
from tests.diagnosis.simulated import LAG, PAIR, at_the_truth, moves, of_form

DRAWS, MOST = 20, 4
"""Of 20 intervals of 95 % more than 4 miss once in 400 times."""
SHORT = np.repeat([0.0, 10.0, -4.0], (30, 90, 120))
"""A record with two moves, after which the PV rests."""


def in_series(u, K, lags, D):
    """Return the response of different lags to outputs that are held for a second: partial fractions."""
    t, pv = np.arange(u.size, dtype=float), np.zeros(u.size)
    shares = [T ** (len(lags) - 1) / math.prod(T - other for other in lags if other != T) for T in lags]
    for k in np.flatnonzero(np.diff(u, prepend=0.0)):
        since = np.maximum(t - k - D, 0.0)
        rest = sum(share * np.exp(-since / T) for share, T in zip(shares, lags, strict=True))
        pv += K * (u[k] - (u[k - 1] if k else 0.0)) * (1.0 - rest)
    return pv


def measured(u, pv, sigma, seed):
    return Recording(np.arange(u.size, dtype=float), u, pv + np.random.default_rng(seed).normal(0.0, sigma, u.size))


def refitted(recording, plant, *effects):
    """Return the context of a record, and the plant's structure with effects fitted to it, from the plant's numbers."""
    start = at_the_truth(recording, plant, *effects)
    context = bench_of(start.problem.dataset)
    return context, fit(replace(start.problem, rows=context.fine), start.theta, 40)


def half_width(context, fitted, others=()):
    return 1.96 * math.sqrt(process_covariance(context, fitted, others)[0, 0])


@pytest.mark.parametrize("slow", [0.0, 0.05])
def test_the_gain_is_held_beside_a_slow_part_of_the_noise_and_no_wider_without(slow):
    """A quarter of the noise's variance with a memory of 20 samples: errors of white noise miss every third gain."""
    u = moves(600, hold=150)
    pv, missed, wider = in_series(u, PAIR.K, (PAIR.T1, PAIR.T2), PAIR.D), 0, []
    for seed in range(DRAWS):
        innovations = np.random.default_rng(seed + 500).normal(0.0, slow, u.size)
        memory = np.convolve(innovations, math.sqrt(1.0 - 0.95**2) * 0.95 ** np.arange(200))[: u.size]
        context, found = refitted(measured(u, pv + memory, 0.1, seed), PAIR)
        half = half_width(context, found)
        missed += abs(found.process().K - PAIR.K) > half
        columns, slopes = tangent(found.problem, found.theta)
        J = np.hstack((slopes, columns))
        white = found.rms * math.sqrt(np.linalg.inv(J.T @ J)[slopes.shape[1], slopes.shape[1]])
        wider.append(half / (1.96 * white))
    assert missed <= MOST
    assert np.median(wider) < 1.05 if slow == 0.0 else np.median(wider) > 1.5


@pytest.mark.parametrize(("lags", "sigma"), [((20.0, 10.0, 4.0), 0.1), ((15.0, 10.0, 6.0), 0.05)])
def test_the_gain_of_three_lags_is_held_by_two_and_what_a_third_one_leaves_open(lags, sigma):
    pv = in_series(SHORT, 2.0, lags, 3.0)
    alone = together = 0
    for seed in range(DRAWS):
        context, found = refitted(measured(SHORT, pv, sigma, seed), PAIR)
        off = abs(found.process().K - 2.0)
        alone += off > half_width(context, found)
        together += off > half_width(context, found, neighbours(context, found))
    assert alone > MOST
    assert together <= MOST


def test_a_third_lag_opens_nothing_where_there_are_two():
    pv, wider = in_series(SHORT, PAIR.K, (PAIR.T1, PAIR.T2), PAIR.D), []
    for seed in range(DRAWS):
        context, found = refitted(measured(SHORT, pv, 0.1, seed), PAIR)
        wider.append(half_width(context, found, neighbours(context, found)) / half_width(context, found))
    assert np.median(wider) == 1.0
    assert np.mean(wider) < 1.1


def test_the_slope_of_a_curve_at_rest_is_held_by_a_cubic_and_its_next_term():
    """The curve is `12 tanh(u/12)`, whose slope at rest is 1."""
    u = np.repeat([0.0, *np.random.default_rng(7).uniform(-14.0, 14.0, 19)], 15)
    pv, alone, together = in_series(12.0 * np.tanh(u / 12.0), LAG.K, (LAG.T,), LAG.D), 0, 0
    for seed in range(DRAWS):
        recording = measured(u, pv, 0.1, seed)
        curve = of_form(actuator_effects(dataset_of(recording), [], {}), "static_nonlinearity:cubic")
        context, found = refitted(recording, LAG, (curve, ()))
        off = abs(found.process().K - LAG.K)
        alone += off > half_width(context, found)
        together += off > half_width(context, found, neighbours(context, found))
    assert alone > MOST
    assert together <= MOST


def test_the_slope_of_a_curve_at_rest_is_held_where_limits_come_as_near():
    """Five levels on `12 tanh(u/12)`: a cubic meets each of them, and so do limits, with another slope at rest."""
    u = np.repeat(np.random.default_rng(7).choice([-14.0, -7.0, 0.0, 7.0, 14.0], 20), 15)
    u[:15] = 0.0
    recording = measured(u, in_series(12.0 * np.tanh(u / 12.0), LAG.K, (LAG.T,), LAG.D), 0.1, 1)
    curve = of_form(actuator_effects(dataset_of(recording), [], {}), "static_nonlinearity:cubic")
    limits = of_form(actuator_effects(dataset_of(recording), [], {}), "saturation:both")
    context, found = refitted(recording, LAG, (curve, ()))
    pair = replace(found.problem, structure=SECOND_ORDER, effects=(limits,), rows=context.fine)
    # With a second lag, which an answer of one lag does not need: the odds are those of the forms alone.
    theta = np.concatenate((found.theta[:1], found.theta[:1] - 3.0, found.theta[1:2], limits.starts[0]))
    other = fit(pair, theta, 40)
    off = abs(found.process().K - LAG.K)
    assert other.rms < 1.05 * found.rms
    assert half_width(context, found) < off < half_width(context, found, neighbours(context, found, (other,)))


def test_the_next_term_of_a_loss_leaves_its_sizes_open():
    u = moves()
    recording = measured(u, in_series(u, LAG.K, (LAG.T,), LAG.D), 0.01, 1)
    loss = of_form(losses(dataset_of(recording), at_the_truth(recording, LAG)), "nonlinear_loss:cubic")
    context, found = refitted(recording, LAG, (loss, (0.1, 0.1)))
    (richer,) = (fit(replace(found.problem, effects=loss.next_terms), np.append(found.theta, 0.0), 0),)
    assert richer.residual == pytest.approx(found.residual, abs=1e-9)
    (plain,), (wide,) = (effect_intervals(context, found, o) for o in ((), ((0.5, found), (0.5, richer))))
    assert wide["cubic_per_pv2"][1] > plain["cubic_per_pv2"][1]


def test_an_average_of_intervals_has_their_widths_and_their_distance():
    assert averaged(1.0, [(1.0, 1.0, (0.5, 2.0))]) == pytest.approx((0.5, 2.0))
    low, high = averaged(1.0, [(0.5, 1.0, (0.0, 2.0)), (0.5, 3.0, (2.0, 4.0))])
    assert high - 1.0 == pytest.approx(1.0 - low)
    assert high - 1.0 == pytest.approx(math.sqrt(1.0 + 0.5 * (1.96 * 2.0) ** 2), rel=1e-3)


def test_the_memory_of_columns_is_a_product_with_its_matrix():
    x = np.random.default_rng(3).normal(size=(40, 2))
    k = np.arange(40)
    assert remembered(x, 0.8) == pytest.approx(0.8 ** np.abs(k[:, None] - k) @ x)


def test_a_slow_part_is_found_where_it_is_and_with_its_size():
    innovations = np.random.default_rng(5).normal(size=4200)
    slow = np.convolve(innovations, math.sqrt(1.0 - 0.9**2) * 0.9 ** np.arange(200))[200:4200]
    white = np.random.default_rng(6).normal(0.0, 2.0, slow.size)
    ones = np.ones((slow.size, 1))
    assert slow_part(white, ones).ratio == 0.0
    found = slow_part(slow + white, ones)
    assert found.variance == pytest.approx(4.0, rel=0.1)
    assert found.ratio * found.variance == pytest.approx(1.0, rel=0.5)


def test_a_jump_of_the_gain_is_found_across_a_move_of_the_output():
    """From 20 s later, behind a move, a fit stays there: the misfit has a minimum on either side of it."""
    u = np.repeat([0.0, 8.0, -4.0, 6.0, -8.0], 80)
    late = np.where(np.arange(u.size) < 230, 0.0, u)
    pv = in_series(u, LAG.K, (LAG.T,), LAG.D) + 0.4 * in_series(late, LAG.K, (LAG.T,), LAG.D)
    recording = measured(u, pv, 0.05, 2)
    jump = of_form(gains_in_time(dataset_of(recording)), "gain_drift:jump")
    context, found = refitted(recording, LAG, (jump, (250.0 / 399.0,)))
    arrives_s = 230.0 + LAG.D
    assert abs(found.sizes()[0]["at_s"] - arrives_s) > 5.0
    assert with_best_moment(context, found).sizes()[0]["at_s"] == pytest.approx(arrives_s, abs=0.5)


def test_a_lag_of_the_actuator_is_as_exact_as_the_records_need():
    """Two lags in series, in closed form; a change of direction before the first has arrived."""
    held = HeldInput(np.array([0.0, 0.0, 30.0]), np.array([0.0, 1.0, -1.0]))
    t = np.arange(1.0, 30.0)
    exact = 1.0 - (12.0 * np.exp(-t / 12.0) - 8.0 * np.exp(-t / 8.0)) / 4.0
    answer = Lag(8.0).forced(lagged(held, 12.0, 5.0), t)[0][0]
    assert answer == pytest.approx(exact, abs=3e-4)
    late, reached = np.arange(30.0, 90.0), 1.0 - math.exp(-30.0 / 12.0)
    since, before = late - 30.0, 1.0 - (12.0 * math.exp(-30.0 / 12.0) - 8.0 * math.exp(-30.0 / 8.0)) / 4.0
    falls = 5.0 * (reached + 1.0) * (np.exp(-since / 5.0) - np.exp(-since / 8.0)) / (5.0 - 8.0)
    exact = -1.0 + (before + 1.0) * np.exp(-since / 8.0) + falls
    assert Lag(8.0).forced(lagged(held, 12.0, 5.0), late)[0][0] == pytest.approx(exact, abs=2.5e-3)
