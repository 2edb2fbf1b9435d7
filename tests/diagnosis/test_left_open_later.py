"""The error that a correct explanation may make later, by what the samples so far leave open."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy
from hypothesis import given
from hypothesis import strategies as st

from autotuner import Recording, diagnose
from autotuner.core.diagnosis.effects.actuator.levels import LARGEST, steps_alike
from autotuner.core.diagnosis.effects.actuator.textbook_forms import quantisation
from autotuner.core.diagnosis.effects.sawtooth import RegularJumps, sawtooth
from autotuner.core.diagnosis.extended.effect import between
from autotuner.core.diagnosis.extended.fitting import fit
from autotuner.core.diagnosis.extended.left_open_later import error_left_open
from autotuner.core.diagnosis.record.dataset import dataset_of
from autotuner.core.model.zoh_input import HeldInput
from benchmarks.accuracy.diagnosis.independent import Case, record_of
from tests.diagnosis.simulated import LAG, at_the_truth, moves, record

SWING, OUTPUT0 = 16.0, 52.5
outputs = st.lists(st.floats(-40.0, 40.0), min_size=2, max_size=12).map(lambda of: np.array([0.0, *of]))


def case(levels):
    """The outputs of a record, one a second."""
    held = HeldInput(np.arange(float(levels.size)), levels)
    return SimpleNamespace(data=SimpleNamespace(held=held), swing=SWING, output0=OUTPUT0)


@given(outputs, st.floats(0.3, 9.0), st.sampled_from(["from the rest", "from zero"]))
def test_steps_that_are_alike_round_every_output_alike(levels, step, form):
    from_origin = levels + (OUTPUT0 if form == "from zero" else 0.0)
    if np.any(np.abs(np.abs(from_origin / step) % 1.0 - 0.5) < 1e-6):
        return  # halfway between two steps, either is right

    def is_alike(other):
        return np.array_equal(np.round(from_origin / other), np.round(from_origin / step))

    alike = steps_alike(case(levels), form, step / SWING, math.inf)
    sizes = np.array([size for size, _ in alike]) * SWING
    assert all(is_alike(size) for size in sizes)
    beyond = sizes[-1] + 0.51 * (sizes[1] - sizes[0])
    assert beyond > LARGEST * SWING or not is_alike(beyond)
    for size, (_, origin) in zip(sizes, alike, strict=True):
        assert np.round(levels / size - origin) == pytest.approx(
            np.round(from_origin / size) - np.round(from_origin[0] / size)
        )


def test_outputs_that_come_later_do_not_count():
    known = steps_alike(case(np.array([0.0, 5.0, -5.0])), "from the rest", 4.0 / SWING, math.inf)
    later = steps_alike(case(np.array([0.0, 5.0, -5.0, 7.9])), "from the rest", 4.0 / SWING, 3.0)
    assert known == later


def test_no_values_stand_for_none():
    assert between(1.0, 1.0).size == 0
    assert between(0.0, 1.0) == pytest.approx((np.arange(9) + 0.5) / 9.0)


@pytest.mark.parametrize(("last", "is_open"), [(6.5, True), (5.0, False)])
def test_another_output_is_rounded_as_each_of_the_steps_that_are_alike_would(last, is_open):
    """A gain that makes up for the step gives the same PV, until an output comes that is rounded otherwise."""
    output = moves(600, 20, size=5.0)
    output[500:] = last
    recording = record(LAG, np.round(output / 4.0) * 4.0)  # as steps of 4 would do
    recording = Recording(recording.t, recording.output[0] + output, recording.pv)
    dataset = dataset_of(recording)
    effect = quantisation(dataset, "from the rest", [])
    fitted = at_the_truth(recording, LAG, (effect, (4.0 / dataset.swing, 0.0)), dataset=dataset)
    fitted = replace(fitted, problem=replace(fitted.problem, rows=np.arange(500)))
    rows = np.arange(500, 600)
    alike = [step * dataset.swing for step, _ in steps_alike(dataset, "from the rest", 4.0 / dataset.swing, 500.0)]
    simulated = [record(replace(LAG, K=LAG.K * 4.0 / step), np.round(output / step) * step).pv[rows] for step in alike]
    expected = math.sqrt(np.mean([(pv - recording.pv[rows]) ** 2 for pv in simulated]))
    assert error_left_open(fitted, dataset, rows, 500.0) == pytest.approx(expected, rel=1e-6, abs=1e-6)
    assert (expected > 1.0) is is_open


@pytest.mark.parametrize(("noise", "least", "most"), [(0.3, 0.5, 2.0), (0.01, 0.0, 0.2)])
def test_a_period_that_the_jumps_leave_open_moves_those_that_follow(noise, least, most):
    """The ramps between them show it, too, where there is little noise."""
    t = np.arange(600.0)
    wave = 2.0 * scipy.signal.sawtooth(2.0 * np.pi * (t - 7.3) / 29.37)
    alone = record(LAG, moves(600))
    wave = wave + noise * np.random.default_rng(1).standard_normal(t.size)
    recording = Recording(t, alone.output, alone.pv + wave)
    dataset, few = dataset_of(recording), np.arange(150)
    (effect,) = sawtooth(replace(dataset, fitted=t < few.size), [wave])
    start = at_the_truth(recording, LAG, (effect, effect.starts[0]), dataset=dataset)
    fitted = fit(replace(start.problem, rows=few), start.theta, 10)
    jumps = RegularJumps.of(t[few], wave[few])
    assert [p for (p,) in effect.alike(effect.starts[0], 150.0)] == pytest.approx(jumps.periods_s())
    assert least <= error_left_open(fitted, dataset, np.arange(500, 600), 150.0) < most


def test_nothing_is_left_open_by_a_process_alone():
    recording = record(LAG, moves(600))
    assert error_left_open(at_the_truth(recording, LAG), dataset_of(recording), np.arange(500, 600), 500.0) == 0.0


@pytest.mark.long  # each part is shown above
def test_an_output_that_may_be_rounded_either_way_does_not_speak_against_the_steps():
    hidden = record_of(Case("output_quantisation:even", 815, "relay"))
    answer = diagnose(Recording.from_csv_text(hidden.csv()))
    assert answer.verdict == "explained"
    assert [e.name for e in answer.effects] == ["output_quantisation"]
    assert "speaks against" not in answer.summary
    assert " are expected" in answer.summary
    assert any("the record leaves open how the effects act there" in note for note in answer.notes)
