"""Wrong command lines, generated from the options that the commands declare: each is refused before anything moves."""

import runpy
import sys
from pathlib import Path

import pytest

from autotuner.cli import main

BENCH = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "safety" / "requests" / "wrong_options.py"))


@pytest.fixture
def mark(tmp_path, monkeypatch):
    """A folder with a loop whose device leaves this file when it is touched."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path[:])
    yield BENCH["prepared"](tmp_path)
    sys.modules.pop("touched_rig", None)


@pytest.mark.long  # one line of each kind is below
def test_hundreds_of_wrong_lines_are_refused_by_field_value_and_remedy(capsys, mark):
    lines = BENCH["wrong_lines"]()
    assert len(lines) > 100
    for line, words in lines:
        code = main(line)
        captured = capsys.readouterr()
        assert code in (1, 2), line
        assert captured.out == "", line
        assert BENCH["is_answer"](captured.err, words), (line, captured.err)
        assert not mark.exists(), line


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (["tun"], ["'tun'", "Did you mean tune?"]),
        (["tune", "--structure", "fodpt"], ["--structure", "'fodpt'", "Did you mean fopdt?"]),
        (["tune", "--amplitud", "3"], ["--amplitud", "Did you mean --amplitude?"]),
        (["tune", "--amp", "3"], ["--amp", "is not an option"]),
        (["tune", "--amplitude", "nan"], ["--amplitude", "'nan'", "finite"]),
        (["tune", "--report", "/nowhere/x.html"], ["--report", "'/nowhere/x.html'", "another place"]),
        (["apply"], ["loop", "is missing", "autotuner apply --help"]),
    ],
)
def test_an_answer_names_what_was_meant(capsys, line, words):
    assert main(line) == 2
    told = capsys.readouterr().err
    assert all(word in told for word in words), told


@pytest.mark.realtime
def test_a_device_that_is_touched_leaves_a_mark(mark):
    """The test above can fail: the same loop with right options touches its device."""
    assert main(["probe", "rig", "--config", "autotuner.toml", "--seconds", "0.2"]) == 0
    assert mark.exists()
