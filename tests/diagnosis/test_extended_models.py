"""Extended models: their columns, fits, intervals and criterion, and the starts of actuator effects from a residual.

Judges are plain least squares, closed forms, repeated draws of noise, and the simulator's settings.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy
from hypothesis import given, settings
from hypothesis import strategies as st

from autotuner.core.diagnosis.effects import catalogue
from autotuner.core.diagnosis.effects.actuator.levels import origin_of, step_grids
from autotuner.core.diagnosis.effects.actuator.position_in_loop import update_grids_in_loop
from autotuner.core.diagnosis.effects.actuator.saturation import saturations
from autotuner.core.diagnosis.effects.actuator.textbook_forms import quantisation, updated_every
from autotuner.core.diagnosis.effects.actuator.update_jitter import latenesses, one_later, spread_of, update_grids
from autotuner.core.diagnosis.effects.disturbance import disturbance_effects
from autotuner.core.diagnosis.effects.process.textbook_forms import process_effects
from autotuner.core.diagnosis.extended.base import base_of, is_physical
from autotuner.core.diagnosis.extended.coloured_noise import coloured_noise
from autotuner.core.diagnosis.extended.extended_model import without_rounding
from autotuner.core.diagnosis.extended.fit_context import bench_of, spread, thinned
from autotuner.core.diagnosis.extended.fitting import fit, linearised, tangent
from autotuner.core.diagnosis.extended.intervals import covariance, effect_intervals, process_covariance, whole_gain
from autotuner.core.diagnosis.extended.left_open_later import error_left_open
from autotuner.core.diagnosis.extended.repair import without_gaps
from autotuner.core.diagnosis.findings.sensor_effects import fitted_to_intervals
from autotuner.core.diagnosis.record.dataset import dataset_of
from autotuner.core.diagnosis.record.sensor import Grid
from autotuner.core.diagnosis.search.screen import KEPT, Span, screened, tangent_of
from autotuner.core.diagnosis.search.search import sketched
from autotuner.core.recording import Recording
from autotuner_sim import ActuatorHold, Fopdt, LoadStep, OutputQuantisation, Saturation
from tests.diagnosis.simulated import (
    INTEGRATOR,
    LAG,
    OUTPUT0,
    PAIR,
    RINGING,
    at_the_truth,
    left,
    moves,
    of_form,
    record,
)

SPAN_S = 299.0


def noisy(recording, sigma, seed=1):
    noise = np.random.default_rng(seed).normal(0.0, sigma, recording.pv.size)
    return Recording(recording.t, recording.output, recording.pv + noise, settings=recording.settings)


def load_of(dataset):
    return of_form(disturbance_effects(dataset, [dataset.data.pv], []), "load_step")


def fitted_rows(fitted):
    """Return the same model on the fitted part of its record."""
    rows = np.flatnonzero(fitted.problem.dataset.fitted)
    return fit(replace(fitted.problem, rows=rows), fitted.theta, 0)


@pytest.mark.parametrize("plant", [LAG, PAIR, RINGING, INTEGRATOR])
def test_a_search_from_other_numbers_comes_to_the_simulators(plant):
    recording = record(plant, moves())
    truth = at_the_truth(recording, plant)
    found = fit(truth.problem, truth.theta + 0.3, 40, 1e-14)
    assert found.theta == pytest.approx(truth.theta, abs=1e-4)
    assert left(found) < 1e-5


def test_a_search_finds_an_effect_beside_the_process():
    recording = record(PAIR, moves(), loads=[LoadStep(100.0, 3.0)])
    truth = at_the_truth(recording, PAIR, (load_of(dataset_of(recording)), (100.0 / SPAN_S,)))
    found = fit(truth.problem, truth.theta + np.array([0.1, -0.1, 0.1, 0.01]), 40, 1e-14)
    assert found.sizes()[0] == pytest.approx({"at_s": 100.0, "size": 3.0}, rel=1e-3)
    assert found.process().parameters() == pytest.approx(truth.process().parameters(), rel=1e-3)


@pytest.mark.parametrize("plant", [LAG, PAIR, RINGING, INTEGRATOR])
def test_slopes_are_differences_of_the_simulation(plant):
    """With no arrival at a sample, where the response of a lag has two slopes."""
    plant = replace(plant, D=plant.D + 0.3)
    fitted = at_the_truth(record(plant, moves()), plant)
    columns, slopes = tangent(fitted.problem, fitted.theta)
    rows = fitted.problem.rows
    for k in range(fitted.theta.size):
        by = 1e-5 * np.eye(fitted.theta.size)[k]
        there, back = (fitted.problem.columns(fitted.theta + s * by, rows)[0] for s in (1.0, -1.0))
        exact = (there - back) @ fitted.linear / 2e-5
        assert slopes[:, k] == pytest.approx(exact, abs=1e-3 * float(np.abs(exact).max()))
    assert columns @ fitted.linear == pytest.approx(fitted.problem.dataset.data.pv, abs=1e-6)


def test_a_search_stays_within_its_bounds():
    recording = record(LAG, moves(), actuators=[Saturation(0.0, 44.0)])
    effect = of_form(saturations(dataset_of(recording)), "saturation:high")
    problem = at_the_truth(recording, LAG, (effect, (0.25,))).problem
    found = fit(problem, np.array([50.0, -9.0, 7.0]), 3)
    low, high = ([getattr(s, end) for s in problem.searched] for end in ("low", "high"))
    assert np.all(found.theta >= low)
    assert np.all(found.theta <= high)


def test_a_simulation_ends_at_the_range_of_the_sensor():
    fitted = at_the_truth(record(LAG, moves()), LAG)
    pv = fitted.problem.dataset.data.pv
    limited = replace(fitted, problem=replace(fitted.problem, dataset=replace(fitted.problem.dataset, top=5.0)))
    assert limited.simulated(fitted.problem.rows) == pytest.approx(np.minimum(pv, 5.0), abs=1e-9)


def test_a_score_along_the_tangent_is_that_of_a_plain_least_squares():
    recording = noisy(record(PAIR, moves()), 0.1)
    fitted = at_the_truth(recording, PAIR)
    theta = fitted.theta + np.array([0.05, 0.1, -0.2])
    moved = fit(fitted.problem, theta, 0)
    columns, slopes = tangent(fitted.problem, theta)
    both = np.hstack((columns, slopes))
    pv = fitted.problem.dataset.data.pv
    best = pv - both @ np.linalg.lstsq(both, pv, rcond=None)[0]
    assert linearised(fitted.problem, theta) == pytest.approx(float(best @ best) / pv.size)
    assert linearised(fitted.problem, theta) < moved.mean_square


@pytest.mark.parametrize("key", ["saturation:high", "dead_time_jump", "nonlinear_loss", "load_step"])
def test_scores_of_all_starts_are_those_of_a_plain_least_squares_each(key):
    context = bench_of(dataset_of(noisy(record(PAIR, moves(), actuators=[Saturation(0.0, 44.0)]), 0.1)))
    base = at_the_truth(noisy(record(PAIR, moves()), 0.1), PAIR, dataset=context.dataset)
    effect = of_form(catalogue(base, context.coarse), key)
    starts, _ = screened(context, [tangent_of(context, base)], effect)
    _, slopes = tangent(replace(base.problem, rows=context.screen), base.theta)
    answer = base.problem.columns(base.theta, context.screen)[0][:, :1]
    pv = context.dataset.data.pv[context.screen]
    assert len(starts) == KEPT
    for start in starts:
        columns = np.hstack((start.problem.columns(start.theta, context.screen)[0], slopes, answer))
        best = np.mean((pv - columns @ np.linalg.lstsq(columns, pv, rcond=1e-12)[0]) ** 2)
        assert start.at_any_strength == pytest.approx(best)


def test_a_column_that_depends_on_others_does_not_count():
    random = np.random.default_rng(4)
    pv, shared, first, second = random.normal(size=(4, 50))
    span = Span.of(np.column_stack((shared, np.ones(50))), pv)
    columns = np.array([[first, second], [first, first + 3.0 * shared], [2.0 * shared - 1.0, 0.0 * shared]])
    plain = [(shared, np.ones(50), *of) for of in ((first, second), (first,), ())]
    left = [np.mean((pv - A @ np.linalg.lstsq(A, pv, rcond=None)[0]) ** 2) for A in map(np.column_stack, plain)]
    assert span.mean_squares(columns) == pytest.approx(left)


@settings(max_examples=60)
@given(st.permutations(range(6)))
def test_an_order_does_not_depend_on_rounding(order):
    """Values that differ by a few roundings are the same; the tie decides."""
    values = [1.0, 1.0 + 1e-9, 1.0 - 1e-9, 2.0, 2.0 + 1e-9, math.nan]
    ranked = without_rounding(order, values.__getitem__, lambda k: (-k,))
    assert ranked == [2, 1, 0, 4, 3, 5]


def test_a_criterion_is_schwarzs():
    """n ln S + p (ln n + c) + 2 price: by differences, in which the penalty for the number of forms falls out."""
    recording = noisy(record(PAIR, moves()), 0.1)
    context = bench_of(dataset_of(recording))
    alone = fitted_rows(at_the_truth(recording, PAIR))
    larger = fitted_rows(at_the_truth(recording, PAIR, (load_of(context.dataset), (0.4,))))
    n = alone.residual.size
    same = replace(larger, residual=alone.residual)  # as good, with two numbers and a price more
    more = context.criterion(same, 1.0) - context.criterion(alone, 1.0)
    half = context.criterion(same, 2.0) - context.criterion(alone, 2.0)
    assert same.size - alone.size == 2
    assert more - half == pytest.approx(2.0 * math.log(2.0))
    assert more > 2.0 * math.log(n) + 2.0 * larger.price
    worse = replace(alone, residual=2.0 * alone.residual)
    floor = context.dataset.floor**2
    fall = math.log((4.0 * alone.mean_square + floor) / (alone.mean_square + floor))
    assert context.criterion(worse, 1.0) - context.criterion(alone, 1.0) == pytest.approx(n * fall)


@settings(max_examples=40)
@given(st.integers(1, 5000), st.integers(2, 600))
def test_thinned_samples_are_even_and_keep_both_ends(count, most):
    rows = np.arange(count) * 3
    picked = thinned(rows, most)
    assert picked.size == min(count, most)
    assert (picked[0], picked[-1]) == (0, rows[-1])
    assert np.ptp(np.diff(picked)) <= 3 if picked.size > 1 else True


def test_of_a_long_record_half_of_the_samples_follow_moves():
    output = np.where(np.arange(6000) % 1500 < 750, 0.0, 5.0)
    dataset = dataset_of(Recording(np.arange(6000.0), output, np.random.default_rng(1).normal(size=6000)))
    rows = np.flatnonzero(dataset.fitted)
    picked = spread(dataset, rows, 250)
    for at in dataset.data.held.times[1:]:
        if at < rows[-1] - 15:
            assert set(range(int(at), int(at) + 15)) <= set(picked.tolist())
    assert picked.size <= 250
    assert np.diff(picked).max() < 60


def test_a_covariance_of_sizes_is_that_of_a_plain_least_squares():
    """At a process that is held, with white noise: s^2 (X'X)^-1."""
    recording = noisy(record(PAIR, moves(), loads=[LoadStep(100.0, 3.0)]), 0.1, 3)
    whole = at_the_truth(recording, PAIR)
    theta = tuple(whole.theta.tolist())
    rows = np.flatnonzero(whole.problem.dataset.fitted)
    held = fit(replace(whole.problem, rows=rows, fixed=theta), whole.theta, 0)
    context = bench_of(held.problem.dataset)
    context = replace(context, held_out=rows)  # as large there as on the fitted part
    X, _ = held.problem.columns(held.theta, rows)
    square = float(held.residual @ held.residual) / (rows.size - X.shape[1])
    exact = square * context.colour(held) * np.linalg.inv(X.T @ X)
    cov = covariance(context, held)
    assert cov[3:, 3:] == pytest.approx(exact, rel=1e-6)
    assert not cov[:3].any()


def test_intervals_cover_the_simulators_sizes_as_often_as_they_say():
    """Of 40 draws of noise at most 6 of the intervals of 95 % may miss: more come once in 300 times."""
    alone = record(PAIR, moves(), loads=[LoadStep(100.0, 3.0)])
    missed = {"size": 0, "at_s": 0, "K": 0}
    effect = load_of(dataset_of(alone))
    for seed in range(40):
        recording = noisy(alone, 0.15, seed)
        truth = at_the_truth(recording, PAIR, (effect, (100.0 / SPAN_S,)))
        context = bench_of(truth.problem.dataset)
        found = fit(replace(truth.problem, rows=context.fine), truth.theta, 4)
        (ends,) = effect_intervals(context, found)
        for name, value in (("size", 3.0), ("at_s", 100.0)):
            missed[name] += not ends[name][0] <= value <= ends[name][1]
        cov = process_covariance(context, found)
        missed["K"] += abs(found.process().parameters()["K"] - PAIR.K) > 1.96 * math.sqrt(cov[0, 0])
    assert max(missed.values()) <= 6
    assert sum(missed.values()) >= 1  # of 120


def test_intervals_of_the_gain_hold_beside_a_slow_part_that_hides_in_the_noise():
    """A tenth of the noise's variance with a memory of 50 samples: of 40 intervals at most 6 may miss, as above."""
    alone = record(PAIR, moves(600, hold=40))
    missed = 0
    for seed in range(40):
        recording = noisy(alone, 0.1, seed)
        slow = autoregressive(0.03, 0.98, recording.pv.size, seed + 100)
        truth = at_the_truth(Recording(recording.t, recording.output, recording.pv + slow), PAIR)
        context = bench_of(truth.problem.dataset)
        found = fit(replace(truth.problem, rows=context.fine), truth.theta, 6)
        half = 1.96 * math.sqrt(process_covariance(context, found)[0, 0])
        missed += abs(found.process().K - PAIR.K) > half
    assert missed <= 6


def test_the_gain_beside_a_slow_mode_is_that_of_both_with_its_interval():
    """Of 20 draws of noise at most 4 may miss the sum of the two simulators' gains; none holds the process's alone."""
    u, slow = moves(), Fopdt(0.9, 90.0, LAG.D)
    fast = record(LAG, u)
    alone = Recording(fast.t, fast.output, fast.pv + record(slow, u).pv)
    mode = of_form(process_effects(dataset_of(alone), at_the_truth(alone, LAG)), "slow_mode")
    missed = 0
    for seed in range(20):
        recording = noisy(alone, 0.1, seed)
        truth = at_the_truth(recording, LAG, (mode, (math.log(90.0),)))
        context = bench_of(truth.problem.dataset)
        found = fit(replace(truth.problem, rows=context.fine), truth.theta, 6)
        K, (low, high) = whole_gain(context, found)
        assert pytest.approx((low + high) / 2.0) == K
        assert low > LAG.K
        missed += not low <= LAG.K + slow.K <= high
    assert missed <= 4
    assert whole_gain(context, at_the_truth(recording, LAG)) is None


def test_a_blurred_size_is_wider_by_its_blur():
    recording = noisy(record(LAG, moves(), actuators=[OutputQuantisation(3.0)]), 0.05)
    effect = quantisation(dataset_of(recording), "from the rest", [])
    sharp = replace(effect, blur=None, searched=tuple(replace(s, profiled=False) for s in effect.searched))
    wide = replace(sharp, blur=effect.blur)
    widths = []
    for one in (sharp, wide):
        found = fitted_rows(at_the_truth(recording, LAG, (one, (3.0 / 16.0, 0.0))))
        low, high = effect_intervals(bench_of(found.problem.dataset), found)[0]["step"]
        widths.append(high - low)
    assert widths[1] - widths[0] == pytest.approx(2.0 * 0.25 * (3.0 / 16.0) ** 2 * 16.0)


def test_the_gain_beside_steps_of_the_actuator_is_as_open_as_the_steps():
    """Steps that round all levels alike leave the same position but for a factor, which the gain takes up."""
    recording = noisy(record(LAG, moves(seed=5), actuators=[OutputQuantisation(3.0)]), 0.02)
    effect = replace(quantisation(dataset_of(recording), "from the rest", []), blur=None)
    step = 2.9 / 16.0
    found = fitted_rows(at_the_truth(recording, LAG, (effect, (step, 0.0))))
    context = bench_of(found.problem.dataset)
    low, high = effect_intervals(context, found)[0]["step"]
    levels = np.unique(np.round(found.problem.dataset.data.held.levels, 9))
    tried = np.linspace(1.5, 6.0, 200_001)
    alike = tried[(np.round(levels[:, None] / tried) == np.round(levels / 2.9)[:, None]).all(axis=0)]
    assert (low, high) == pytest.approx((alike.min(), alike.max()), rel=5e-3)
    half = 1.96 * math.sqrt(process_covariance(context, found)[0, 0])
    widest = max(2.9 / alike.min() - 1.0, 1.0 - 2.9 / alike.max())
    assert half / found.process().K == pytest.approx(widest, rel=0.05)
    assert abs(found.process().K - LAG.K) < half


def test_a_coarse_sensor_leaves_its_error_in_the_intervals():
    """Within the readings' steps nothing is left; the gain is known as from a noise of step/sqrt(12)."""
    grid = Grid(0.5, 0.25, rounded=True)
    whole = record(LAG, moves())
    coarse = Recording(whole.t, whole.output, grid.step * np.round(whole.pv / grid.step))
    found = fitted_rows(at_the_truth(coarse, LAG))
    context = bench_of(found.problem.dataset)
    within = fitted_to_intervals(context, found, grid)
    assert within.rms < 0.1 * grid.step
    white = fitted_rows(at_the_truth(noisy(whole, grid.step / math.sqrt(12.0), 3), LAG))
    plain, rounded = (
        math.sqrt(process_covariance(bench_of(f.problem.dataset) if c is None else c, f)[0, 0])
        for c, f in ((None, white), (context, within))
    )
    assert plain / 1.5 < rounded < 3.0 * plain  # errors of rounding are alike where the PV stands


def test_moves_of_unknown_lateness_leave_their_slopes():
    """One move of 10 at 60 s: e(t) = s K 10 e^{-t/T}/T from then on."""
    u = np.where(np.arange(300) < 60, 0.0, 10.0)
    recording = record(LAG, u)
    effect = updated_every(dataset_of(recording), [])
    fitted = at_the_truth(recording, LAG, (effect, (math.log(4.0), 0.0)))
    rows = np.arange(50, 200)
    since = rows - fitted.problem.view(fitted.theta, rows).position.times[1] - LAG.D
    error = np.where(since > 0.0, 4.0 / math.sqrt(12.0) * LAG.K * 10.0 * np.exp(-since / LAG.T) / LAG.T, 0.0)
    found = error_left_open(fitted, fitted.problem.dataset, rows, 50.0, tested=True)
    assert found == pytest.approx(float(np.sqrt(np.mean(error**2))), rel=1e-6)
    assert error_left_open(fitted, fitted.problem.dataset, rows, 50.0) == 0.0
    assert error_left_open(fitted, fitted.problem.dataset, rows, 70.0, tested=True) == 0.0


def autoregressive(sigma, a, count, seed):
    random, x, values = np.random.default_rng(seed), 0.0, []
    for _ in range(count):
        x = a * x + sigma * math.sqrt(1.0 - a * a) * random.standard_normal()
        values.append(x)
    return np.array(values)


def with_residual(residual, output=None):
    alone = record(PAIR, moves(600) if output is None else output)
    recording = Recording(alone.t, alone.output, alone.pv + residual)
    fitted = fitted_rows(at_the_truth(recording, PAIR))
    return bench_of(fitted.problem.dataset), fitted


@pytest.mark.parametrize("a", [0.5, 0.8])
def test_an_unmeasured_noise_with_memory_has_its_innovations(a):
    """Of a first-order one of standard deviation s: s sqrt(1 - a^2)."""
    found = coloured_noise(*with_residual(autoregressive(0.2, a, 600, 4)))
    assert found.noise == pytest.approx(0.2, rel=0.2)
    assert found.fitted == pytest.approx(0.2 * math.sqrt(1.0 - a * a), rel=0.1)
    assert found.selection == pytest.approx(found.fitted, rel=0.25)


@pytest.mark.parametrize(
    "residual",
    [
        autoregressive(0.2, 0.98, 600, 4),  # a memory longer than the process's own
        autoregressive(0.2, 0.5, 600, 4) * np.where(np.arange(600) < 300, 0.2, 2.0),  # larger later on
        0.2 * np.roll(moves(600), 4) / 8.0 + autoregressive(0.05, 0.5, 600, 4),  # of past outputs
        autoregressive(4.0, 0.5, 600, 4),  # as large as the motion
    ],
)
def test_a_residual_that_a_process_leaves_is_no_noise(residual):
    assert coloured_noise(*with_residual(residual)) is None


def test_a_load_of_many_small_ones_is_noise_and_a_switched_one_is_not():
    """Both have passed a lag of 30 s, as long as the process's own: only of the first are the innovations normal."""
    random = np.random.default_rng(11)
    normal, switched = random.standard_normal(600), 3.0 * (random.random(600) < 0.03) * random.choice([-1.0, 1.0], 600)
    found = []
    for innovations in (normal, switched):
        load = scipy.signal.lfilter([1.0], [1.0, -math.exp(-1.0 / 30.0)], innovations)
        found.append(coloured_noise(*with_residual(0.15 * load / float(np.std(load)))))
    assert found[0].noise == pytest.approx(0.15, rel=0.3)
    assert found[1] is None


@pytest.mark.parametrize("share", [0.0, 0.04])
def test_noise_that_follows_the_output_is_no_noise(share):
    """A dither of the output has no memory: what follows it by a sample has none either, in every part."""
    dither = 2.0 * np.random.default_rng(3).choice([-1.0, 1.0], 600)
    dither[:15] = 0.0
    residual = autoregressive(0.1, 0.6, 600, 4) + share * np.roll(dither, 1)
    found = coloured_noise(*with_residual(residual, moves(600) + dither))
    assert (found is None) == (share > 0.0)


@pytest.mark.parametrize("step", [2.2, 3.0])
def test_the_likeliest_steps_are_the_simulators(step):
    """From 24 levels of the output and a residual with noise."""
    random = np.random.default_rng(5)
    u = np.repeat(np.round(random.uniform(-8.0, 8.0, 24), 1), 12)
    u[:12] = 0.0
    recording = noisy(record(LAG, u, actuators=[OutputQuantisation(step)]), 0.02)
    base = fitted_rows(at_the_truth(recording, LAG))
    found = step_grids(base, base.problem.rows)["from the rest"]
    swing = base.problem.dataset.swing
    assert min(abs(size * swing - step) for size, _ in found) < 0.06
    assert all(origin == 0.0 for _, origin in found)


@pytest.mark.parametrize("period_s", [2.7, 3.7, 5.3, 6.7])
@pytest.mark.parametrize("seed", [2, 3])
def test_the_likeliest_updates_are_the_simulators(period_s, seed):
    """Moves at uneven times after a rest, with the dead time in which half of a period is taken up."""
    random = np.random.default_rng(seed)
    u = np.repeat(random.uniform(-8.0, 8.0, 30), random.integers(7, 16, 30))
    u[:10] = 0.0
    recording = record(LAG, u, actuators=[ActuatorHold(period_s)], actuator_scan_s=0.1)
    late = Fopdt(LAG.K, LAG.T, LAG.D + period_s / 2.0)
    base = fitted_rows(at_the_truth(recording, late))
    found = update_grids(base, base.problem.rows)
    period, phase = min(found, key=lambda grid: abs(grid[0] - period_s))
    assert period == pytest.approx(period_s, abs=0.01)
    assert min(phase, 1.0 - phase) < 0.15  # the simulator's updates begin with the record


def loop_record(actuator, count=600, **physics):
    """Return a record whose output moves at every sample."""
    random = np.random.default_rng(6)
    u = 6.0 * np.sin(np.arange(count) / 9.0) + random.normal(0.0, 2.0, count)
    u[0] = 0.0
    return record(LAG, u, actuators=[actuator], **physics)


@pytest.mark.parametrize("period_s", [4.3, 6.0])
def test_updates_in_a_loop_are_the_simulators(period_s):
    recording = loop_record(ActuatorHold(period_s), actuator_scan_s=0.1)
    base = fitted_rows(at_the_truth(recording, Fopdt(LAG.K, LAG.T, LAG.D + period_s / 2.0)))
    found = update_grids_in_loop(base)
    assert found[0][0] == pytest.approx(period_s, rel=0.01)


@settings(max_examples=50)
@given(st.floats(0.01, 2.0), st.floats(-5.0, 5.0))
def test_an_origin_puts_a_level_on_the_grid(step, zero):
    (origin,) = origin_of(np.array([step]), zero)
    assert -0.5 <= origin <= 0.5
    levels = (zero / step - origin) % 1.0
    assert min(levels, 1.0 - levels) < 1e-6


@settings(max_examples=50)
@given(
    st.lists(st.tuples(st.floats(-3.0, 3.0), st.floats(1.0, 10.0)), min_size=2, max_size=12),
    st.floats(-20.0, 20.0),
)
def test_latenesses_do_not_depend_on_a_common_shift(pairs, shift):
    """Their mean is that of a uniform distribution from 0 with their spread, weighted by the squares of the moves."""
    p, steps = np.array(pairs).T
    late = latenesses(p, steps)
    assert latenesses(p + shift, steps) == pytest.approx(late, abs=1e-5)
    mean = float(np.average(late, weights=steps**2))
    spread_there = math.sqrt(float(np.average((late - mean) ** 2, weights=steps**2)))
    assert spread_of(p, steps) == pytest.approx(spread_there, abs=1e-5)
    assert mean == pytest.approx(math.sqrt(3.0) * spread_there, abs=1e-5)


@settings(max_examples=50)
@given(st.integers(0, 4), st.floats(-3.0, 3.0))
def test_one_move_later_leaves_the_arrival_of_the_others(k, value):
    random = np.random.default_rng(8)
    steps, theta = random.uniform(1.0, 5.0, 5), np.concatenate(([2.0, 30.0], random.uniform(-1.0, 1.0, 5)))
    moved = one_later(theta, k, value, 2, steps, 0.5)
    before, after = (x[1] + 0.5 * latenesses(x[2:], steps) for x in (theta, moved))
    others = np.arange(5) != k
    assert after[others] == pytest.approx(before[others])
    assert after[k] - before[k] == pytest.approx(0.5 * (value - theta[2 + k]))


def test_of_a_record_with_gaps_the_longest_part_is_used():
    t = np.concatenate((np.arange(20.0), np.arange(50.0, 120.0), np.arange(200.0, 230.0)))
    recording = Recording(t, np.zeros(t.size), t * 2.0, settings={"segments": {"tail": 100.0}, "note": 1})
    whole = without_gaps(recording)
    assert (whole.t[0], whole.t[-1], whole.t.size) == (50.0, 119.0, 70)
    assert whole.pv.tolist() == (2.0 * np.arange(50.0, 120.0)).tolist()
    assert "segments" not in whole.settings
    assert "samples 20 to 89" in whole.notes[-1]


@pytest.mark.parametrize("t", [np.arange(50.0), np.concatenate([np.arange(5.0) + 100.0 * k for k in range(9)])])
def test_a_record_without_gaps_or_with_many_stays_as_it_is(t):
    recording = Recording(t, np.zeros(t.size), t)
    assert without_gaps(recording) is recording


def test_a_model_of_two_effects_has_the_sizes_of_both():
    recording = record(PAIR, moves(), actuators=[Saturation(0.0, 44.0)], loads=[LoadStep(150.0, -4.0)])
    dataset = dataset_of(recording)
    limit = of_form(saturations(dataset), "saturation:high")
    both = [(limit, (0.25,)), (load_of(dataset), (150.0 / SPAN_S,))]
    fitted = at_the_truth(recording, PAIR, *both)
    assert left(fitted) < 1e-9
    assert fitted.sizes() == [pytest.approx({"high": 44.0}), pytest.approx({"at_s": 150.0, "size": -4.0})]
    assert fitted.names == ("saturation", "load_step")
    for alone in both:
        assert left(at_the_truth(recording, PAIR, alone)) > 0.02


def test_a_column_acts_on_the_position_that_an_actuator_left():
    """A gain that drifts behind a limit multiplies what the limit lets through."""
    recording = record(LAG, moves(), actuators=[Saturation(0.0, 44.0)])
    dataset = dataset_of(recording)
    limit = (of_form(saturations(dataset), "saturation:high"), (0.25,))
    drift = of_form(process_effects(dataset, at_the_truth(recording, LAG)), "gain_drift")
    fitted = at_the_truth(recording, LAG, limit, (drift, ()))
    plain = record(LAG, np.minimum(moves(), 4.0))
    exact = at_the_truth(plain, LAG, (drift, ())).problem
    rows = fitted.problem.rows
    ours, theirs = fitted.problem.columns(fitted.theta, rows)[0], exact.columns(fitted.theta[:2], rows)[0]
    assert ours == pytest.approx(theirs, abs=2e-3)  # time is cut at other moves
    assert OUTPUT0 + float(fitted.problem.view(fitted.theta, rows).position.levels.max()) == pytest.approx(44.0)


def test_a_model_that_does_not_answer_to_the_output_has_sizes_and_is_none():
    """Sizes over the gain have no value then; a search comes to such models, and passes them over."""
    context = bench_of(dataset_of(noisy(record(LAG, moves()), 0.02)))
    origins = base_of(context, ("offset",), 0).origins
    silent = [
        replace(c, linear=np.concatenate(([0.0], c.linear[1:])))
        for effect in catalogue(origins[0], context.coarse)
        for c in sketched(context, origins[:1], [effect])[:1]
    ]
    assert len(silent) > 30
    assert all(len(c.sizes()) == len(c.names) for c in silent)
    assert not any(is_physical(c) for c in silent)
