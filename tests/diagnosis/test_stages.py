"""Stages of an actuator: against positions and responses written by hand, the simulator, and the independent generator.

A staircase by hand is the sum of its steps. The process answers it by the closed form of a lag from sample to sample.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotuner import Recording, diagnose
from autotuner.core.diagnosis.effects.actuator import position_in_loop
from autotuner.core.diagnosis.effects.actuator.position_in_loop import equal_steps, stages_in_loop
from autotuner.core.diagnosis.effects.actuator.stages import unequal_stages
from autotuner.core.diagnosis.extended.fitting import fit
from autotuner.core.diagnosis.record.dataset import dataset_of
from autotuner.core.model.zoh_input import held_input
from autotuner_sim import Fopdt, OutputQuantisation
from benchmarks.accuracy.diagnosis.independent import Case, record_of
from tests.diagnosis.simulated import LAG, OUTPUT0, at_the_truth, record

COUNT = 600
staircases = st.lists(st.tuples(st.floats(1.0, 4.0), st.floats(0.5, 4.0)), min_size=3, max_size=5)


def output_of_a_loop():
    """Return an output that moves at every sample, as deviation from its first value."""
    random = np.random.default_rng(6)
    u = 6.0 * np.sin(np.arange(COUNT) / 9.0) + random.normal(0.0, 2.0, COUNT)
    return u - u[0]


def lag_by_hand(positions, gain=LAG.K, lag_s=LAG.T, delay=int(LAG.D)):
    """Return the deviation of a lag's PV, sampled every second, under positions that are held from their samples on."""
    pv, keeps = np.zeros(positions.size), math.exp(-1.0 / lag_s)
    for k in range(1, positions.size):
        arriving = positions[k - 1 - delay] if k > delay else positions[0]
        pv[k] = keeps * pv[k - 1] + gain * (1.0 - keeps) * (arriving - positions[0])
    return pv


def staircase(u, thresholds, heights):
    return (u[:, None] > np.array(thresholds)) @ np.array(heights)


def drawn(steps):
    """Return thresholds about the middle of the output, and their heights."""
    apart, heights = np.array(steps).T
    thresholds = np.cumsum(apart)
    return thresholds - thresholds.mean() + float(np.median(output_of_a_loop())), heights


def recorded(pv):
    return Recording(np.arange(float(COUNT)), OUTPUT0 + output_of_a_loop(), 100.0 + pv)


def on_the_fitted_part(fitted):
    return fit(replace(fitted.problem, rows=np.flatnonzero(fitted.problem.dataset.fitted)), fitted.theta, 0)


@settings(max_examples=25, deadline=None)
@given(staircases, st.sampled_from([2.0, -0.5]))
def test_stages_are_those_of_the_record_though_the_process_alone_knows_of_none(steps, gain):
    thresholds, heights = drawn(steps)
    pv = lag_by_hand(staircase(output_of_a_loop(), thresholds, heights), gain)
    pv += np.random.default_rng(1).normal(0.0, 0.005 * np.std(pv), COUNT)
    base = on_the_fitted_part(at_the_truth(recorded(pv), LAG))
    swing = base.problem.dataset.swing
    nearly, _ = stages_in_loop(base, np.zeros(0), 1.6, 0.1)
    found, of_height = stages_in_loop(base, nearly, 1.0, 0.1)
    position = staircase(output_of_a_loop(), swing * found, of_height)
    expected = staircase(output_of_a_loop(), thresholds, heights)
    fitted = base.problem.dataset.fitted
    assert np.corrcoef(position[fitted], expected[fitted])[0, 1] > 0.99
    assert found.size <= thresholds.size + 4


