"""Two loops that disturb each other, from the shell: tuned one after the other, judged together."""

import json
from pathlib import Path

import pytest

from autotuner.cli import main

EXAMPLE = (Path(__file__).parents[2] / "examples" / "two-heaters.toml").read_text()
TRUTH = {"first": (0.65, 145.0), "second": (0.55, 155.0), "on_first": (0.25, 185.0), "on_second": (0.25, 185.0)}
"""Static gain, and the sum of lags and dead time, s, of each path."""


def tune(folder, loop, other, *more):
    return main(["tune", loop, "--also-record", other, "--recording", str(folder / f"{loop}.csv"), *more])


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    """Return the folder with the record of each heater."""
    folder = tmp_path_factory.mktemp("heaters")
    config = folder / "loops.toml"
    config.write_text(EXAMPLE)
    for loop, other in (("T1", "T2"), ("T2", "T1")):
        assert tune(folder, loop, other, "--config", str(config), "--json") == 0
    return folder


def test_the_paths_are_those_of_the_simulated_board(records, capsys):
    assert main(["interaction", str(records / "T1.csv"), str(records / "T2.csv"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    for path, (K, time_s) in TRUTH.items():
        process = found["processes"][path]
        assert process["K"] == pytest.approx(K, rel=0.2)
        assert sum(value for name, value in process.items() if name[0] in "TD") == pytest.approx(time_s, rel=0.2)
    assert found["relative_gain"] == pytest.approx(0.65 * 0.55 / (0.65 * 0.55 - 0.25**2), rel=0.1)
    assert found["stable"]
    assert found["remedies"]["decoupled"]["decoupler"] == pytest.approx([-0.25 / 0.65, -0.25 / 0.55], rel=0.2)


def test_the_result_for_people_ends_with_what_to_do(records, capsys):
    assert main(["interaction", str(records / "T1.csv"), str(records / "T2.csv"), "--together-ms", "1.6"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[4].startswith("relative gain")
    assert lines[-1].startswith("the loops meet")


def test_a_record_without_the_other_pv_is_refused(records, tmp_path, capsys):
    bare = tmp_path / "bare.csv"
    lines = (records / "T1.csv").read_text().splitlines()
    bare.write_text("\n".join(line.rpartition(",")[0] for line in lines))
    assert main(["interaction", str(bare), str(records / "T2.csv")]) == 2
    assert "the PV of the other loop" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (("--also-record", "T1", "--recording", "t.csv"), "the tuned loop itself"),
        (("--also-record", "T2"), "needs --recording"),
        (("--also-record", "T3", "--recording", "t.csv"), "T1, T2"),
    ],
)
def test_what_leads_to_nothing_is_refused_before_anything_moves(tmp_path, monkeypatch, capsys, options, why):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "autotuner.toml").write_text(EXAMPLE)
    assert main(["tune", "T1", *options]) == 2
    assert why in capsys.readouterr().err


def test_another_loop_in_automatic_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    head, _, tail = EXAMPLE.rpartition("output0 = 30.0\npv0")
    (tmp_path / "autotuner.toml").write_text(f"{head}output0 = 30.0\nauto = true\npv0{tail}")
    assert tune(tmp_path, "T1", "T2") == 2
    assert "in automatic" in capsys.readouterr().err
    assert not (tmp_path / "T1.csv").exists()
