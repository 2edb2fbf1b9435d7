"""Whether a record proves the sign of the gain beside effects."""

from dataclasses import replace

import numpy as np
import pytest

from autotuner import Recording, diagnose
from autotuner.core.diagnosis.effects.disturbance import disturbance_effects
from autotuner.core.diagnosis.extended.fit_context import bench_of
from autotuner.core.diagnosis.findings.gain_proof import doubts_about_sign
from autotuner.core.diagnosis.record.dataset import dataset_of
from autotuner.core.diagnosis.search.trace import Trace
from benchmarks.accuracy.diagnosis.independent import Case, record_of
from tests.diagnosis.simulated import LAG, at_the_truth, of_form, record

UP, DOWN, END = 300, 500, 600
SIGMA = 0.05
OUTPUT = np.where((np.arange(END) >= UP) & (np.arange(END) < DOWN), 8.0, 0.0)


@pytest.fixture(scope="module")
def context():
    """One pulse of the output: the end of it may answer the first move, if a load came with that one."""
    plain = record(LAG, OUTPUT)
    noise = SIGMA * np.random.default_rng(4).standard_normal(END)
    return bench_of(dataset_of(Recording(plain.t, plain.output, plain.pv + noise)))


@pytest.fixture(scope="module")
def right(context):
    return at_the_truth(None, LAG, dataset=context.dataset)


@pytest.fixture(scope="module")
def opposite(context):
    load = of_form(disturbance_effects(context.dataset, [context.dataset.data.pv], []), "load_step")
    moment = (UP + LAG.D) / context.dataset.span_s
    return at_the_truth(None, replace(LAG, D=LAG.D + DOWN - UP), (load, [moment]), dataset=context.dataset)


def doubts(context, chosen, *pool):
    return doubts_about_sign(context, Trace(chosen, chosen, pool, SIGMA))


def test_two_processes_of_opposite_gain_leave_the_sign_open(context, right, opposite):
    assert right.linear[0] * opposite.linear[0] < 0.0
    (doubt,) = doubts(context, opposite, opposite, right)
    assert doubt.startswith("a process of the opposite gain, with nothing beside it, explains")


def test_one_that_is_far_off_on_either_part_leaves_it_proven(context, right, opposite):
    late = at_the_truth(None, replace(LAG, D=LAG.D + 5.0), dataset=context.dataset)
    assert late.linear[0] * opposite.linear[0] < 0.0
    assert doubts(context, opposite, opposite, late) == []
    off_later = replace(right, linear=np.append(right.linear[:-1], right.linear[-1] + 5.0 * SIGMA))
    assert doubts(context, opposite, opposite, off_later) == []


def test_a_process_that_needs_no_effect_is_not_doubted_for_one_that_does(context, right, opposite):
    assert doubts(context, right, opposite) == []


@pytest.mark.long  # the rule is shown above
def test_no_gains_of_a_sign_that_a_short_record_leaves_open():
    hidden = record_of(Case("saturation:hard + periodic_disturbance:sine", 768, "short"))
    answer = diagnose(Recording.from_csv_text(hidden.csv()))
    assert answer.verdict == "partly_explained"
    assert answer.gains["after"] is None
    assert any(note.startswith("no gains: a process of the opposite gain") for note in answer.notes)
