"""`autotuner bench`: benchmarks by name, from a checkout."""

import pytest

from autotuner.cli import main
from autotuner.commands import bench
from autotuner.errors import InputError


def test_without_a_name_it_lists_them(capsys):
    assert main(["bench"]) == 0
    told = capsys.readouterr().out
    assert "effects" in told
    assert "_device" not in told
    assert "loop_judge" not in told


def test_a_benchmark_takes_its_own_arguments(capfd):
    assert main(["bench", "noise", "--help"]) == 0
    assert "--seeds" in capfd.readouterr().out


def test_a_name_that_is_none_is_refused(capsys):
    assert main(["bench", "nothing"]) == 2
    assert "effects" in capsys.readouterr().err


@pytest.mark.long  # the effects by themselves are in tests/diagnosis
def test_hidden_physics_is_named_on_a_few_records_of_the_benchmark(capfd):
    """Some of what `autotuner bench effects` judges: the confusion, the errors before and after, false alarms."""
    sections = ["--sections", "single", "clean", "--first", "11", "--thin", "399"]
    assert main(["bench", "effects", *sections, "--jobs", "1", "--failures"]) == 0
    told = capfd.readouterr().out
    assert "textbook forms" in told
    assert "named first (truth: names with counts)" in told
    assert "model before" in told
    failed = [line for line in told.partition("base/noise  case  answer")[2].splitlines() if line.strip()]
    assert not failed


def test_without_a_checkout_it_says_so(tmp_path):
    with pytest.raises(InputError, match="checkout"):
        bench.benchmarks(tmp_path)


def test_the_exit_code_is_the_benchmarks(monkeypatch, tmp_path):
    (tmp_path / "failing.py").write_text('"""Fails."""\nif __name__ == "__main__":\n    raise SystemExit(1)\n')
    monkeypatch.setattr(bench, "FOLDER", tmp_path)
    assert main(["bench", "failing"]) == 1
