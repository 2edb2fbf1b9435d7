"""Disturbances, sensor errors and free forms against the simulator's loads and offsets, and closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy
from hypothesis import example, given
from hypothesis import strategies as st

from autotuner.core.diagnosis.effects.disturbance import (
    behind_a_lag,
    disturbance_effects,
    load_at_the_input,
)
from autotuner.core.diagnosis.effects.free_forms import _splines, _turns, free_forms
from autotuner.core.diagnosis.effects.jumps import jump_moments
from autotuner.core.diagnosis.effects.process.gain_in_time import gains_in_time, times_curve
from autotuner.core.diagnosis.effects.sawtooth import RegularJumps, sawtooth
from autotuner.core.diagnosis.effects.waves import lines_of_all, spectral_lines, wave_at_the_input
from autotuner.core.diagnosis.extended.effect import Seen
from autotuner.core.diagnosis.extended.fitting import tangent
from autotuner.core.diagnosis.record.dataset import dataset_of
from autotuner.core.model.zoh_input import HeldInput
from autotuner.core.recording import Recording
from autotuner_sim import (
    BiasStep,
    CurvedDrift,
    Drift,
    LoadRamp,
    LoadStep,
    Measured,
    PeriodicLoad,
    PeriodicOffset,
)
from tests.diagnosis.simulated import (
    INTEGRATOR,
    LAG,
    PAIR,
    PV0,
    RINGING,
    at_the_truth,
    left,
    moves,
    of_form,
    record,
)

SPAN_S = 299.0
PLANTS = [LAG, PAIR, RINGING, INTEGRATOR]


def effects_of(recording):
    dataset = dataset_of(recording)
    return (*disturbance_effects(dataset, [dataset.data.pv], []), *free_forms(dataset), *gains_in_time(dataset))


def with_effect(recording, plant, key, p):
    """Return the plant's model with an effect of the catalogue; the first of two that share a form."""
    effect = next(effect for effect in effects_of(recording) if effect.key == key)
    return at_the_truth(recording, plant, (effect, p))


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize(("at_s", "size"), [(70.0, 3.0), (160.4, -5.0)])
def test_a_load_step_is_the_simulators(plant, at_s, size):
    """At the input of the process, not behind the dead time."""
    recording = record(plant, moves(), loads=[LoadStep(at_s, size)])
    fitted = with_effect(recording, plant, "load_step", (at_s / SPAN_S,))
    assert left(fitted) < 1e-9
    assert left(at_the_truth(recording, plant)) > 0.02
    assert fitted.sizes() == [pytest.approx({"at_s": at_s, "size": size})]


@pytest.mark.parametrize("plant", PLANTS)
def test_a_load_at_the_input_is_the_same_with_its_size_searched_for(plant):
    recording = record(plant, moves(), loads=[LoadStep(90.5, 4.0)])
    dataset = dataset_of(recording)
    effect = load_at_the_input(dataset)
    fitted = at_the_truth(recording, plant, (effect, (90.5 / SPAN_S, 4.0 / dataset.swing)))
    assert left(fitted) < 1e-9
    assert fitted.sizes() == [pytest.approx({"at_s": 90.5, "size": 4.0})]
    assert left(at_the_truth(recording, plant, (effect, (90.5 / SPAN_S, 0.0)))) > 0.02


def test_a_load_that_comes_before_the_first_arrival_is_felt_at_once():
    """At 3.5 s, before any move of the output."""
    recording = record(LAG, moves(), loads=[LoadStep(3.5, 4.0)])
    effect = load_at_the_input(dataset_of(recording))
    assert left(at_the_truth(recording, LAG, (effect, (3.5 / SPAN_S, 0.25)))) < 1e-9


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize(("begins_s", "lasts_s"), [(60.0, 30.0), (200.5, 40.2)])
def test_a_load_that_ends_again_is_two_steps(plant, begins_s, lasts_s):
    loads = [LoadStep(begins_s, 4.0), LoadStep(begins_s + lasts_s, -4.0)]
    recording = record(plant, moves(), loads=loads)
    fitted = with_effect(recording, plant, "load_step:ends again", (begins_s / SPAN_S, lasts_s / SPAN_S))
    assert left(fitted) < 1e-9
    assert left(at_the_truth(recording, plant)) > 0.02
    assert fitted.sizes() == [pytest.approx({"size": 4.0, "at_s": begins_s, "lasts_s": lasts_s})]


