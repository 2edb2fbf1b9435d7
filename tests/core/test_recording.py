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
