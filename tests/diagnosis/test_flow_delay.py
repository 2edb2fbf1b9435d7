"""A dead time that depends on the flow, or jumps.

The judges are closed forms, root finding, and records that were made without ours.
"""

from dataclasses import replace

import numpy as np
import pytest
import scipy

from autotuner import Recording, diagnose
from autotuner.core.diagnosis.effects.actuator.flow_delay import (
    carried,
    carried_since,
    dead_time_jump,
    flow_delay,
)
from autotuner.core.diagnosis.record.dataset import dataset_of
from autotuner.core.model.zoh_input import HeldInput
from autotuner.effects import EffectPlugin, check_effect
from autotuner_sim import PlugFlow
from benchmarks.accuracy.diagnosis.independent import Case, record_of
from tests.diagnosis.cases import PLANTS, SAMPLE_S, swing_of_pv, tuning_record

pytestmark = pytest.mark.usefixtures("without_gains")


def moves(*at):
    times, levels = zip(*at, strict=True)
    return HeldInput(np.array(times), np.array(levels))


def test_a_constant_flow_is_a_dead_time():
    held = moves((0.0, 0.0), (10.0, 5.0), (12.0, -3.0))
    assert carried(held, 0.0, 6.0).times.tolist() == pytest.approx([0.0, 10.0, 12.0])


def test_a_step_of_the_flow_empties_the_pipe_sooner():
    """Dead time 6 s; 1.5 times the flow from 10 to 12 s brings half of it, 3 s more the rest; back again after 6 s."""
    seen = carried(moves((0.0, 0.0), (10.0, 5.0), (12.0, 0.0)), 0.1, 6.0)
    assert (seen.times + 6.0).tolist() == pytest.approx([6.0, 15.0, 18.0])
    assert seen.levels.tolist() == [0.0, 5.0, 0.0]


def test_less_flow_makes_it_later():
    """From 10 s on 0.4 times the flow: 15 s instead of 6."""
    assert carried(moves((0.0, 0.0), (10.0, 6.0)), -0.1, 6.0).times[1] == pytest.approx(10.0 + 15.0 - 6.0)


@pytest.mark.parametrize("power", [1.0, 2.0, 0.5])
def test_the_lag_holds_the_volume_of_the_pipe(power):
    """By root finding: the lag L of a moment t is that for which the flow over (t - L, t) is the volume."""
    random = np.random.default_rng(4)
    at, u = np.cumsum(random.uniform(1.0, 6.0, 30)), random.uniform(-8.0, 8.0, 30)
    held, change, volume = HeldInput(np.append(0.0, at), np.append(0.0, u)), 0.06, 9.0

    def passed(t):
        edges = np.concatenate(([-50.0], at[at < t], [t]))
        flow = (1.0 + change / power * np.append(0.0, u)[: edges.size - 1]) ** power
        return float(np.sum(np.diff(edges) * flow))

    arrived = carried(held, change, volume, 1.0 / power)
    for t in random.uniform(12.0, at[-1], 40):
        lag = scipy.optimize.brentq(lambda L, t=t: passed(t) - passed(t - L) - volume, 0.0, 60.0, xtol=1e-10)
        source = np.searchsorted(held.times, t - lag, side="right") - 1
        assert np.searchsorted(arrived.times + volume, t, side="right") - 1 == source


def test_what_lies_outside_the_pipe_stays_late_by_as_much():
    """Of a dead time of 10 s, 6 s lie in the pipe: from 10 s on its flow is half, behind a square 0.5625."""
    recording = Recording(np.arange(40.0), np.where(np.arange(40) < 10, 0.0, 4.0), np.arange(40.0) % 3.0)
    dataset = dataset_of(recording)
    straight = flow_delay(dataset)
    (curved,) = straight.other_forms
    at = dataset.data.held.times[1]
    for numbers, expected in (
        ((-0.5, 1.0, 0.6), 6.0),
        ((-0.5, 0.5, 0.6), 6.0 / 0.5625 - 6.0),
        ((-0.5, 1.0, 1.0), 10.0),
    ):
        arrived = curved.transport(dataset.data.held, numbers, 10.0, dataset)
        assert arrived.times[1] - at == pytest.approx(expected)
        sizes = curved.sizes(numbers, (), 1.0)
        assert sizes["longest_over_first"] == pytest.approx(1.0 + expected / 10.0)
        assert (sizes["power"], sizes["share_of_dead_time"]) == (1.0 / numbers[1], numbers[2])


def test_it_conforms():
    def make(dataset, _base):
        straight = flow_delay(dataset)
        forms = tuple(replace(form, name="pipe") for form in straight.other_forms)
        return [replace(straight, name="pipe", other_forms=forms)]

    assert check_effect(EffectPlugin("pipe", make, "up to {longest_over_first:.3g} times")) == []


@pytest.mark.parametrize(("kind", "share"), [("delay", 0.4), pytest.param("balanced", 0.6, marks=pytest.mark.long)])
def test_it_is_named_with_its_size_on_a_record_of_the_simulator(kind, share, among):
    among("flow_delay", "actuator_hold", "rate_limit", "direction_dynamics")
    plant, step_s = PLANTS[kind], SAMPLE_S[kind]
    sigma = swing_of_pv(plant, step_s) * 10.0 ** (-40.0 / 20.0)
    found = diagnose(tuning_record(plant, step_s, sigma, 1, transport=PlugFlow(plant.D, share, 10.0)))
    assert [effect.name for effect in found.effects] == ["flow_delay"]
    assert found.verdict == "explained", found.notes
    low, high = found.effects[0].interval95["flow_per_output"]
    assert low <= share / 10.0 <= high
    assert pytest.approx(found.process.D, rel=0.05) == plant.D


