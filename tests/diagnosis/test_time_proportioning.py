"""A switched output, against pulses worked by hand, and records that were integrated without ours."""

import math
from dataclasses import replace

import numpy as np
import pytest

from autotuner import Recording, diagnose
from autotuner.core.diagnosis.effects.actuator.time_proportioning import pulses, time_proportioning
from autotuner.core.diagnosis.record.dataset import dataset_of
from autotuner.core.model.zoh_input import HeldInput
from autotuner.effects import EffectPlugin, check_effect
from autotuner_sim import TimeProportioned
from tests.diagnosis.test_records_without_segments import integrated, levels

pytestmark = pytest.mark.usefixtures("without_gains")


def test_a_pulse_lasts_for_the_share_of_the_command_at_its_begin():
    held = HeldInput(np.array([0.0, 12.0]), np.array([0.0, 20.0]))  # 40 %, and 60 % from 12 s on
    seen = pulses(held, 40.0, 100.0, 10.0, 0.0, 30.0)
    for at_s, level in [(0.1, 60.0), (3.9, 60.0), (4.1, -40.0), (9.9, -40.0), (13.9, 60.0), (14.1, -40.0)]:
        assert seen.at(np.array([at_s])) == pytest.approx(level), at_s
    assert seen.at(np.array([25.9])) == pytest.approx(60.0)
    assert seen.at(np.array([26.1])) == pytest.approx(-40.0)
    assert seen.at(np.array([-0.1, -6.1])) == pytest.approx([-40.0, 60.0])  # it was switched before the record, too


def test_a_carrier_meets_a_command_that_moves_within_the_period():
    held = HeldInput(np.array([0.0, 12.0]), np.array([0.0, 20.0]))
    seen = pulses(held, 40.0, 100.0, 10.0, 0.0, 30.0, latched=False)
    assert seen.at(np.array([15.9])) == pytest.approx(60.0)
    assert seen.at(np.array([16.1])) == pytest.approx(-40.0)


def test_a_command_that_falls_below_the_carrier_ends_the_pulse_at_once():
    held = HeldInput(
        np.array([0.0, 3.0]), np.array([0.0, -20.0])
    )  # 40 %, and 20 % from 3 s on, as the carrier is at 30
    seen = pulses(held, 40.0, 100.0, 10.0, 0.0, 30.0, latched=False)
    assert seen.at(np.array([2.9, 3.1, 11.9, 12.1])) == pytest.approx([60.0, -40.0, 60.0, -40.0])


def test_a_command_that_rises_above_the_carrier_begins_another_pulse():
    held = HeldInput(np.array([0.0, 6.0]), np.array([0.0, 40.0]))  # 40 %, and 80 % from 6 s on, as the carrier is at 60
    seen = pulses(held, 40.0, 100.0, 10.0, 0.0, 30.0, latched=False)
    at_s = np.array([3.9, 4.1, 5.9, 6.1, 7.9, 8.1, 9.9, 10.1, 17.9, 18.1])
    assert seen.at(at_s) == pytest.approx([60.0, -40.0, -40.0, 60.0, 60.0, -40.0, -40.0, 60.0, 60.0, -40.0])


@pytest.mark.parametrize(("phase", "before", "begins_s"), [(0.0, -0.1, 0.0), (0.25, 2.4, 2.5), (-0.25, 7.4, 7.5)])
def test_pulses_that_begin_with_the_record_begin_from_rest(phase, before, begins_s):
    held = HeldInput(np.array([0.0]), np.array([0.0]))  # 40 %
    seen = pulses(held, 40.0, 100.0, 10.0, phase, 30.0, before=0)
    at_s = np.array([-30.0, before, begins_s + 0.1, begins_s + 3.9, begins_s + 4.1, begins_s + 10.1])
    assert seen.at(at_s) == pytest.approx([0.0, 0.0, 60.0, 60.0, -40.0, 60.0])


@pytest.mark.parametrize("period_s", [3.0, 8.0, 23.0])
def test_pulses_are_those_of_the_simulator(period_s):
    """Its position is the mean over a step of 0.05 s; the first period begins at rest, with the record."""
    random, step_s = np.random.default_rng(5), 0.05
    at, levels_of = np.append(0.0, np.cumsum(random.uniform(1.0, 9.0, 20))), random.uniform(-30.0, 30.0, 21)
    held = HeldInput(at, np.append(0.0, levels_of[1:]))
    simulated = TimeProportioned(period_s)
    simulated.rest(40.0)
    times = np.arange(0.0, 90.0, step_s)
    theirs = [simulated.act(float(held.at(np.array([t]))[0]) + 40.0, step_s) for t in times]
    ours = pulses(held, 40.0, 100.0, period_s, 0.0, 95.0)
    fine = np.arange(0.0, 90.0, step_s / 20.0) + step_s / 40.0
    means = ours.at(fine).reshape(-1, 20).mean(axis=1) + 40.0
    # A move within the step in which a period begins counts in the next one there.
    assert np.mean(np.abs(means - theirs) > 5.1) < 0.01


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_an_output_at_an_end_is_not_switched(share):
    held = HeldInput(np.array([0.0]), np.array([0.0]))
    seen = pulses(held, share, 1.0, 10.0, 0.3, 50.0)
    assert seen.at(np.linspace(0.0, 50.0, 101)) == pytest.approx(np.zeros(101))


def switched(period, first):
    """Return an actuator that is on for a share of each period: `first` or further commands of it count."""
    latch = {"turn": -1, "share": 0.0}

    def position(u, t):
        turn = math.floor(t / period + 1e-9)
        if turn > latch["turn"] or not first:
            latch.update(turn=turn, share=u / 100.0)
        return 100.0 if t - turn * period < latch["share"] * period - 1e-9 else 0.0

    return position


@pytest.mark.parametrize(("first", "form"), [(True, ""), (False, "by a carrier")])
def test_a_switched_output_is_named(first, form, among):
    """Its ripple has the size of the response to the moves."""
    among("time_proportioning", "periodic_disturbance", "actuator_hold", "ambient")
    # pulses end at steps of Euler's method
    output = np.round(levels(np.random.default_rng(21), 600, 7, 40) / 5.0) * 5.0
    noise = np.random.default_rng(3).normal(0.0, 0.1, output.size)
    pv = integrated(output, switched(8.0, first))
    found = diagnose(Recording(np.arange(output.size, dtype=float), output, pv + noise))
    (effect,) = found.effects
    assert (effect.name, effect.form, found.verdict) == ("time_proportioning", form, "explained")
    assert effect.parameters["period_s"] == pytest.approx(8.0, rel=1e-3)
    assert pytest.approx(2.0, rel=0.02) == found.process.K


@pytest.mark.parametrize("moved", [-45.0, 70.0])
def test_an_output_of_another_range_is_not_taken_for_switched(moved):
    """A negative output, or one above 100, is no share of a period."""
    output = levels(np.random.default_rng(21), 300, 7, 40)
    recording = Recording(np.arange(300.0), output + moved, integrated(output, switched(8.0, first=True)))
    dataset = dataset_of(recording)
    assert time_proportioning(dataset, [dataset.data.pv]) == ()


def test_it_conforms():
    def make(dataset, _base):
        angle = 2.0 * math.pi * dataset.data.t / dataset.span_s
        ripple = np.sin(20.0 * angle)
        return [
            replace(e, name="relay", other_forms=tuple(replace(form, name="relay") for form in e.other_forms))
            for e in time_proportioning(dataset, [ripple])
        ]

    assert check_effect(EffectPlugin("relay", make, "switched every {period_s:.3g} s")) == []
