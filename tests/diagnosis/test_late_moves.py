"""Moves that come late: each by a time of its own, and those of a loop whose samples are late.

The records are closed forms, sums of e^{-(t - t_i)/T} for moves at known moments, or the simulator's.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from autotuner import diagnose
from autotuner.core.diagnosis.effects.actuator.update_jitter import latenesses, uneven_updates
from autotuner.core.diagnosis.extended.extended_model import Extended
from autotuner.core.diagnosis.extended.fit_context import bench_of
from autotuner.core.diagnosis.extended.fitting import fit
from autotuner.core.diagnosis.record.dataset import dataset_of
from autotuner.core.diagnosis.search.uneven_sampling import jittered_moves
from autotuner.core.model.structures import FOPDT
from autotuner.core.recording import Recording
from benchmarks.accuracy.diagnosis.independent import Case, record_of

T, K, DELAY = 12.0, 2.0, 3.0
MOVES_S = np.arange(20.0, 520.0, 25.0)
UNTIL_S, END_S = 420.0, 540.0


def answer(t, moments):
    """Return the PV after moves of 10 up and down at some moments, dead time and lag behind them."""
    pv = np.full(t.size, 50.0)
    for number, moment in enumerate(moments):
        since = np.maximum(t - moment - DELAY, 0.0)
        pv += K * (10.0 if number % 2 == 0 else -10.0) * -np.expm1(-since / T)
    return pv


def record(max_lateness_s, sampled_late_s=0.0, sigma=0.0):
    """Return a tuning's record whose moves and samples come late by known times."""
    t = np.arange(0.0, END_S)
    output = 10.0 * (np.searchsorted(MOVES_S, t, side="right") % 2)
    pv = answer(t + sampled_late_s, MOVES_S + max_lateness_s) + np.random.default_rng(5).normal(0.0, sigma, t.size)
    return Recording(t, output, pv, settings={"segments": {"relay": 20.0, "staircase": 300.0, "tail": UNTIL_S}})


def at_the_truth(recording):
    """Return the samples, and the process as it is."""
    context = bench_of(dataset_of(recording))
    problem = Extended(context.dataset, FOPDT, (), context.fine)
    return context, fit(problem, np.array([math.log(T), DELAY / problem.unit_s]), 0)


def test_how_late_each_move_came_is_read_from_the_record():
    max_lateness_s = np.random.default_rng(3).uniform(0.0, 1.5, MOVES_S.size)
    context, process = at_the_truth(record(max_lateness_s))
    effect = uneven_updates(process, context.coarse)
    fitted = MOVES_S < UNTIL_S
    assert len(effect.searched) == np.count_nonzero(fitted)
    assert np.array(effect.starts[0]) == pytest.approx(max_lateness_s[fitted], abs=0.15)  # to first order


def test_latenesses_are_those_of_a_uniform_distribution_and_moves_of_the_other_part_come_as_late_as_its_mean():
    """No record tells a mean lateness from dead time: 0 to 2 in equal steps have a spread of 2/sqrt(12) and a bit."""
    context, process = at_the_truth(record(np.zeros(MOVES_S.size)))
    effect = uneven_updates(process, context.coarse)
    held, count = context.dataset.data.held, len(effect.searched)
    shifts = np.linspace(0.0, 2.0, count)
    moved = effect.position(held, tuple(shifts), context.dataset).times - held.times
    half_width = math.sqrt((count + 1) / (count - 1))
    assert moved[1 : count + 1] == pytest.approx(shifts - 1.0 + half_width)
    assert moved[count + 1 :] == pytest.approx(half_width)
    assert effect.sizes(tuple(shifts), (), 1.0)["period_s"] == pytest.approx(2.0 * half_width)


def test_when_a_small_move_came_hardly_counts():
    late = latenesses([0.0, 2.0, 50.0], np.array([10.0, -10.0, 0.0]))
    assert late == pytest.approx([math.sqrt(3.0) - 1.0, math.sqrt(3.0) + 1.0, math.sqrt(3.0) + 49.0])


def test_the_slopes_with_the_times_are_those_of_the_answers():
    context, process = at_the_truth(record(np.zeros(MOVES_S.size)))
    effect = uneven_updates(process, context.coarse)
    problem = replace(process.problem, effects=(effect,), rows=context.coarse)
    p = 0.3 + 0.05 * np.sin(np.arange(len(effect.searched)))
    head = process.theta
    known = effect.slopes(problem.view(np.concatenate((head, p)), context.coarse), p)
    assert not known[:, 0].any()  # of equal moves the first stays
    for k in (3, 7):
        by = np.where(np.arange(p.size) == k, 1e-5, 0.0)
        there, back = (problem.columns(np.concatenate((head, p + s * by)), context.coarse)[0][:, 0] for s in (1, -1))
        assert known[:, k] == pytest.approx((there - back) / 2e-5, abs=1e-4)


def with_times(recording):
    context, process = at_the_truth(recording)
    effect = uneven_updates(process, context.coarse)
    problem = replace(process.problem, effects=(effect,))
    return context, fit(problem, np.concatenate((process.theta, effect.starts[0])))


@pytest.mark.parametrize("sigma", [0.0, 0.02])
def test_samples_and_moves_that_come_late_are_one_jittered_loop(sigma):
    """The experiment moves its output when it has sampled: both late by less than a sample interval."""
    random = np.random.default_rng(7)
    sampled_late_s = random.uniform(0.0, 0.9, int(END_S))
    context, timed = with_times(record(sampled_late_s[MOVES_S.astype(int)], sampled_late_s, sigma))
    found = jittered_moves(context, timed)
    assert found is not None
    assert found.names == ("timing_jitter",)


def test_moves_that_are_late_by_more_than_samples_can_be_are_no_jitter():
    random = np.random.default_rng(7)
    max_lateness_s = random.uniform(0.0, 4.0, MOVES_S.size)
    context, timed = with_times(record(max_lateness_s, random.uniform(0.0, 0.9, int(END_S))))
    assert jittered_moves(context, timed) is None


def test_late_moves_alone_are_no_jitter():
    context, timed = with_times(record(np.random.default_rng(7).uniform(0.0, 0.9, MOVES_S.size), 0.0, 0.02))
    assert jittered_moves(context, timed) is None


def on_the_right_grid(seed, experiment):
    """Return a record of updates at even times, and the answer, which has their period."""
    made = record_of(Case("actuator_hold:even", seed, experiment))
    found = diagnose(Recording.from_csv_text(made.csv()))
    (effect,) = found.effects
    assert (found.verdict, effect.name) == ("explained", "actuator_hold")
    assert effect.parameters["period_s"] == pytest.approx(made.hidden.sizes["period_s"], rel=5e-4)
    return made, found


@pytest.mark.usefixtures("without_gains")
def test_the_period_is_right_where_the_phase_is_left_open():
    """The hidden phase is at a tenth of those at which every move finds its update: a later move finds another one."""
    on_the_right_grid(770, "random")


@pytest.mark.parametrize(("seed", "experiment"), [(763, "relay"), (789, "steps")])
@pytest.mark.usefixtures("without_gains")
def test_of_grids_that_fit_alike_the_one_is_taken_that_predicts_the_moves_after(seed, experiment):
    """Truths are the independent generator's: by which update a move is taken over decides a whole answer."""
    made, found = on_the_right_grid(seed, experiment)
    traces = found.traces
    late = traces.t > traces.held_out_from_s
    assert np.std((traces.pv - traces.after)[late]) < 1.25 * made.sigma
