"""Closed loops that an unmeasured load moves as much as the set point does: the simulator's plants are the truth."""

import numpy as np
import pytest

from autotuner import Recording, diagnose
from autotuner.core.identification import identify
from autotuner_sim.plants import Fopdt
from autotuner_sim.stepped import SteppedPlant

SET_POINT = (0.0, 2.0, 0.0, -2.0, 1.0)
SEEDS = range(41, 46)


def loop_record(seed, **given):
    return loop_and_load(seed, **given)[0]


def loop_and_load(seed, gain=1.5, lag=15.0, dead_time=5.0, size=0.35, rows=1500, moves=SET_POINT):
    """A PI loop under a load at the input of the plant, an autoregression that forgets within 20 s, and its answer."""
    rng = np.random.default_rng(seed)
    answer, loaded = (SteppedPlant(Fopdt(gain, lag, D)) for D in (dead_time, 0.0))
    load = integral = 0.0
    u, pv, by_load, sp = np.zeros(rows), np.zeros(rows), np.zeros(rows), np.repeat(moves, rows // len(moves))
    for k in range(rows):
        answer.advance(float(k))
        loaded.advance(float(k))
        by_load[k] = loaded.pv
        pv[k] = answer.pv + loaded.pv + rng.normal(0.0, 0.03)
        error = sp[k] - pv[k]
        integral += error / 20.0
        u[k] = 1.8 / gain * (error + integral)
        load = 0.95 * load + rng.normal(0.0, size)
        answer.output, loaded.output = float(u[k]), load / gain
    return Recording(np.arange(float(rows)), 50.0 + u, 100.0 + pv, 100.0 + sp), by_load


@pytest.mark.parametrize("gain", [1.5, pytest.param(-2.0, marks=pytest.mark.long)])
def test_the_gain_of_a_process_is_found_beside_a_load_as_large_as_the_moves_of_the_set_point(gain):
    answers = [identify(loop_record(seed, gain=gain), profile=False) for seed in SEEDS]
    assert all(answer.model is not None and answer.model.K * gain > 0.0 for answer in answers)
    ends = [answer.estimates["least_squares"].interval95["K"] for answer in answers]
    assert sum(low <= gain <= high for low, high in ends) >= 4
    assert np.median([abs(answer.model.K / gain - 1.0) for answer in answers]) < 0.15


def test_a_load_that_nobody_recorded_is_reported_with_its_size():
    record, by_load = loop_and_load(41)
    answer = identify(record, profile=False)
    note = next(text for text in answer.warnings if "not recorded" in text)
    reported = float(note.split("moves the PV by ")[1].split(" ")[0])
    assert reported == pytest.approx(np.std(by_load), rel=0.2)
    assert not answer.is_a_guess


def test_without_a_move_of_the_set_point_no_process_is_claimed_beside_the_load():
    answer = identify(loop_record(41, moves=(0.0,)), profile=False)
    assert answer.model is None or answer.is_a_guess
    assert not any("not recorded" in text for text in answer.warnings)


def test_a_requested_structure_stays_the_one_requested():
    answer = identify(loop_record(42), structure="sopdt_overdamped", profile=False)
    assert answer.model is None or answer.model.structure == "sopdt_overdamped"


@pytest.mark.long
def test_loops_with_coloured_load_are_adequate_and_get_the_gains_of_their_process():
    answers = [diagnose(loop_record(seed)) for seed in SEEDS]
    assert [answer.verdict for answer in answers] == ["adequate"] * len(answers)
    ends = [answer.model["after"]["interval95"]["K"] for answer in answers]
    assert sum(low <= 1.5 <= high for low, high in ends) >= 4
    assert all(answer.gains["after"]["margins"]["stable"] for answer in answers)
    assert all(any("unmeasured disturbance" in note for note in answer.notes) for answer in answers)
