"""`autotuner tune --online`: the demo loop beside a running controller, and gains that cannot be read."""

import json

import pytest

from autotuner.cli import main


@pytest.mark.long  # over HTTP in tests/service
def test_the_demo_loop_is_tuned_beside_a_controller(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["tune", "--online", "2,8,0.6", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["settings"]["online"] == {
        "controller": "PID",
        "Kp": 2.0,
        "Ti": 8.0,
        "Td": 0.6,
        "Tf": 0.06,
        "b": 1.0,
        "N": None,
    }
    for name, truth in {"K": 2.0, "T": 10.0, "D": 1.5}.items():
        assert result["model"][name] == pytest.approx(truth, rel=0.03)
    assert result["limit_cycle"]["alone"] is False


def test_people_are_told_that_a_controller_ran(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["tune", "--online", "2,8,0.6"]) == 0
    text = capsys.readouterr().out
    assert "in parallel with a controller" in text
    assert "Ku" not in text


@pytest.mark.parametrize("gains", ["", "x", "1,2,3,4", "1,,2"])
def test_gains_that_cannot_be_read_are_wrong_usage(gains, capsys):
    assert main(["tune", f"--online={gains}"]) == 2
    assert "--online" in capsys.readouterr().err


def test_a_sign_that_would_run_away_is_refused(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["tune", "--online=-2,8"]) == 2
    assert "online.Kp" in capsys.readouterr().err