@pytest.mark.parametrize("plant", PLANTS)
def test_a_load_that_rises_slowly_is_the_simulators(plant):
    """20 small steps of ours, 100 of the simulator's."""
    recording = record(plant, moves(), loads=[LoadRamp(80.0, 5.0, 60.0)])
    fitted = with_effect(recording, plant, "load_step:ramp", (80.0 / SPAN_S, 60.0 / SPAN_S))
    assert left(fitted) < 5e-3
    assert left(at_the_truth(recording, plant)) > 0.05
    assert fitted.sizes()[0] == pytest.approx({"size": 5.0, "at_s": 80.0, "rises_over_s": 60.0}, rel=0.01)


@pytest.mark.parametrize("plant", [LAG, PAIR])
@pytest.mark.parametrize(
    ("key", "p", "offset", "sizes"),
    [
        ("drift", (), Drift(0.03), {"pv_per_s": 0.03}),
        ("drift:late", (100.0 / SPAN_S,), Drift(-0.05, 100.0), {"pv_per_s": -0.05, "from_s": 100.0}),
        (
            "drift:settling",
            (math.log(40.0 / SPAN_S), 90.0 / SPAN_S),
            CurvedDrift(6.0, 40.0, 90.0),
            {"pv_in_all": 6.0, "time_constant_s": 40.0, "from_s": 90.0},
        ),
        ("bias_step", (120.5 / SPAN_S,), BiasStep(120.5, 3.0), {"at_s": 120.5, "size": 3.0}),
    ],
)
def test_what_adds_to_the_pv_is_the_simulators(plant, key, p, offset, sizes):
    recording = record(plant, moves(), offsets=[offset])
    fitted = with_effect(recording, plant, key, p)
    assert left(fitted) < 1e-9
    assert left(at_the_truth(recording, plant)) > 0.02
    assert fitted.sizes() == [pytest.approx(sizes)]


@pytest.mark.parametrize(("size", "is_one"), [(0.39, False), (-0.39, False), (0.41, True), (-0.41, True)])
def test_a_jump_of_a_reading_that_is_rounded_to_two_fifths_is_larger_than_that(size, is_one):
    """Two steady values may each be rounded by half a step, to either side."""
    exact = record(PAIR, moves(), offsets=[BiasStep(120.5, 3.0)])
    dataset = dataset_of(Recording(exact.t, exact.output, 0.4 * np.round(exact.pv / 0.4)))
    rounded = replace(dataset, grid_noise=0.4 / math.sqrt(12.0))
    for known, expected in ((rounded, is_one), (dataset, True)):
        jump = of_form(disturbance_effects(known, [known.data.pv], []), "bias_step")
        assert jump.means((0.5,), (size,), 1.0, ()) is expected


def test_a_jump_there_and_back_is_two_of_the_simulators():
    recording = record(PAIR, moves(), offsets=[BiasStep(100.5, 2.0), BiasStep(140.5, -2.0)])
    fitted = with_effect(recording, PAIR, "bias_step:there and back", (100.5 / SPAN_S, 40.0 / SPAN_S))
    assert left(fitted) < 1e-9
    assert left(at_the_truth(recording, PAIR)) > 0.02
    assert fitted.sizes() == [pytest.approx({"size": 2.0, "at_s": 100.5, "lasts_s": 40.0})]


@pytest.mark.parametrize("plant", [LAG, PAIR])
@pytest.mark.parametrize("phase_s", [0.0, 5.0])
def test_a_wave_on_the_pv_is_the_simulators(plant, phase_s):
    recording = record(plant, moves(), offsets=[PeriodicOffset(1.5, 23.0, phase_s=phase_s)])
    fitted = with_effect(recording, plant, "periodic_disturbance", (math.log(SPAN_S / 23.0),))
    assert left(fitted) < 1e-9
    assert left(at_the_truth(recording, plant)) > 0.02
    assert fitted.sizes() == [pytest.approx({"period_s": 23.0, "amplitude": 1.5})]


