"""A tuning as one file: what it holds, the analysis again, and what is no such file."""

import asyncio
import gzip
import hashlib
import io
import json
import math
import zipfile

import async_solipsism
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotuner.application.computing.compute_pool import InPlace
from autotuner.cli import main
from autotuner.core.recording import Sample
from autotuner.errors import RecordingError
from autotuner.service.archive import export
from autotuner.service.archive.archive import Archive
from autotuner.service.archive.archive_record import Head, KeptTuning
from autotuner.service.archive.export import digest, exported, read_export
from autotuner.service.archive.retention import Retention


@pytest.fixture(scope="module")
def text(new_shop, tmp_path_factory):
    """The file of a tuning that ran, was kept by the archive, and came back from the database."""
    folder = tmp_path_factory.mktemp("kept")

    async def tune():
        shop = new_shop()
        archive = Archive(None, folder, Retention(10, 10**9), in_place=True)
        archive.open(shop)
        await shop.conduct(pool=InPlace())
        await archive.flush()
        kept = (await archive.find("t1")).kept
        await archive.close()
        return exported(kept)

    with asyncio.Runner(loop_factory=async_solipsism.EventLoop) as runner:
        return runner.run(tune())


@pytest.fixture
def file(text, tmp_path):
    path = tmp_path / "tuning.json"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_analysis_again_is_the_same_to_the_last_digit(file, text, capsys):
    assert main(["replay", str(file), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    then = json.loads(text)["result"]
    assert len(read_export(file).recording) > 50
    assert told["identical"]
    assert {"model", "estimates", "gains", "tuning", "fit", "limit_cycle", "diagnosis", "verdict"} <= {
        *told["compared"]
    }
    for part in told["compared"]:
        assert json.dumps(told["result"][part], sort_keys=True) == json.dumps(then[part], sort_keys=True)
    assert told["versions_then"] == told["versions_now"]


def test_the_digest_is_that_of_everything_else_in_canonical_form(text):
    whole = json.loads(text)
    given_digest = whole.pop("sha256")
    canonical = json.dumps(whole, sort_keys=True, separators=(",", ":"))
    assert given_digest == hashlib.sha256(canonical.encode()).hexdigest()


def changed(text, change, *, signed):
    whole = json.loads(text)
    change(whole)
    if signed:
        whole["sha256"] = digest(whole)
    return json.dumps(whole)


def test_a_result_that_differs_is_told(file, text, capsys):
    def other(whole):
        whole["result"]["gains"]["Kp"] *= 1.0 + 1e-15
        whole["versions"]["numpy"] = "1.0"

    file.write_text(changed(text, other, signed=True))
    assert main(["replay", str(file)]) == 1
    out = capsys.readouterr().out
    assert "differs: gains\n" in out
    assert "numpy 1.0 then" in out


@pytest.mark.long  # one that was analysed, above
def test_a_tuning_that_was_not_analysed_has_nothing_to_compare(file, text, capsys):
    def stopped(whole):
        whole["result"] = {"verdict": {"outcome": "aborted", "code": "requested"}}

    file.write_text(changed(text, stopped, signed=True))
    assert main(["replay", str(file)]) == 0
    assert "nothing to compare" in capsys.readouterr().out


NUMBERS = st.floats(allow_nan=False, allow_infinity=False)


@given(st.lists(st.tuples(NUMBERS, NUMBERS, st.floats(), st.floats()), min_size=2, max_size=10))
def test_numbers_come_back_bit_by_bit(tmp_path_factory, rows):
    kept_samples = [Sample(float(k), *row[:3], 0.0, row[3]) for k, row in enumerate(rows)]
    head = Head("t", "l", "now", "me", {"structure": "auto", "goal": "balanced", "rule": None})
    path = tmp_path_factory.getbasetemp() / "numbers.json"
    path.write_text(exported(KeptTuning(head, {}, {}, {}, kept_samples, [])))
    held = json.loads(path.read_text())["recording"]
    for name in ("t", "pv", "output"):
        assert [math.copysign(1.0, v) for v in held[name]] == [
            math.copysign(1.0, getattr(s, name)) for s in kept_samples
        ]
        assert held[name] == [getattr(s, name) for s in kept_samples]
    finite = [s.set_point if math.isfinite(s.set_point) else None for s in kept_samples]
    assert held["set_point"] == finite


def no_mark(whole):
    del whole["autotuner_tuning"]


def newer(whole):
    whole["autotuner_tuning"] = 99


def unequal(whole):
    whole["recording"]["pv"].pop()


def words(whole):
    whole["recording"]["pv"][0] = "20.0"


def flags(whole):
    whole["recording"]["pv"][0] = True


def nothing_recorded(whole):
    for name in export.FIELDS:
        whole["recording"][name] = []


def backwards(whole):
    whole["recording"]["t"].reverse()


def no_request(whole):
    whole["request"] = []


def no_goal(whole):
    del whole["request"]["goal"]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (no_mark, "is no exported tuning"),
        (newer, "format 99"),
        (unequal, "is no exported tuning"),
        (words, "is no exported tuning"),
        (flags, "is no exported tuning"),
        (nothing_recorded, "two samples"),
        (backwards, "t: "),
        (no_request, "is no exported tuning"),
    ],
)
def test_a_file_that_is_none_is_refused(file, text, change, says):
    file.write_text(changed(text, change, signed=True))
    with pytest.raises(RecordingError, match=says) as refusal:
        read_export(file)
    assert refusal.value.remedy


def test_a_request_without_its_parts_is_refused(file, text, capsys):
    file.write_text(changed(text, no_goal, signed=True))
    assert main(["replay", str(file)]) == 2
    assert "request: 'goal' is missing" in capsys.readouterr().err


def test_a_file_that_was_changed_is_refused(file, text):
    file.write_text(changed(text, lambda whole: whole["recording"]["pv"].__setitem__(3, 0.0), signed=False))
    with pytest.raises(RecordingError, match="was changed since it was written"):
        read_export(file)


def bomb():
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("tuning.json", b"0" * 10**8)
    return packed.getvalue()


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "is no exported tuning"),
        (b"\x00\xff" * 100, "is no exported tuning"),
        (b"[" * 100_000, "is no exported tuning"),
        (b"[]", "is no exported tuning"),
        (b"1" * 10_000, "is no exported tuning"),
        (b'{"autotuner_tuning": 1}', "is no exported tuning"),
        (b"t,u,y\n0,1,2\n", "is no exported tuning"),
        (gzip.compress(b"0" * 10**6), "is compressed"),
        (bomb, "is compressed"),
    ],
)
def test_rubbish_is_refused(tmp_path, content, says):
    path = tmp_path / "rubbish"
    path.write_bytes(content() if callable(content) else content)
    with pytest.raises(RecordingError, match=says):
        read_export(path)


def test_what_is_too_large_is_not_read_to_its_end(tmp_path, monkeypatch):
    monkeypatch.setattr(export, "LARGEST_BYTES", 2**20)
    path = tmp_path / "large"
    with path.open("wb") as sparse:
        sparse.truncate(2**40)
    with pytest.raises(RecordingError, match="larger than 1 MiB"):
        read_export(path)


def test_a_file_that_is_not_there_is_told(tmp_path, capsys):
    assert main(["replay", str(tmp_path / "none.json")]) == 1
    assert "No such file" in capsys.readouterr().err
