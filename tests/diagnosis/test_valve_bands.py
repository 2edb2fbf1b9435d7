"""Bands of a sticking valve, found from the record of a PI loop. The loops are integrated here, in small steps."""

import math

import numpy as np
import pytest

from autotuner import Recording, diagnose
from autotuner.core.diagnosis.effects.actuator.friction import backlash, stiction
from autotuner.core.diagnosis.effects.disturbance import _drifts
from autotuner.core.diagnosis.effects.free_forms import free_forms
from autotuner.core.diagnosis.extended.base import base_of
from autotuner.core.diagnosis.extended.extended_model import closest_first
from autotuner.core.diagnosis.extended.fit_context import bench_of
from autotuner.core.diagnosis.record.dataset import dataset_of
from autotuner.core.diagnosis.search.joint.friction import with_friction_beside_a_load
from autotuner.core.diagnosis.search.joint.valve_bands import Bands, bands_of, positions
from autotuner.core.model.structures import FOPDT
from autotuner.core.model.zoh_input import HeldInput

pytestmark = pytest.mark.usefixtures("without_gains")

K, T, DELAY, NOISE, SAMPLES, FINE = 1.5, 9.0, 3, 0.02, 700, 20
KP, TI = 0.6, 9.0


def sticking_loop(static, kinetic, seed=1):
    """Return the record of a PI loop whose valve stays until the command is `static` away (He et al., 2007)."""
    noise = NOISE * np.random.default_rng(seed).standard_normal(SAMPLES)
    x = integral = position = 0.0
    waits, u, y = [0.0] * (DELAY * FINE), [], []
    for k in range(SAMPLES):
        y.append(x + noise[k])
        integral -= KP / TI * y[-1]
        u.append(integral - KP * y[-1])
        if abs(u[-1] - position) > static:
            position = u[-1] - math.copysign(kinetic, u[-1] - position)
        for _ in range(FINE):
            waits.append(position + 0.7)  # 0.7: a load from the beginning, which the controller takes away
            x += (K * waits.pop(0) - x) / T / FINE
    return Recording(np.arange(float(SAMPLES)), 50.0 + np.array(u), 100.0 + np.array(y))


def bands_at(record, bands, left):
    dataset = dataset_of(record)
    rows = np.flatnonzero(dataset.fitted)
    return Bands(dataset, np.array(bands) / dataset.swing, np.array(left), rows, ("offset", "state")), dataset


@pytest.mark.parametrize(("band", "left"), [(1.0, 0.0), (1.0, 0.4), (2.0, 2.0)])
def test_positions_are_those_of_one_valve_at_a_time(band, left):
    levels = np.cumsum(np.random.default_rng(3).standard_normal(200))
    held = HeldInput(np.arange(200.0), levels)
    one = backlash(held, 2.0 * band, 0.0) if left == band else stiction(held, band, left)
    at_once = positions(levels, np.array([0.5, band]), np.array([0.1, left]))
    assert at_once[1] == pytest.approx(one.levels)


def test_travels_between_two_slips_are_the_band_and_what_is_left_of_it():
    bands, left = bands_of(np.array([0.3, 0.6]), np.array([0.0, 0.5, 1.0]))
    assert bands * (1.0 + left) == pytest.approx([0.3, 0.3, 0.3, 0.6, 0.6, 0.6])


def test_the_true_bands_leave_noise_and_others_do_not():
    bands, dataset = bands_at(sticking_loop(1.6, 0.6), [1.6, 1.2, 2.0], [0.375, 0.375, 0.375])
    theta = np.array([math.log(T), DELAY / (dataset.span_s / 100.0)])
    left = np.sqrt(bands.squares(FOPDT, theta) / np.count_nonzero(dataset.fitted))
    assert left[0] == pytest.approx(NOISE, rel=0.15)
    assert min(left[1:]) > 3.0 * NOISE