@pytest.mark.parametrize("plant", [LAG, PAIR])
def test_a_wave_at_the_input_is_one_on_the_pv_behind_the_process(plant):
    """A sine of the load passes the lags of the process: |G| = K/prod sqrt(1 + (w T)^2). A free motion at first."""
    recording = record(plant, moves(), loads=[PeriodicLoad(5.0, 31.0)])
    w = 2.0 * math.pi / 31.0
    lags = [plant.T] if plant is LAG else [plant.T1, plant.T2]
    gain = plant.K / math.prod(math.hypot(1.0, w * T) for T in lags)
    effect = of_form(effects_of(recording), "periodic_disturbance")
    free = at_the_truth(recording, plant, (effect, (math.log(SPAN_S / 31.0),)), background=("offset", "state"))
    assert left(free) < 2e-3
    assert free.sizes()[0]["amplitude"] == pytest.approx(5.0 * gain, rel=1e-2)


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize(("shape", "accuracy"), [("sine", 0.002), ("square", 1e-9)])
@pytest.mark.parametrize("phase_s", [0.0, 6.0])
def test_a_load_that_swings_or_is_switched_is_the_simulators(plant, shape, accuracy, phase_s):
    """A sine is written in steps here and there; a square wave changes at the same times."""
    recording = record(plant, moves(), loads=[PeriodicLoad(5.0, 24.0, shape, phase_s=phase_s)])
    dataset = dataset_of(recording)
    effect = wave_at_the_input(dataset, switched=shape == "square")
    size, phase = 5.0 / dataset.swing, 2.0 * math.pi * phase_s / 24.0
    numbers = (math.log(SPAN_S / 24.0), size * math.cos(phase), size * math.sin(phase))
    fitted = at_the_truth(recording, plant, (effect, numbers))
    assert left(fitted) < accuracy
    assert left(at_the_truth(recording, plant)) > 0.02
    assert fitted.sizes() == [pytest.approx({"period_s": 24.0, "amplitude": 5.0})]


def test_harmonics_are_those_of_a_wave_of_three():
    t = np.arange(300.0)
    angle = 2.0 * np.pi * t / 30.0
    wave = 1.2 * np.cos(angle) + 0.9 * np.sin(angle) + 0.5 * np.sin(2.0 * angle) - 0.4 * np.cos(3.0 * angle)
    alone = record(LAG, moves())
    recording = Recording(t, alone.output, alone.pv + wave)
    fitted = with_effect(recording, LAG, "periodic_disturbance:harmonics", (math.log(SPAN_S / 30.0),))
    assert left(fitted) < 1e-9
    assert fitted.sizes() == [pytest.approx({"period_s": 30.0, "amplitude": 1.5})]
    assert left(with_effect(recording, LAG, "periodic_disturbance", (math.log(SPAN_S / 30.0),))) > 0.02


@pytest.mark.parametrize("size", [2.0, -1.5])
def test_a_sawtooth_begins_from_the_jumps_of_a_residual_and_keeps_them(size):
    """Its ends are straight lines; where the numbers move by less than a sample, no jump crosses one."""
    t = np.arange(300.0)
    wave = size * scipy.signal.sawtooth(2.0 * np.pi * (t - 7.3) / 30.7)
    alone = record(LAG, moves())
    recording = Recording(t, alone.output, alone.pv + wave)
    dataset = dataset_of(recording)
    residual = wave + np.random.default_rng(1).normal(0.0, 0.05, t.size)
    effect = next(e for e in disturbance_effects(dataset, [residual], []) if e.form == "sawtooth")
    ((period_s,),) = effect.starts
    assert period_s == pytest.approx(30.7, abs=0.1)
    fitted = at_the_truth(recording, LAG, (effect, (30.7,)))
    assert left(fitted) < 1e-9
    assert fitted.sizes() == [pytest.approx({"period_s": 30.7, "amplitude": abs(size)})]


@given(st.floats(0.0, 1.0), st.floats(7.0, 40.0), st.integers(0, 2**32 - 1))
@example(0.015625, 7.0, 872)  # twenty jumps away, the median distance is half a period off
def test_a_period_between_its_bounds_places_every_jump_between_its_two_samples(phase, period_s, seed):
    t = np.cumsum(np.random.default_rng(seed).uniform(0.5, 1.5, 300))
    jumps = RegularJumps.of(t, np.floor(t / period_s - phase) + 1e-6 * t)
    assert jumps is not None
    assert jumps.shortest_s <= period_s * (1.0 + 1e-12)
    assert jumps.longest_s >= period_s * (1.0 - 1e-12)
    for share in (0.0, 0.3, 1.0):
        between_s = jumps.shortest_s + share * (jumps.longest_s - jumps.shortest_s)
        times = jumps.first_s(between_s) + jumps.turns * between_s
        assert np.all(times >= jumps.before_s - 1e-9)
        assert np.all(times <= jumps.after_s + 1e-9)


