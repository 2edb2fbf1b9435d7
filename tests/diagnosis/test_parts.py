"""Fit, selection and test: nothing is chosen by the test part, and one figure counts for all."""

import functools
import json

import numpy as np
import pytest
from scipy.optimize import least_squares

from autotuner import Recording, diagnose
from autotuner.core.diagnosis.record.parts import parts_of
from autotuner_sim import Backlash, LoadStep
from tests.diagnosis.cases import PLANTS, tuning_record

RECORDS = {
    "explained": {"actuators": [Backlash(3.0)]},
    "loaded": {"loads": [LoadStep(120.0, -3.0)]},
    "adequate": {},
}


def tampered(recording, rows, how):
    pv, output = recording.pv.copy(), recording.output.copy()
    if how == "shifted":
        pv[rows] += 3.0 * np.std(pv)
    elif how == "noise":
        pv[rows] = np.random.default_rng(5).normal(pv.mean(), 5.0 * np.std(pv), pv[rows].size)
    else:
        pv[rows] = pv[rows][::-1]
        if recording.segments:  # without a tail, the division follows from the output
            output[rows] = output[rows][::-1]
    return Recording(recording.t, output, pv, settings=recording.settings)


def what_was_chosen(found):
    told = found.to_dict()
    kept = {name: told[name] for name in ("verdict", "effects", "model", "gains", "runner_up")}
    return json.dumps(kept), told["error"]["fitted"], told["error"]["selection"]


HOWS = ("shifted", "noise", "reversed")


@functools.cache
def diagnosed(name, *, settings):
    """Return one of the records, with its settings or as a plain file, and its diagnosis."""
    record = tuning_record(PLANTS["balanced"], sigma=0.05, seed=7, **RECORDS[name])
    record = record if settings else Recording(record.t, record.output, record.pv)
    return record, diagnose(record)


@pytest.mark.parametrize(("name", "settings", "hows"), [
    pytest.param("explained", True, HOWS[:1], id="explained-tuning"),
    pytest.param("adequate", True, HOWS, id="adequate-tuning", marks=pytest.mark.long),
    pytest.param("adequate", False, HOWS, id="adequate-csv"),
    pytest.param("explained", True, HOWS[1:], id="explained-tuning-otherwise", marks=pytest.mark.long),  # as the others
    pytest.param("explained", False, HOWS, id="explained-csv", marks=pytest.mark.long),
    pytest.param("loaded", True, HOWS, id="loaded-tuning", marks=pytest.mark.long),
    pytest.param("loaded", False, HOWS, id="loaded-csv", marks=pytest.mark.long),
])  # fmt: skip
def test_tampering_with_the_test_part_changes_nothing_but_its_error(name, settings, hows, among):
    among("backlash", "saturation", "load_step")
    if name == "explained":
        diagnosed.cache_clear()  # what was found in another catalogue
    record, found = diagnosed(name, settings=settings)
    rows = parts_of(record).tested
    assert rows.stop - rows.start > 10
    for how in hows:
        other = diagnose(tampered(record, rows, how))
        assert what_was_chosen(other) == what_was_chosen(found)
        assert other.error["held_out"] != found.error["held_out"]


def test_the_parts_follow_the_stated_rule():
    record = tuning_record(PLANTS["lag"], sigma=0.05)
    tail = record.settings["segments"]["tail"]
    assert parts_of(record).test_from_s == pytest.approx(0.3 * tail + 0.7 * record.t[-1] - record.t[0], abs=0.5)
    plain = Recording(record.t, record.output, record.pv)
    # Its tail stays further out, at 46 and 34 of output, than the staircase did.
    assert parts_of(plain).test_from_s == pytest.approx(0.9 * (record.t[-1] - record.t[0]), abs=0.5)


@pytest.mark.usefixtures("without_gains")
def test_an_unused_column_changes_no_figure(among):
    among("backlash", "measured_disturbance", "load_step")
    record = tuning_record(PLANTS["balanced"], sigma=0.05, seed=3, actuators=[Backlash(3.0)])
    plain = Recording(record.t, record.output, record.pv)
    column = {"humidity": np.random.default_rng(1).normal(50.0, 1.0, record.t.size)}
    beside = Recording(record.t, record.output, record.pv, extra=column)
    assert diagnose(beside).error == diagnose(plain).error


def test_errors_are_those_of_the_pictures():
    """The figure is the root mean square of measured minus simulated PV, computed here from the curves."""
    _, found = diagnosed("explained", settings=True)
    curves = found.traces
    tested = curves.t >= curves.held_out_from_s
    for name, simulated in (("before", curves.before), ("after", curves.after)):
        expected = np.sqrt(np.mean((curves.pv - simulated)[tested] ** 2))
        assert getattr(found.error["held_out"], name) == pytest.approx(expected, rel=1e-6)


def test_the_reported_process_is_fitted_to_all_that_comes_before_the_test_part():
    """The judge is a fit of the closed form of steps through a lag with a dead time, by another library."""
    t, moves_s = np.arange(600.0), np.arange(20.0, 600.0, 29.0)
    random = np.random.default_rng(11)
    steps = np.diff(random.choice([-8.0, -3.0, 3.0, 8.0], moves_s.size), prepend=0.0)
    since = t[:, None] - moves_s

    def simulated(numbers):
        K, T, D, offset = numbers
        return offset + K * ((1.0 - np.exp(-np.maximum(since - D, 0.0) / T)) @ steps)

    output = 40.0 + (since >= 0.0) @ steps
    pv = simulated([1.7, 14.0, 3.3, 60.0]) + random.normal(0.0, 0.4, t.size)

    def fitted(rows):
        left = least_squares(lambda numbers: (simulated(numbers) - pv)[rows], [1.5, 12.0, 3.0, 59.0], xtol=1e-12)
        return left.x[:3]

    found = diagnose(Recording(t, output, pv))
    assert found.verdict == "adequate"
    reported = [found.process.parameters()[name] for name in ("K", "T", "D")]
    tested_from = parts_of(Recording(t, output, pv)).tested.start
    assert reported == pytest.approx(fitted(slice(tested_from)), rel=2e-3)
    assert reported != pytest.approx(fitted(slice(tested_from * 3 // 4)), rel=2e-3)