def test_a_process_nearby_is_mended_along_its_tangent():
    bands, dataset = bands_at(sticking_loop(1.6, 0.6), [1.6], [0.375])
    near = np.array([math.log(1.1 * T), (DELAY + 0.3) / (dataset.span_s / 100.0)])
    assert math.sqrt(bands.squares(FOPDT, near)[0] / np.count_nonzero(dataset.fitted)) < 1.3 * NOISE


@pytest.mark.parametrize(("static", "kinetic"), [(1.6, 0.6), pytest.param(1.1, 0.3, marks=pytest.mark.long)])
def test_a_loop_that_cycles_by_its_valve_is_explained_by_the_bands(static, kinetic):
    answer = diagnose(sticking_loop(static, kinetic))
    assert [effect.name for effect in answer.effects] == ["stiction"]
    assert answer.effects[0].parameters["band"] == pytest.approx(static, rel=0.03)
    assert answer.effects[0].parameters["jump"] == pytest.approx(static - kinetic, rel=0.05)
    assert answer.verdict == "explained"


def one_slip():
    """Return the record of a slow PI loop of K = 1.5, T = 3, whose valve waits for 1.2 while its load drifts."""
    noise = 0.01 * np.random.default_rng(3).standard_normal(340)
    x = integral = position = 0.0
    u, y = [], []
    for k, off in enumerate(noise.tolist()):
        y.append(x + off)
        integral -= 0.04 * y[-1]
        u.append(integral - 0.1 * y[-1])
        if abs(u[-1] - position) > 1.2:
            position = u[-1] - math.copysign(0.8, u[-1] - position)
        for _ in range(FINE):
            x += (1.5 * position - 0.0012 * k - x) / 3.0 / FINE
    return Recording(np.arange(340.0), 30.0 + np.array(u), 50.0 + np.array(y))


@pytest.mark.long  # the loop that cycles, above, shows the bands; the next test the drift
def test_a_valve_that_slips_once_is_found_beside_the_drift_that_the_controller_fights():
    context = bench_of(dataset_of(one_slip()))
    base = base_of(context, ("offset", "state"), 0)
    loads = (*_drifts(context.dataset)[:1], *free_forms(context.dataset)[:1])
    found = min(with_friction_beside_a_load(context, base, loads), key=context.on_both_parts)
    assert found.names == ("stiction", "drift")
    assert context.held_out_error(found) < 1.2 * 0.01 < 0.1 * context.held_out_error(base.best)
    band, drift = found.sizes()
    assert band["band"] == pytest.approx(1.2, rel=0.03)
    assert drift["pv_per_s"] == pytest.approx(-0.0012, rel=0.02)


def play_under_a_wave(width=3.0):
    """A lag under PI control whose set point is switched: a valve with play, and a slow wave of the load."""
    rng = np.random.default_rng(5)
    x = integral = position = 0.0
    u, y = [], []
    for k in range(400):
        y.append(x + 0.02 * rng.standard_normal())
        off = 3.0 * (k // 50 % 2) - y[-1]
        integral += 0.06 * off
        u.append(integral + 0.4 * off)
        position = min(max(position, u[-1] - width / 2.0), u[-1] + width / 2.0)
        for _ in range(FINE):
            x += (1.5 * (position + 2.0 * math.sin(2.0 * math.pi * k / 300.0)) - x) / 12.0 / FINE
    return Recording(np.arange(400.0), 30.0 + np.array(u), 50.0 + np.array(y))


@pytest.mark.long  # the loop that cycles shows the bands
def test_play_in_a_loop_is_found_beside_a_load_of_any_shape():
    context = bench_of(dataset_of(play_under_a_wave()))
    base = base_of(context, ("offset", "state"), 0)
    found = closest_first(with_friction_beside_a_load(context, base, free_forms(context.dataset)[:2]))[0]
    assert found.names == ("backlash", "ambient")
    assert found.rms < 1.1 * 0.02 < 0.2 * base.best.rms
    assert found.sizes()[0]["width"] == pytest.approx(3.0, rel=0.03)