def test_the_jumps_of_a_sawtooth_are_seen_again_on_more_samples():
    """The longer they are, the narrower is what they leave of the period."""
    t = np.arange(600.0)
    wave = 2.0 * scipy.signal.sawtooth(2.0 * np.pi * (t - 7.3) / 29.37)
    alone = record(LAG, moves(600))
    dataset = dataset_of(Recording(t, alone.output, alone.pv + wave))
    noise = np.random.default_rng(1).normal(0.0, 0.05, t.size)
    (few,) = sawtooth(dataset, [wave + noise])
    seen = few.seen_again(Seen(None, np.arange(t.size), wave + noise, 1.0))
    (low, high), (least, most) = ((e.searched[0].low, e.searched[0].high) for e in (few, seen))
    assert low <= least <= 29.37 <= most <= high
    assert most - least < high - low
    assert few.seen_again(Seen(None, np.arange(t.size), noise, 1.0)) is None


@pytest.mark.parametrize("irregular", [0.0, 4.0])
def test_jumps_at_unequal_distances_or_of_both_signs_are_no_sawtooth(irregular):
    t = np.arange(300.0)
    alone = record(LAG, moves())
    at_s = np.arange(5.5, 300.0, 20.0) + irregular * np.random.default_rng(2).uniform(-1.0, 1.0, 15)
    steps = np.searchsorted(at_s, t).astype(float)
    wave = (steps % 2.0) if irregular == 0.0 else steps - t / 20.0
    dataset = dataset_of(Recording(t, alone.output, alone.pv + wave))
    residual = wave + np.random.default_rng(1).normal(0.0, 0.02, t.size)
    assert all(e.form != "sawtooth" for e in disturbance_effects(dataset, [residual], []))


def test_a_wave_that_grows_has_its_amplitude_at_the_end():
    t = np.arange(300.0)
    alone = record(LAG, moves())
    recording = Recording(t, alone.output, alone.pv + (0.5 + 1.5 * t / SPAN_S) * np.sin(2.0 * np.pi * t / 30.0))
    fitted = with_effect(recording, LAG, "periodic_disturbance:growing", (math.log(SPAN_S / 30.0),))
    assert left(fitted) < 1e-9
    assert fitted.sizes() == [pytest.approx({"period_s": 30.0, "amplitude": 2.0})]


def test_a_wave_that_begins_within_the_record():
    t = np.arange(300.0)
    alone = record(LAG, moves())
    wave = np.where(t > 110.5, np.sin(2.0 * np.pi * (t - 110.5) / 20.0), 0.0)
    recording = Recording(t, alone.output, alone.pv + 2.0 * wave)
    fitted = with_effect(recording, LAG, "periodic_disturbance:begins", (math.log(SPAN_S / 20.0), 110.5 / SPAN_S))
    assert left(fitted) < 1e-9
    assert left(at_the_truth(recording, LAG)) > 0.02
    assert fitted.sizes() == [pytest.approx({"period_s": 20.0, "amplitude": 2.0, "from_s": 110.5})]


def measured_record(plant, signal, name="feed", **physics):
    recording = record(plant, moves(), **physics)
    return Recording(recording.t, recording.output, recording.pv, extra={name: signal})


@pytest.mark.parametrize("lag_s", [0.5, 15.0])
@pytest.mark.parametrize(("name", "effect"), [("feed", "measured_disturbance"), ("T_outside", "ambient")])
def test_a_measured_disturbance_is_the_simulators(lag_s, name, effect):
    t = np.arange(300.0)
    signal = 20.0 + 3.0 * np.sin(t / 25.0) + 0.02 * t
    recording = measured_record(LAG, signal, name, offsets=[Measured(t, signal, 0.8, lag_s)])
    fitted = with_effect(recording, LAG, f"{effect}:{name}", (math.log(lag_s),))
    assert left(fitted) < 1e-9
    assert left(at_the_truth(recording, LAG)) > 0.02
    assert fitted.sizes() == [pytest.approx({"gain": 0.8, "lag_s": lag_s})]


def steps_of(t):
    return np.where(t < 80.0, 2.0, np.where(t < 190.0, 5.0, 3.0))


def loads_of(gain):
    """Return the loads of a measured signal of few steps, which moves half a sample before it is seen."""
    return [LoadStep(79.5, 3.0 * gain), LoadStep(189.5, -2.0 * gain)]


@pytest.mark.parametrize("plant", [LAG, PAIR])
def test_a_measured_load_passes_the_process(plant):
    recording = measured_record(plant, steps_of(np.arange(300.0)), loads=loads_of(0.7))
    fitted = with_effect(recording, plant, "measured_disturbance:feed into the process", ())
    # A step between two samples is written as half of it at either.
    assert left(fitted) < 2e-3
    assert left(at_the_truth(recording, plant)) > 0.02
    assert fitted.sizes() == [{"gain": pytest.approx(0.7 * plant.K, rel=2e-3)}]


