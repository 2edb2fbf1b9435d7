"""Bad records are refused with a remedy, or diagnosed with a note; records of real loops where they are at hand."""

import numpy as np
import pytest

from autotuner import Recording, diagnose
from autotuner.core.diagnosis.extended.repair import require_not_swapped
from autotuner.errors import RecordingError

pytestmark = pytest.mark.usefixtures("without_gains")


def closed_form(size=600, noise=0.05, seed=1):
    """Steps of a lag of 10 s, gain 2: y += (1 - e^{-1/10})(2 u - y)."""
    t = np.arange(float(size))
    output = np.where((t // 60) % 2 == 1, 10.0, 0.0)
    y = np.zeros(size)
    for k in range(1, size):
        y[k] = y[k - 1] + -np.expm1(-0.1) * (2.0 * output[k - 1] - y[k - 1])
    return t, output, 50.0 + y + np.random.default_rng(seed).normal(0.0, noise, size)


@pytest.mark.parametrize("spoil", ["output", "pv"])
def test_what_never_moves_is_refused_with_a_remedy(spoil):
    t, output, pv = closed_form()
    columns = {"output": output, "pv": pv, spoil: np.full(t.size, 3.0)}
    with pytest.raises(RecordingError) as refused:
        diagnose(Recording(t, columns["output"], columns["pv"]))
    assert refused.value.remedy


def test_an_output_acts_from_when_it_was_written():
    """Up to 0.9 s after its sample, as over a slow line: the process answers from then on, and nothing is missing."""
    rng = np.random.default_rng(5)
    t = np.arange(600.0)
    output = np.where((t // 60) % 2 == 1, 10.0, 0.0)
    written_s = t + np.where(np.diff(output, prepend=0.0) != 0.0, rng.uniform(0.1, 0.9, t.size), 0.0)
    since_s = np.maximum(t[:, None] - written_s, 0.0)
    pv = 50.0 + (1.0 - np.exp(-since_s / 10.0)) @ (2.0 * np.diff(output, prepend=0.0)) + rng.normal(0.0, 0.02, t.size)
    found = diagnose(Recording(t, output, pv, written_s=written_s))
    assert found.verdict == "adequate"
    assert pytest.approx(10.0, rel=0.005) == found.process.T
    assert found.traces.output == pytest.approx(output)


@pytest.mark.parametrize("at", [0, 200])
def test_one_wild_reading_is_named_and_changes_no_number(at):
    """At the beginning it is no state that the process comes from."""
    t, output, pv = closed_form()
    clean, pv[at] = diagnose(Recording(t, output, pv.copy())), pv[at] + 20.0
    found = diagnose(Recording(t, output, pv))
    assert clean.verdict == "adequate"
    assert [effect.name for effect in found.effects] == ["outliers"]
    assert found.effects[0].parameters["samples"] == 1.0
    assert pytest.approx((2.0, 10.0), rel=0.005) == (found.process.K, found.process.T)


def test_two_samples_are_refused():
    with pytest.raises(RecordingError):
        diagnose(Recording(np.array([0.0, 1.0]), np.array([0.0, 1.0]), np.array([0.0, 1.0])))


@pytest.mark.parametrize("levels", [2, 25])
def test_swapped_columns_are_refused(levels):
    rng = np.random.default_rng(4)
    t = np.arange(900.0)
    output = np.repeat(rng.integers(0, levels, 45), 20) * 10.0 / levels
    y = np.zeros(900)
    for k in range(1, 900):
        y[k] = y[k - 1] + -np.expm1(-0.1) * (2.0 * output[k - 1] - y[k - 1])
    with pytest.raises(RecordingError, match=r"swapped|other way round"):
        diagnose(Recording(t, 50.0 + y + rng.normal(0.0, 0.05, 900), output))


@pytest.mark.parametrize(("Kp", "Ti"), [(0.3, 10.0), (0.1, 20.0), (0.05, 5.0)])
def test_a_coarse_sensor_in_a_loop_is_not_taken_for_swapped_columns(Kp, Ti):
    """A controller follows the PV as smoothly as a process would; the PV goes from one level to the next."""
    rng = np.random.default_rng(0)
    set_point, y, integral, output, pv = np.repeat(rng.uniform(-8.0, 8.0, 5), 100), 0.0, 0.0, [], []
    for wanted in set_point.tolist():
        pv.append(float(round(y + rng.normal(0.0, 0.02))))
        integral += Kp * (wanted - pv[-1]) / Ti
        output.append(Kp * (wanted - pv[-1]) + integral + rng.normal(0.0, 0.05))
        y += -np.expm1(-0.05) * (1.5 * output[-1] - y)
    require_not_swapped(Recording(np.arange(500.0), 40.0 + np.array(output), 60.0 + np.array(pv)))


def test_a_pv_of_few_values_near_its_set_point_is_one():
    """Steps of 2.5 between 60 and 67.5; the same columns without their set point could be either."""
    rng = np.random.default_rng(2)
    set_point, y, integral, output, pv = np.repeat([60.0, 67.5, 60.0, 67.5], 100), 60.0, 0.0, [], []
    for wanted in set_point.tolist():
        pv.append(2.5 * round((y + rng.normal(0.0, 0.3)) / 2.5))
        integral += 0.3 * (wanted - pv[-1]) / 10.0
        output.append(40.0 + 0.3 * (wanted - pv[-1]) + integral + rng.normal(0.0, 0.05))
        y += -np.expm1(-0.05) * (60.0 + 1.5 * (output[-1] - 40.0) - y)
    columns = np.arange(400.0), np.array(output), np.array(pv)
    assert np.unique(pv).size <= 4
    with pytest.raises(RecordingError, match="other way round"):
        diagnose(Recording(*columns))
    found = diagnose(Recording(*columns, set_point=set_point))
    assert found.process is not None


def test_a_gap_is_left_out_with_a_note():
    t, output, pv = closed_form(900)
    kept = (t < 300.0) | (t > 350.0)
    found = diagnose(Recording(t[kept], output[kept], pv[kept]))
    assert found.verdict == "adequate"
    assert any("the longest part" in note for note in found.notes)
    assert found.process is not None
    assert abs(found.process.K - 2.0) < 0.02


def test_a_pv_that_moves_faster_than_the_samples_kept_is_taken_from_a_window():
    t, output, pv = closed_form(400_000)
    found = diagnose(Recording(t, output, pv))
    assert found.verdict == "adequate"
    assert any("moves faster" in note for note in found.notes)
    assert found.process is not None
    assert abs(found.process.K - 2.0) < 0.04


def test_more_samples_than_are_needed_are_thinned_with_a_note():
    t, output, pv = closed_form(20_000)
    found = diagnose(Recording(t, output, pv))
    assert found.verdict == "adequate"
    assert any("samples were used" in note for note in found.notes)


OUTSIDE = ("measured_disturbance", "ambient", "load_step", "drift")


def test_a_measured_disturbance_is_taken_in_with_its_gain(among):
    among(*OUTSIDE)
    t, output, pv = closed_form(360)
    outside = 3.0 * np.sin(t / 45.0)
    found = diagnose(Recording(t, output, pv + 0.7 * outside, extra={"room": outside}))
    assert [effect.name for effect in found.effects] == ["ambient"]
    assert found.effects[0].parameters["gain"] == pytest.approx(0.7, rel=0.02)


@pytest.mark.long  # one column is in the test above
def test_of_two_columns_that_tell_the_same_the_better_one_is_taken_in(among):
    among(*OUTSIDE)
    t, output, pv = closed_form(360)
    outside = 3.0 * np.sin(t / 45.0)
    rough = outside + np.random.default_rng(5).normal(0.0, 1.0, t.size)
    found = diagnose(Recording(t, output, pv + 0.7 * outside, extra={"rough": rough, "room": outside}))
    assert [effect.form for effect in found.effects] == ["room"]
    assert any(note.startswith("column rough is not taken in") for note in found.notes)


@pytest.mark.long  # test_parts has an unused column
def test_a_column_that_does_nothing_is_not_taken_in_and_the_reader_is_told(among):
    among(*OUTSIDE)
    t, output, pv = closed_form()
    load = np.where(t > 250.0, 4.0, 0.0)
    elsewhere = np.random.default_rng(6).normal(0.0, 1.0, t.size).cumsum()
    found = diagnose(Recording(t, output, pv + load, extra={"elsewhere": elsewhere}))
    assert "measured_disturbance" not in {effect.name for effect in found.effects}
    assert any(note.startswith("column elsewhere is not taken in") for note in found.notes)


def loop(shared, name):
    file = shared / "data" / "valve_stiction" / name
    if not file.is_file():
        pytest.skip(f"{file} is absent")
    titles, *rows = file.read_text(encoding="utf-8-sig").splitlines()
    columns = dict(
        zip(titles.split(","), np.array([row.split(",") for row in rows if row], dtype=float).T, strict=True)
    )
    return Recording(columns["t_s"], columns.get("op_pct", columns.get("op")), columns["pv"])


@pytest.mark.long  # a valve of the independent generator that sticks in a PI loop shows the same
@pytest.mark.parametrize("name", ["isdb_CHEM10.csv"])
def test_a_real_loop_whose_valve_sticks(shared, name):
    assert {"stiction", "backlash"} & {effect.name for effect in diagnose(loop(shared, name)).effects}