@pytest.mark.long
def test_it_is_named_on_a_record_of_steps():
    """A pipe in slices of a tenth of a second's flow, pushed one by one, before a lag; by Euler's method."""
    random = np.random.default_rng(3)
    output = np.repeat(random.uniform(-8.0, 8.0, 35), 20)
    output[:20] = 0.0
    pv, x, passed, h = [], 0.0, 0.0, 0.02
    marks, within = [-1e9], [0.0]
    for u in output.tolist():
        pv.append(2.0 * x)
        for _ in range(int(1.0 / h)):
            passed += h * (1.0 + 0.07 * u)
            marks.append(passed)
            within.append(u)
            x += h / 12.0 * (within[np.searchsorted(marks, passed - 8.0, side="right") - 1] - x)
    noise = random.normal(0.0, 0.05, output.size)
    found = diagnose(Recording(np.arange(float(output.size)), 40.0 + output, 60.0 + np.array(pv) + noise))
    assert [effect.name for effect in found.effects] == ["flow_delay"]
    assert found.effects[0].parameters["flow_per_output"] == pytest.approx(0.07, rel=0.05)
    assert pytest.approx(8.0, rel=0.03) == found.process.D


@pytest.mark.parametrize("lasts_s", [0.0, 12.0])
@pytest.mark.parametrize("ratio", [0.4, 1.0, 2.5])
def test_a_dead_time_that_jumps_is_that_of_a_pipe_whose_flow_jumps(ratio, lasts_s):
    """By root finding, as above: the flow over (t - L, t) is the volume of the pipe, here 9 s at the first flow."""
    random = np.random.default_rng(5)
    at = np.cumsum(random.uniform(1.0, 6.0, 30))
    held, at_s = HeldInput(np.append(0.0, at), np.arange(31.0)), 50.0

    def flow(t):
        way = 1.0 if lasts_s == 0.0 else min((t - at_s) / lasts_s, 1.0)
        return 1.0 if t < at_s else 1.0 / (1.0 + way * (ratio - 1.0))

    def passed(t):
        corners = [at_s, at_s + lasts_s]
        return scipy.integrate.quad(flow, 0.0, t, points=corners, epsabs=1e-10)[0]

    arrived = carried_since(held, at_s, ratio, 9.0, lasts_s)
    assert np.all(np.diff(arrived.times) > 0.0)
    for t in random.uniform(15.0, at[-1], 40):
        lag = scipy.optimize.brentq(lambda L, t=t: passed(t) - passed(t - L) - 9.0, 0.0, 60.0, xtol=1e-10)
        source = np.searchsorted(held.times, t - lag, side="right") - 1
        assert np.searchsorted(arrived.times + 9.0, t, side="right") - 1 == source


@pytest.mark.parametrize("ratio", [0.5, 2.0])
def test_a_dead_time_that_jumps_is_named(ratio, among):
    """A lag of 12 s behind a shift register whose clock changes at 400 s, by Euler's method."""
    among("dead_time_jump", "flow_delay", "actuator_hold", "extra_lag")
    random = np.random.default_rng(7)
    output = np.repeat(random.uniform(-8.0, 8.0, 50), 15)
    output[:20] = 0.0
    h, pv, x, turns = 0.02, [], 0.0, 0.0
    register = [0.0] * 300
    for k, u in enumerate(output.tolist()):
        pv.append(2.0 * x)
        for _ in range(round(1.0 / h)):
            turns += 1.0 / (ratio if k >= 400 else 1.0)
            while turns >= 1.0:
                register, turns = [*register[1:], u], turns - 1.0
            x += h / 12.0 * (register[0] - x)
    noise = random.normal(0.0, 0.05, output.size)
    found = diagnose(Recording(np.arange(float(output.size)), 40.0 + output, 60.0 + np.array(pv) + noise))
    (effect,) = found.effects
    assert (effect.name, found.verdict) == ("dead_time_jump", "explained")
    assert effect.parameters["later_over_first"] == pytest.approx(ratio, rel=0.05)
    assert effect.parameters["at_s"] == pytest.approx(400.0, abs=15.0)
    assert pytest.approx(6.0, rel=0.03) == found.process.D


def test_a_dead_time_that_jumps_conforms():
    def make(dataset, _base):
        jump = dead_time_jump(dataset)
        return [replace(form, name="line", other_forms=()) for form in (jump, *jump.other_forms)]

    assert check_effect(EffectPlugin("line", make, "{later_over_first:.3g} times")) == []


@pytest.mark.parametrize(("form", "seed"), [("at once", 748), ("within a while", 752)])
def test_a_dead_time_that_jumps_between_two_moves_is_one_answer_of_several(form, seed):
    """Two moves late by different times show no more than that: a flow that follows the output makes them late, too."""
    answer = diagnose(Recording.from_csv_text(record_of(Case(f"dead_time_jump:{form}", seed, "short")).csv()))
    (only,) = answer.effects
    assert "dead_time_jump" in only.indistinguishable
    assert only.confidence <= 0.5