def test_a_polyline_behind_a_lag_is_linear_and_late():
    random = np.random.default_rng(7)
    t = 0.05 * np.cumsum(random.integers(4, 60, 80))
    one, other = random.normal(size=(2, 80))
    whole = behind_a_lag(t, 2.0 * one - 3.0 * other, 5.0)
    assert whole == pytest.approx(2.0 * behind_a_lag(t, one, 5.0) - 3.0 * behind_a_lag(t, other, 5.0))
    at = t[0] + 0.05 * np.arange(round((t[-1] - t[0]) / 0.05) + 1)
    _, exact, _ = scipy.signal.lsim(((1.0,), (5.0, 1.0)), np.interp(at, t, one) - one[0], at - at[0])
    assert behind_a_lag(t, one, 5.0) == pytest.approx(np.interp(t, at, exact), abs=1e-9)


@pytest.mark.parametrize("plant", [LAG, PAIR])
@pytest.mark.parametrize("count", [6, 11])
def test_a_load_along_a_cubic_is_one_of_the_free_ones(plant, count):
    """Splines of the third degree contain it. Ours are written in 120 steps."""
    until, at = 224.0, 0.1 * np.arange(2991)  # the fitted part; the load is constant after it
    x = np.minimum(at, until) / until
    load = 6.0 * x * (1.0 - x) * (1.5 - 2.0 * x)
    denominator = [plant.T, 1.0] if plant is LAG else np.polymul([plant.T1, 1.0], [plant.T2, 1.0])
    _, answer, _ = scipy.signal.lsim(((plant.K,), denominator), load, at)
    alone = record(plant, moves())
    recording = Recording(alone.t, alone.output, alone.pv + answer[::10])
    dataset = dataset_of(recording)
    assert dataset.fitted_until_s == until
    effect = of_form(free_forms(dataset), f"ambient:free, {count} splines")
    fitted = at_the_truth(recording, plant, (effect, ()))
    assert left(fitted) < 5e-3
    assert left(at_the_truth(recording, plant)) > 0.03
    assert fitted.sizes()[0]["range"] == pytest.approx(float(np.ptp(load)), rel=0.05)
    assert fitted.reported_names() == ["ambient"]


@pytest.mark.parametrize("count", [6, 11])
def test_splines_sum_up_to_one_without_the_first(count):
    """Their first, (1 - x/w)^3 of the first piece of width w, stands in the offset."""
    x = np.linspace(0.0, 1.0, 201)
    curves = _splines(x, count)
    pieces = count - 2
    first = np.maximum(1.0 - x * pieces, 0.0) ** 3
    assert curves.shape == (count, x.size)
    assert curves.sum(axis=0) == pytest.approx(1.0 - first, abs=1e-12)


@pytest.mark.parametrize("plant", [LAG, PAIR])
def test_a_gain_that_jumps_is_a_second_plant_from_then_on(plant):
    """The output times a step at 150.3 s, a dead time later there, of 30 %: a level that stands jumps, too."""
    at_s, u = 150.3, moves()
    fine = np.repeat(u, 10) * (np.arange(3000) * 0.1 >= at_s - 1e-9)
    more = record(plant, fine, sample_s=0.1)
    alone = record(plant, u)
    recording = Recording(alone.t, alone.output, alone.pv + 0.3 * (more.pv[::10] - PV0))
    fitted = with_effect(recording, plant, "gain_drift:jump", ((at_s + plant.D) / SPAN_S,))
    assert left(fitted) < 1e-9
    assert left(at_the_truth(recording, plant)) > 0.02
    assert fitted.sizes() == [pytest.approx({"relative_change": 0.3, "at_s": at_s + plant.D})]


def test_a_gain_along_straight_pieces_is_a_free_one():
    """A change at the knots, at thirds of the fitted part, of 0.2, -0.1 and 0.4; written in 100 steps."""
    u, until = moves(), 224.0
    fine = np.arange(3000) * 0.1 + LAG.D
    change = np.interp(fine, until * np.array([0.0, 1.0, 2.0, 3.0]) / 3.0, [0.0, 0.2, -0.1, 0.4])
    more = record(LAG, np.repeat(u, 10) * change, sample_s=0.1)
    alone = record(LAG, u)
    recording = Recording(alone.t, alone.output, alone.pv + more.pv[::10] - PV0)
    fitted = with_effect(recording, LAG, "gain_drift:free, 4 knots", ())
    assert left(fitted) < 0.01
    assert left(at_the_truth(recording, LAG)) > 0.05
    change, largest = (fitted.sizes()[0][name] for name in ("relative_change", "largest_relative_change"))
    assert change == pytest.approx(0.4, abs=0.03)
    assert largest == change
    assert fitted.is_meaningful()


