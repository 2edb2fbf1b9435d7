"""Closed loops that an unmeasured load moves as much as the set point does: the simulator's plants are the truth."""

import functools

import numpy as np
import pytest

from autotuner import diagnose
from autotuner.core.identification import identify
from benchmarks.accuracy.cases.loop_with_load import loop_with_load

SEEDS = range(41, 46)


def loop_record(seed, **given):
    return loop_with_load(seed, **given)[0]


@functools.cache
def identified(seed, gain):
    return identify(loop_record(seed, gain=gain), profile=False)


@pytest.mark.parametrize(
    ("gain", "seeds"), [(1.5, SEEDS[:1]), *(pytest.param(gain, SEEDS, marks=pytest.mark.long) for gain in (1.5, -2.0))]
)
def test_the_gain_of_a_process_is_found_beside_a_load_as_large_as_the_moves_of_the_set_point(gain, seeds):
    answers = [identified(seed, gain) for seed in seeds]
    assert all(answer.model is not None and answer.model.K * gain > 0.0 for answer in answers)
    ends = [answer.estimates["least_squares"].interval95["K"] for answer in answers]
    assert sum(low <= gain <= high for low, high in ends) >= max(len(seeds) - 1, 1)
    assert np.median([abs(answer.model.K / gain - 1.0) for answer in answers]) < 0.15


def test_a_load_that_nobody_recorded_is_reported_with_its_size():
    _, by_load = loop_with_load(41)
    answer = identified(41, 1.5)
    note = next(text for text in answer.warnings if "not recorded" in text)
    reported = float(note.split("moves the PV by ")[1].split(" ")[0])
    assert reported == pytest.approx(np.std(by_load), rel=0.2)
    assert not answer.is_a_guess


def test_without_a_move_of_the_set_point_no_process_is_claimed_beside_the_load():
    answer = identify(loop_record(41, set_point=(0.0,)), profile=False)
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
    assert all(any("blind to play" in note or "sticking" in note for note in answer.notes) for answer in answers)