@settings(max_examples=50)
@given(staircases, st.floats(0.2, 5.0))
def test_the_position_is_the_sum_of_the_stages_in_units_of_the_output(steps, unit):
    """Thresholds in the middle between two positions, as an actuator has them that takes the nearest."""
    _, heights = drawn(steps)
    levels = np.append(0.0, np.cumsum(heights)) - heights.sum() / 2.0
    thresholds = (levels[1:] + levels[:-1]) / 2.0
    u = output_of_a_loop()
    dataset = dataset_of(recorded(lag_by_hand(u)))
    swing = dataset.swing
    effect = unequal_stages(dataset, thresholds / swing, unit * heights)
    held = held_input(np.arange(float(COUNT)), u)
    position = effect.position(held, effect.starts[0], dataset)
    seen = u[dataset.data.t < dataset.fitted_until_s]
    within = (u <= seen.max()) & (u >= seen.min())
    expected = staircase(u, thresholds, heights)
    assert (position.at(held.times) - position.at(held.times[:1]))[within] == pytest.approx(
        (expected - expected[0])[within], abs=1e-6
    )
    assert effect.sizes((), [0.0] * (heights.size - 1), 1.0)["step"] == pytest.approx(heights.max())


def test_stages_go_on_beyond_the_outputs_that_were_fitted():
    u = output_of_a_loop()
    u[-1] = u.max() + 30.0
    dataset = dataset_of(Recording(np.arange(float(COUNT)), OUTPUT0 + u, 100.0 + lag_by_hand(u)))
    effect = unequal_stages(dataset, np.array([-0.1, 0.1, 0.3]), np.ones(3))
    position = effect.position(held_input(np.arange(float(COUNT)), u), effect.starts[0], dataset)
    height = 0.2 * dataset.swing
    assert position.at(np.array([COUNT - 1.0]))[0] == pytest.approx(u[-1], abs=1.5 * height)


def test_thresholds_alike_pass_every_output_as_they_do():
    u = output_of_a_loop()
    dataset = dataset_of(recorded(lag_by_hand(u)))
    thresholds = np.array([-3.0, 0.5, 4.0]) / dataset.swing
    effect = unequal_stages(dataset, thresholds, np.ones(3))
    early = u[dataset.data.t < dataset.fitted_until_s]
    others = effect.alike(effect.starts[0], dataset.fitted_until_s)
    assert len({other[0] for other in others}) > 3
    for other in others:
        assert np.array_equal(early[:, None] > dataset.swing * np.array(other), early[:, None] > [-3.0, 0.5, 4.0])


@pytest.mark.parametrize("step", [2.5, 4.0])
def test_equal_steps_in_a_loop_are_the_simulators(step):
    u = output_of_a_loop()
    recording = record(LAG, u, actuators=[OutputQuantisation(step)])
    base = on_the_fitted_part(at_the_truth(recording, Fopdt(LAG.K, 1.3 * LAG.T, LAG.D)))
    found, _ = stages_in_loop(base, np.zeros(0), 1.6, 0.1)
    swing = base.problem.dataset.swing
    sizes = [size * swing for size, _ in equal_steps(base.problem.dataset, found)["from the rest"]]
    assert min(abs(size / step - 1.0) for size in sizes) < 0.02


@pytest.mark.parametrize(
    "seed", [603, pytest.param(608, marks=pytest.mark.long), pytest.param(602, marks=pytest.mark.long)]
)
@pytest.mark.usefixtures("without_gains")
def test_an_actuator_with_unequal_stages_is_found_in_a_loop(seed):
    hidden = record_of(Case("output_quantisation:unequal", seed, "loop"))
    answer = diagnose(Recording.from_csv_text(hidden.csv()))
    edges = hidden.hidden.actuator.edges
    passed = (edges[1:] > hidden.u.min()) & (edges[:-1] < hidden.u.max())
    assert [(e.name, e.form) for e in answer.effects] == [("output_quantisation", "unequal")]
    assert answer.verdict == "explained"
    assert answer.effects[0].parameters["step"] == pytest.approx(np.diff(edges)[passed].max(), rel=0.15)


def test_stages_that_are_merged_into_one_are_none(monkeypatch):
    """One threshold leaves open which output its height is worth: the search goes on without stages."""
    pv = lag_by_hand(staircase(output_of_a_loop(), *drawn([(2.0, 1.0)] * 3)))
    base = on_the_fitted_part(at_the_truth(recorded(pv), LAG))
    assert stages_in_loop(base, np.zeros(0), 1.6, 0.1) is not None
    monkeypatch.setattr(position_in_loop._Merging, "merged", lambda *_: (np.array([3]), np.array([1.0])))
    assert stages_in_loop(base, np.zeros(0), 1.6, 0.1) is None