def test_an_input_times_a_curve_is_their_product_at_any_time():
    random = np.random.default_rng(5)
    held = HeldInput(np.append(0.0, np.sort(random.uniform(0.0, 100.0, 30))), np.append(0.0, random.normal(size=30)))
    times, curve = np.append(0.0, np.sort(random.uniform(0.0, 100.0, 9))), random.normal(size=10)
    product = times_curve(held, 100.0, 100.0, lambda t: curve[np.searchsorted(times, t, side="right") - 1], times)
    for t in random.uniform(0.0, 120.0, 60):
        level, factor, ours = (
            of[np.searchsorted(at, t, side="right") - 1]
            for at, of in ((held.times, held.levels), (times, curve), (product.times, product.levels))
        )
        assert ours == pytest.approx(level * factor)


@pytest.mark.parametrize("turns", [0, 1, 4, 9])
def test_a_wave_turns_twice_a_period(turns):
    x = np.linspace(0.0, (turns + 1) * math.pi, 2001)
    assert _turns(np.cos(x), 0.5) == turns
    assert _turns(0.2 * np.cos(x), 0.5) == 0


@pytest.mark.parametrize("period_s", [11.0, 23.0, 41.0])
def test_the_strongest_line_is_the_waves(period_s):
    """To a third of a period per record, from a residual of two waves and a line."""
    t = np.arange(300.0)
    dataset = dataset_of(record(LAG, moves()))
    wave = 2.0 * np.sin(2.0 * np.pi * t / period_s) + 0.5 * np.sin(2.0 * np.pi * t / 6.0)
    lines = spectral_lines(dataset, wave)
    assert lines[0] == pytest.approx(SPAN_S / period_s, abs=0.34)
    assert any(line == pytest.approx(SPAN_S / 6.0, abs=0.34) for line in lines)


def test_a_line_that_one_residual_alone_shows_is_tried_too():
    t = np.arange(300.0)
    dataset = dataset_of(record(LAG, moves()))
    seen = lines_of_all(dataset, [np.sin(2.0 * np.pi * t / 30.0), np.sin(2.0 * np.pi * t / 9.0)])
    assert any(line == pytest.approx(SPAN_S / 9.0, abs=0.34) for line in seen)
    assert len(seen) <= 8


def likeliest_jump(recording):
    """Return the sample from which a step of the reading lowers a plain least squares most, and ours."""
    base = at_the_truth(recording, LAG)
    columns, slopes = tangent(base.problem, base.theta)
    rows = np.flatnonzero(base.problem.dataset.fitted)
    pv = base.problem.dataset.data.pv[rows]

    def misfit(k):
        tried = np.column_stack((columns[rows], slopes[rows], np.arange(rows.size) >= k))
        return float(np.linalg.norm(pv - tried @ np.linalg.lstsq(tried, pv, rcond=None)[0]))

    return min(range(5, rows.size), key=misfit), jump_moments(base)


@pytest.mark.parametrize("at_s", [70.5, 130.5, 200.5])
def test_a_jump_beside_a_process_is_the_likeliest_of_all_moments(at_s):
    noise = np.random.default_rng(4).normal(0.0, 0.05, 300)
    alone = record(LAG, moves(), offsets=[BiasStep(at_s, 0.5)])
    best, moments = likeliest_jump(Recording(alone.t, alone.output, alone.pv + noise))
    assert moments[0] == best - 0.5 == at_s


@pytest.mark.parametrize("seed", range(5))
def test_without_a_jump_the_likeliest_moment_is_that_of_a_plain_least_squares(seed):
    """Noise that wanders: near an end, and where the process moves, a step has little of its own."""
    random = np.random.default_rng(seed)
    alone = record(LAG, moves())
    noise = np.cumsum(random.normal(0.0, 0.02, 300)) + random.normal(0.0, 0.05, 300)
    best, moments = likeliest_jump(Recording(alone.t, alone.output, alone.pv + noise))
    assert moments[0] == best - 0.5
    assert np.abs(np.diff(moments)).min() >= 5.0
