"""Two loops that disturb each other, from the shell: tuned one after the other, judged together."""

import json
from pathlib import Path

import numpy as np
import pytest

from autotuner.cli import main

EXAMPLE = (Path(__file__).parents[2] / "examples" / "two-heaters.toml").read_text()
PAIR = ("--structure", "sopdt_overdamped")
"""The structure of each path, so that none is searched for."""
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
        assert tune(folder, loop, other, "--config", str(config), "--json", "--rule", "simc_pi", *PAIR) == 0
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


def both_moved(rng):
    """Return a CSV text of two heaters that move at once: lags of 60 s in closed form, gains 0.6, 0.5, across 0.2."""
    t = np.arange(0.0, 1500.0, 3.0)
    first, second = (np.repeat(rng.choice([20.0, 60.0], 25), 20)[: t.size] for _ in range(2))
    kept = np.exp(-3.0 / 60.0)
    states = np.zeros((t.size, 2))
    for k in range(t.size - 1):
        states[k + 1] = kept * states[k] + (1.0 - kept) * np.array([first[k], second[k]])
    pv1 = states @ [0.6, 0.2] + rng.normal(0.0, 0.05, t.size)
    pv2 = states @ [0.2, 0.5] + rng.normal(0.0, 0.05, t.size)
    rows = zip(t, first, second, pv1, pv2, strict=True)
    return "Time,Q1,Q2,T1,T2\n" + "\n".join(",".join(f"{value:.6g}" for value in row) for row in rows)


@pytest.mark.long  # the paths of a simulated board show the same identification
def test_one_record_in_which_both_outputs_moved_serves_as_both(tmp_path, capsys):
    both = tmp_path / "both.csv"
    both.write_text(both_moved(np.random.default_rng(8)))
    roles = ("--columns", "t=Time,u=Q1,y=T1", "t=Time,u=Q2,y=T2")
    assert main(["interaction", str(both), str(both), *roles, "--other-output", "Q2", "Q1", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    gains = {path: process["K"] for path, process in found["processes"].items()}
    assert gains == pytest.approx({"first": 0.6, "second": 0.5, "on_second": 0.2, "on_first": 0.2}, rel=0.03)
    assert found["relative_gain"] == pytest.approx(0.6 * 0.5 / (0.6 * 0.5 - 0.2 * 0.2), rel=0.02)


@pytest.mark.long  # other refusals are beside it
def test_an_output_that_is_said_to_have_moved_and_did_not_is_refused(tmp_path, capsys):
    lines = both_moved(np.random.default_rng(8)).splitlines()
    cells = [line.split(",") for line in lines]
    still = tmp_path / "still.csv"
    still.write_text("\n".join([lines[0], *(f"{t},{q1},40,{t1},{t2}" for t, q1, _, t1, t2 in cells[1:])]))
    roles = ("--columns", "t=Time,u=Q1,y=T1", "t=Time,u=Q1,y=T2")
    assert main(["interaction", str(still), str(still), *roles, "--other-output", "Q2", "Q2"]) == 2
    assert "at different times" in capsys.readouterr().err
