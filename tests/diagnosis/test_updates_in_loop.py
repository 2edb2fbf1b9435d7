"""Updates at uneven times of an actuator in a loop.

The output is a known function that moves at every sample, the PV a sum of (1 - e^{-(t - tau_i - D)/T}) for a position
that takes it over at known moments: closed forms. Loops are those of the independent generator.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from autotuner import diagnose
from autotuner.core.diagnosis.effects.actuator.updates_in_loop import beside, updated_at, updates_in_loop
from autotuner.core.diagnosis.extended.base import base_of
from autotuner.core.diagnosis.extended.extended_model import Extended
from autotuner.core.diagnosis.extended.fit_context import bench_of
from autotuner.core.diagnosis.extended.fitting import fit
from autotuner.core.diagnosis.extended.seen_again import as_seen_again, left_to, with_own_events
from autotuner.core.diagnosis.record.dataset import dataset_of
from autotuner.core.diagnosis.search.joint.times_of_updates import with_times_of_updates
from autotuner.core.model.structures import FOPDT
from autotuner.core.recording import Recording
from benchmarks.accuracy.diagnosis.independent import Case, record_of

T, K, DELAY, SAMPLES, REST = 12.0, 2.0, 3.0, 600, 50.0
UPDATES = np.cumsum(np.random.default_rng(4).choice([2.25, 4.5, 6.0, 9.75], 120))
UPDATES = UPDATES[UPDATES < SAMPLES]
"""At quarters of a sample, some of them within one."""


def output_of(samples):
    return 10.0 * np.sin(samples / 9.0) + 4.0 * np.sin(samples / 2.3)


def pv_of(t, updates):
    levels = np.append(0.0, output_of(np.floor(updates)) - output_of(0.0))
    since = np.maximum(t[:, None] - updates - DELAY, 0.0)
    return REST - K * np.expm1(-since / T) @ np.diff(levels)


def process_of(sigma=0.0, updates=UPDATES):
    """Return the samples of a record, and the process as it is."""
    t = np.arange(float(SAMPLES))
    pv = pv_of(t, updates) + np.random.default_rng(8).normal(0.0, sigma, SAMPLES)
    context = bench_of(dataset_of(Recording(t, output_of(t), pv)))
    problem = Extended(context.dataset, FOPDT, (), context.fine)
    alone = fit(problem, np.array([math.log(T), DELAY / problem.unit_s]), 0)
    offset = REST - context.dataset.pv0
    return context, replace(alone, linear=np.array([K, offset]))


def until(context):
    return np.flatnonzero(context.dataset.fitted)


def test_the_times_of_all_updates_are_found_beside_the_right_process():
    context, process = process_of()
    assert context.dataset.in_loop
    found = updates_in_loop(left_to(process, None, until(context)), 1e-3)
    last = until(context)[-1] - DELAY
    seen = UPDATES[last - 1.0 > UPDATES]
    assert found[: seen.size] == pytest.approx(seen)


def test_noise_hides_few_updates_and_makes_none():
    context, process = process_of(sigma=0.05)
    found = updates_in_loop(left_to(process, None, until(context)), 0.05)
    seen = UPDATES[until(context)[-1] - DELAY - 2.0 > UPDATES]
    nearest = np.abs(seen[:, None] - found).min(axis=1)
    assert np.mean(nearest < 0.5) > 0.9
    assert found.size <= seen.size + 2


def test_a_process_that_is_left_alone_has_no_updates_but_what_its_samples_are():
    """An output that is taken over at once is so at every sample: fewer updates leave more than they save."""
    context, process = process_of(updates=np.arange(0.0, SAMPLES))
    assert updates_in_loop(left_to(process, None, until(context)[:100]), 1e-3).size > 90


def test_slopes_with_the_times_are_those_of_the_answer():
    context, process = process_of()
    effect = updated_at(context.dataset, UPDATES[UPDATES < 400.0] + 0.1, 420.0, searched=True)
    problem = replace(process.problem, effects=(effect,), rows=context.coarse)
    p = np.array(effect.starts[0])
    known = effect.slopes(problem.view(np.concatenate((process.theta, p)), context.coarse), p.tolist())
    fitted = context.coarse < 400.0
    for k in (2, 11, 30):
        by = np.where(np.arange(p.size) == k, 1e-5, 0.0)
        thetas = [np.concatenate((process.theta, p + sign * by)) for sign in (1, -1)]
        there, back = (problem.columns(theta, context.coarse)[0][:, 0] for theta in thetas)
        assert known[fitted, k] == pytest.approx((there - back)[fitted] / 2e-5, abs=1e-4)


def test_a_time_stays_within_its_sample_where_its_output_is_the_same():
    context, _ = process_of()
    effect = updated_at(context.dataset, np.array([3.25, 7.0, 12.75, 20.5]), 40.0, searched=True)
    assert [s.low for s in effect.searched] == [3.0, 7.0, 12.0, 20.0]
    assert all(s.low < s.high < s.low + 1.0 for s in effect.searched)


def test_the_position_is_held_until_the_end_of_what_is_seen_and_then_as_late_as_it_was():
    context, _ = process_of()
    updates = np.arange(10.5, 400.0, 10.0)
    effect = updated_at(context.dataset, updates, 417.0, searched=True)
    position = effect.position(context.dataset.data.held, updates.tolist(), context.dataset)
    level = output_of(np.floor(updates)) - output_of(0.0)
    assert position.at(updates + 0.01) == pytest.approx(level)
    assert position.at(np.array([416.0])) == pytest.approx(level[-1:])
    # Moves at 1 to 10 of each update at 10.5: 9.5 to 0.5 late, 5 in the mean for moves that are alike.
    later = np.arange(440.0, 580.0)
    assert position.at(later + 0.5) == pytest.approx(output_of(later - 5.0) - output_of(0.0), abs=2.0)


def test_the_period_is_that_of_a_uniform_distribution_of_the_latenesses():
    context, _ = process_of()
    effect = updated_at(context.dataset, np.arange(10.5, 400.0, 10.0), 417.0, searched=True)
    # Ten latenesses in equal steps of 1 have a standard deviation of sqrt((10^2 - 1)/12).
    period_s = effect.sizes(effect.starts[0], (), K)["period_s"]
    assert period_s == pytest.approx(math.sqrt(10.0**2 - 1.0), rel=0.03)
    # About forty updates alike: a standard deviation of forty uniform values is known to sqrt(0.2/40), 7 %.
    assert effect.blur(effect.starts[0])["period_s"] == pytest.approx(1.96 * math.sqrt(0.2 / 40.0) * period_s, rel=0.3)


def test_the_times_of_the_other_part_are_found_beside_the_same_process():
    context, process = process_of(sigma=0.02)
    found = updates_in_loop(left_to(process, None, until(context)), 0.02)
    effect = beside(left_to(process, None, until(context)), found, searched=True)
    problem = replace(process.problem, effects=(effect,))
    timed = fit(problem, np.concatenate((process.theta, found)), 10)
    predicted = context.dataset.data.pv[context.held_out] - timed.simulated(context.held_out)
    assert np.std(predicted) > 0.2  # what was seen until then says nothing of the times that follow
    assert context.held_out_error(timed) < 0.03
    seen = as_seen_again(timed, context.dataset, SAMPLES)
    assert with_own_events(timed, context.dataset, SAMPLES) is seen
    assert len(seen.problem.effects[0].searched) > len(effect.searched)
    # A correct model errs there by as much as the unknown times make, and by noise.
    assert context.expected(timed, 0.02) == pytest.approx(float(np.sqrt(np.mean(predicted**2))), rel=0.1)


@pytest.mark.parametrize("seed", [605, pytest.param(618, marks=pytest.mark.long)])
def test_updates_at_uneven_times_in_a_loop_are_named(seed):
    record = record_of(Case("actuator_hold:uneven", seed, "loop"))
    found = diagnose(Recording.from_csv_text(record.csv()))
    assert [(e.name, e.form) for e in found.effects] == [("actuator_hold", "uneven")]
    assert found.verdict == "explained"
    assert found.error["fitted"].after < 1.1 * record.sigma


@pytest.mark.parametrize("seed", [716, 717])
def test_updates_that_follow_an_unmeasured_load_of_a_loop_cost_more_than_they_explain(seed):
    record = record_of(Case("clean", seed, "loop", "coloured"))
    context = bench_of(dataset_of(Recording.from_csv_text(record.csv())))
    base = base_of(context, ("offset", "state"), 0)
    alone = base.best
    followed = with_times_of_updates(context, base)
    assert all(context.criterion(c, context.colour(c)) > context.criterion(alone, context.colour(c)) for c in followed)


@pytest.mark.long
def test_an_unmeasured_load_of_a_loop_is_no_uneven_update():
    record = record_of(Case("clean", 717, "loop", "coloured"))
    assert not diagnose(Recording.from_csv_text(record.csv())).effects
