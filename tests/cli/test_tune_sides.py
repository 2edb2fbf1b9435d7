"""A loop whose output heats above zero and cools below it, with another gain on each side."""

import json

import pytest

from autotuner.cli import main

LOOP = """
[loops.TIC-7]
driver = "simulated"
sample_time_s = 0.1
[loops.TIC-7.limits]
output = [-100.0, 100.0]
[loops.TIC-7.relay]
amplitude = 10.0
[loops.TIC-7.device]
plant = { structure = "fopdt", K = 2.0, T = 10.0, D = 1.5 }
pv0 = 80.0
noise = 0.05
output_limits = [-100.0, 100.0]
effects = [{ effect = "direction_gain", ratio = 2.0 }]
"""


@pytest.fixture
def tuned(tmp_path, monkeypatch, capsys):
    """Return a function that tunes one side and leaves its result in a file of that name."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "autotuner.toml").write_text(LOOP)

    def tune(side):
        csv = tmp_path / f"{side}.csv"
        assert main(["tune", "--side", side, "--rule", "simc_pi", "--json", "--recording", str(csv)]) == 0
        text = capsys.readouterr().out
        (tmp_path / f"{side}.json").write_text(text)
        outputs = [float(line.split(",")[1]) for line in csv.read_text().splitlines()[1:]]
        return json.loads(text), outputs

    return tune


@pytest.mark.parametrize(("side", "K"), [pytest.param("heat", 4.0, marks=pytest.mark.long), ("cool", 2.0)])
def test_each_side_shows_its_own_gain_and_the_relay_stays_there(tuned, side, K):
    result, outputs = tuned(side)
    assert result["settings"]["side"] == side
    assert result["restored"] is True
    for name, truth in {"K": K, "T": 10.0, "D": 1.5}.items():
        assert result["model"][name] == pytest.approx(truth, rel=0.03)
    beyond_zero = min(outputs) if side == "heat" else -max(outputs)
    assert beyond_zero == 0.0


def test_both_results_make_a_pair(tuned, capsys):
    results = {side: tuned(side)[0] for side in ("heat", "cool")}
    assert main(["gains", "--heat", "heat.json", "--cool", "cool.json", "--hysteresis", "0.5", "--json"]) == 0
    pair = json.loads(capsys.readouterr().out)
    assert pair["borders"] == [0.0]
    assert pair["hysteresis"] == 0.5
    cooling, heating = (row["gains"] for row in pair["rows"])
    assert (heating, cooling) == (results["heat"]["gains"], results["cool"]["gains"])
    assert cooling["Kp"] == pytest.approx(2.0 * heating["Kp"], rel=0.1)
    assert main(["gains", "--heat", "heat.json", "--cool", "cool.json"]) == 0
    assert "heating" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments",
    [["--heat", "cool.json", "--cool", "heat.json"], ["--heat", "heat.json"], ["--heat", "x", "--cool", "x"]],
)
def test_results_that_make_no_pair_are_wrong_usage(tmp_path, monkeypatch, capsys, arguments):
    monkeypatch.chdir(tmp_path)
    gains = {"controller": "PI", "Kp": 1.0, "Ti": 10.0, "Td": 0.0, "Tf": 0.0, "b": 1.0}
    for side in ("heat", "cool"):
        (tmp_path / f"{side}.json").write_text(json.dumps({"settings": {"side": side}, "gains": gains}))
    assert main(["gains", *arguments]) == 2
    assert "--" in capsys.readouterr().err
