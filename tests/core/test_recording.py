"""Recordings and their CSV form."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from autotuner.core.recording import Recording, Sample
from autotuner.errors import RecordingError

finite = st.floats(-1e12, 1e12, allow_nan=False)


@given(
    steps=arrays(float, 12, elements=st.floats(1e-6, 1e6)), output=arrays(float, 12, elements=finite), data=st.data()
)
def test_csv_gives_back_the_same_numbers(steps, output, data):
    pv = data.draw(arrays(float, 12, elements=finite))
    original = Recording(np.cumsum(steps), output, pv, extra={"ambient": pv / 2.0})
    back = Recording.from_csv_text(original.to_csv())
    for name in ("t", "output", "pv"):
        assert (getattr(back, name) == getattr(original, name)).all()
    assert (back.extra["ambient"] == pv / 2.0).all()


def test_synonyms_units_time_stamps_and_empty_set_points():
    text = (
        "Timestamp;OP [%];PV (degC);SP\n2026-01-31T12:00:00;1;20;\n2026-01-31T12:00:01.5;2;21;22\n"
        "2026-01-31T12:00:03;2;21.5;22\n"
    )
    recording = Recording.from_csv_text(text)
    assert recording.t.tolist() == [0.0, 1.5, 3.0]
    assert recording.output.tolist() == [1.0, 2.0, 2.0]
    assert np.isnan(recording.set_point[0])
    assert recording.set_point[1] == 22.0


def test_columns_can_be_chosen_by_title_or_number():
    text = "a,b,c,d\n0,1,2,3\n1,1,2,3\n"
    recording = Recording.from_csv_text(text, columns={"t": "a", "output": "c", "pv": "4"})
    assert recording.output.tolist() == [2.0, 2.0]
    assert recording.pv.tolist() == [3.0, 3.0]
    headerless = Recording.from_csv_text("0,5,9\n1,6,8\n", columns={"t": "1", "output": "2", "pv": "3"})
    assert headerless.pv.tolist() == [9.0, 8.0]


def test_rows_without_values_and_repeated_rows_leave_a_note():
    recording = Recording.from_csv_text("t,u,y\n0,1,2\n1,1,\n2,1,nan\n3,1,2\n3,1,2\n4,1,2\n")
    assert recording.t.tolist() == [0.0, 3.0, 4.0]
    assert [note.split(": ")[1].split()[0] for note in recording.notes] == ["2", "1"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        ("\n \n", "is empty"),
        ("t,u\n0,1\n1,1\n", "no column for pv"),
        ("0,1,2\n1,1,2\n", "no titles"),
        ("t,u,y\n0,1,2\n", "two samples"),
        ("t,u,y\n0,1,2\n1,on,3\n", "line 3, column u"),
        ("t,u,y\n0,1,2\n1,1\n", "line 3"),
        ("t,u,y\n0,1,2\n5,1,2\n4,1,3\n", "does not increase at sample 2"),
        ("t,u,y\n0,1,2\nnoon,1,2\n", "line 3, column t"),
        ("t,u,y\n2026-01-31T12:00:00,1,2\nnoon,1,2\n", "ISO 8601"),
        ("t,u,y\n2026-01-31T12:00:00,1,2\n2026-01-31T12:00:01Z,1,2\n", "time zone"),
        ("t,u,y\n0,1,2\n,1,2\n", "no usable time"),
    ],
)
def test_bad_text_names_the_place_and_the_remedy(text, words):
    with pytest.raises(RecordingError, match=words) as caught:
        Recording.from_csv_text(text, "oven.csv")
    assert caught.value.remedy


WRITERS = {
    "decimal commas": "t;u;y\n0,0;1;20,5\n0,5;1,5;21,25\n1,0;1,5;22\n",
    "tabs": "t\tu\ty\n0\t1\t20.5\n0.5\t1.5\t21.25\n1\t1.5\t22\n",
    "old line ends": "t,u,y\r0,1,20.5\r0.5,1.5,21.25\r1,1.5,22\r",
    "comments and units": "# exported\n\n# by hand\nt,u,y\ns,%,degC\n0,1,20.5\n0.5,1.5,21.25\n1,1.5,22\n",
    "milliseconds": "t_ms,u,y\n0,1,20.5\n500,1.5,21.25\n1000,1.5,22\n",
    "minutes": f"Time [min],u,y\n0,1,20.5\n{0.5 / 60!r},1.5,21.25\n{1 / 60!r},1.5,22\n",
    "marks for no value": "t,u,y\n0,1,20.5\n0.25,1,Bad\n0.3,1,No Data\n0.5,1.5,21.25\n1,1.5,22\n",
}


@pytest.mark.parametrize("text", WRITERS.values(), ids=WRITERS)
def test_what_others_write_is_read(text):
    recording = Recording.from_csv_text(text)
    assert recording.t == pytest.approx([0.0, 0.5, 1.0])
    assert recording.output.tolist() == [1.0, 1.5, 1.5]
    assert recording.pv.tolist() == [20.5, 21.25, 22.0]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
def test_titles_in_any_common_encoding(encoding):
    content = "t [s],u [%],y [\u00b0C]\n0,1,2\n1,1,3\n".encode(encoding)
    assert Recording.from_csv_bytes(content, "oven.csv").pv.tolist() == [2.0, 3.0]


@pytest.mark.parametrize(
    ("content", "words"),
    [(b"PK\x03\x04rest", "workbook"), (b"<html>", "page"), (b'{"t": [0, 1]}', "JSON"), (b"t,u,y\n\xff\x00", "UTF-8")],
)
def test_other_files_are_told_apart(content, words):
    with pytest.raises(RecordingError, match=words):
        Recording.from_csv_bytes(content, "oven.csv")


def test_times_in_another_unit_leave_a_note_and_unknown_units_are_refused():
    assert "multiplied by 60" in Recording.from_csv_text(WRITERS["minutes"]).notes[0]
    with pytest.raises(RecordingError, match="not a known unit of time"):
        Recording.from_csv_text("t [samples],u,y\n0,1,2\n1,1,3\n")
    stamped = Recording.from_csv_text("Time [UTC],u,y\n2026-01-31T12:00:00,1,2\n2026-01-31T12:00:01,1,3\n")
    assert stamped.t.tolist() == [0.0, 1.0]


def test_rounded_times_are_told_from_unsorted_ones():
    with pytest.raises(RecordingError, match="have been rounded"):
        Recording.from_csv_text("t,u,y\n0,1,2\n0,1,3\n1,1,3\n")


def test_a_missing_pv_is_a_hole_where_the_output_moves():
    t, level = np.arange(60), np.where(np.arange(60) % 20 < 10, 1.0, -1.0)
    gap = [f"{k},{level[k]},{'' if 18 <= k < 45 else k / 10}" for k in t]
    part = Recording.from_csv_text("\n".join(["t,u,y", *gap]))
    assert part.t.tolist() == list(range(18))
    assert "output moved while the PV was missing" in part.notes[1]
    short = [f"{k},{level[k]},{'' if 12 <= k < 15 else k / 10}" for k in t]
    assert len(Recording.from_csv_text("\n".join(["t,u,y", *short]))) == 57


@pytest.mark.one_of(2)
@pytest.mark.parametrize("odd", ["", "30000.5,1,\n", "30000.5,1,2,Bad\n"])
def test_a_long_text_reads_as_a_short_one(odd):
    rows = [f"{k},{k % 7},{k / 8},{-k}\n" for k in range(60_000)]
    short = Recording.from_csv_text("t_ms,u,y,a\n" + "".join(rows[:100]))
    rows[30_000] += odd.replace("1,\n", "1,,\n")
    long = Recording.from_csv_text("t_ms,u,y,a\n" + "".join(rows), "long.csv")
    assert len(long) == 60_000 + ("Bad" in odd)
    for name in ("t", "output", "pv"):
        assert (getattr(long, name)[:100] == getattr(short, name)).all()
    assert "multiplied by 0.001" in " ".join(long.notes)
    assert ("a" in long.extra) == ("Bad" not in odd)


def test_bad_files(tmp_path):
    with pytest.raises(RecordingError, match="cannot be read"):
        Recording.from_csv(tmp_path / "absent.csv")
    (tmp_path / "binary.csv").write_bytes(b"t,u,y\n\xff\xfe\x00,1,2\n")
    with pytest.raises(RecordingError, match="UTF-8"):
        Recording.from_csv(tmp_path / "binary.csv")


def test_bad_columns_name_the_field():
    good = np.arange(3.0)
    with pytest.raises(RecordingError, match="another length"):
        Recording(good, good[:2], good)
    with pytest.raises(RecordingError, match="finite number in sample 1"):
        Recording(good, good, np.array([0.0, np.nan, 1.0]))
    with pytest.raises(RecordingError, match="one dimension"):
        Recording(good.reshape(1, 3), good, good)


def test_a_window_keeps_all_columns():
    recording = Recording.from_csv_text("t,u,y,sp,a\n0,1,2,3,4\n1,1,2,3,5\n2,1,2,3,6\n3,1,2,3,7\n").window(1.0, 2.0)
    assert recording.t.tolist() == [1.0, 2.0]
    assert recording.extra["a"].tolist() == [5.0, 6.0]
    assert recording.duration_s == 1.0


def test_samples_without_set_point_make_an_open_loop_recording():
    recording = Recording.from_samples([Sample(0.0, 1.0, 2.0), Sample(1.0, 1.5, 2.0)], {"hysteresis": 0.1})
    assert recording.set_point is None
    assert recording.settings["hysteresis"] == 0.1
    with pytest.raises(ValueError, match="read-only"):
        recording.pv[0] = 3.0


@pytest.mark.parametrize("text", [",", ",,,", " ,\n", ";\n;\n", '""', "\t\t\n"])
def test_separators_alone_are_no_recording(text):
    with pytest.raises(RecordingError, match="is empty"):
        Recording.from_csv_text(text, "upload")


def test_milliseconds_since_1970_are_told_where_the_title_does_not_say_so():
    rows = "".join(f"{1_700_000_000_000 + 100 * k},{k % 2},{k}\n" for k in range(4))
    (note,) = Recording.from_csv_text(f"t,u,y\n{rows}").notes
    assert "need the title t [ms]" in note
    told = Recording.from_csv_text(f"t [ms],u,y\n{rows}")
    assert "need" not in " ".join(told.notes)
    assert told.duration_s == pytest.approx(0.3)


def test_an_infinite_value_is_a_hole_without_a_warning_of_the_arithmetic():
    rows = "".join(f"{k},{k % 2},{k}\n" for k in range(9))
    recording = Recording.from_csv_text(f"t,u,y\n{rows}9,1e400,5\n")
    assert len(recording.t) == 9
    assert "1 rows without a usable output" in recording.notes[0]
