"""The shell commands, run as a user does, in this process: results, exit codes, and errors that name their remedy."""

import json
import re

import numpy as np
import pytest
from scipy.optimize import brentq

from autotuner.cli import main
from autotuner_sim import Fopdt, Noise, SteppedPlant


def run(capsys, *arguments):
    code = main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


@pytest.fixture
def relay_csv(tmp_path):
    """A sampled asymmetric relay on the simulator's exact plant, at rest first."""
    plant = SteppedPlant(Fopdt(2.0, 10.0, 1.5), output0=40.0, pv0=80.0, sensors=[Noise(0.02, seed=5)])
    rows, output = ["t,u,y"], 40.0
    for k in range(450):
        plant.advance(0.1 * k)
        pv = plant.measure()
        if k >= 50:
            output = 53.0 if pv < 79.8 or (output != 33.0 and pv < 80.2) else 33.0
        plant.output = output
        rows.append(f"{0.1 * k!r},{output!r},{pv!r}")
    file = tmp_path / "relay.csv"
    file.write_text("\n".join(rows), encoding="utf-8")
    return file


def test_tune_without_arguments_tunes_the_simulated_loop(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, _ = run(capsys, "tune", "--json", "--picture", "p.png", "--recording", "r.csv")
    result = json.loads(out)
    assert code == 0
    assert result["structure"] == "fopdt"
    for name, truth in {"K": 2.0, "T": 10.0, "D": 1.5}.items():
        assert result["model"][name] == pytest.approx(truth, rel=0.03)
    assert {"describing_function", "closed_form", "least_squares"} <= set(result["estimates"])
    assert {"Pu", "A", "A1", "Ku"} <= set(result["limit_cycle"])
    assert result["recommended"] == "least_squares"
    assert result["restored"] is True
    assert result["verdict"]["outcome"] == "done"
    assert result["error"]["held_out"] < 1.5 * result["error"]["noise_sigma"]
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "r.csv").read_text().startswith("t,u,y")


def test_tune_for_people_shows_model_gains_and_picture(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, err = run(capsys, "tune", "--no-check")
    assert code == 0
    assert err == ""
    for words in ("least_squares *", "Kp ", "done: fopdt", "the check was left out"):
        assert words in out
    assert sum("\u2800" < character <= "\u28ff" for character in out) > 100  # dots of the picture


def test_the_same_seed_gives_the_same_tuning(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    results = [json.loads(run(capsys, "tune", "--json")[1]) for _ in range(2)]
    for result in results:
        del result["started_at"]
    assert results[0] == results[1]


def test_errors_of_a_loop_without_a_unit_are_written_without_one(capsys, tmp_path):
    config = tmp_path / "loops.toml"
    config.write_text(
        '[loops.A]\ndriver = "simulated"\nsample_time_s = 0.1\nrelay = { amplitude = 10.0 }\n[loops.A.device]\n'
        'output0 = 40.0\npv0 = 80.0\nnoise = 0.05\nplant = { structure = "fopdt", K = 2.0, T = 10.0, D = 1.5 }\n',
        encoding="utf-8",
    )
    code, out, _ = run(capsys, "tune", "--config", config, "--rule", "simc_pi", "--structure", "fopdt")
    assert code == 0
    assert re.search(r"[\d.]+ where not fitted +[\d.]+ where fitted +[\d.]+ of the noise", out)


def test_a_refusal_is_exit_code_1_with_its_remedy(capsys, tmp_path):
    config = tmp_path / "loops.toml"
    config.write_text(
        '[loops.A]\ndriver = "simulated"\nprocess_action = "reverse"\nsample_time_s = 0.1\n'
        '[loops.A.device]\noutput0 = 40.0\npv0 = 80.0\nplant = { structure = "fopdt", K = 2.0, T = 10.0, D = 1.5 }\n',
        encoding="utf-8",
    )
    code, out, _ = run(capsys, "tune", "--config", config)
    assert code == 1
    assert "refused" in out
    assert "Set process_action = direct" in out


def test_identify_finds_the_process_behind_a_file(capsys, relay_csv):
    code, out, _ = run(capsys, "identify", relay_csv, "--json")
    result = json.loads(out)
    assert code == 0
    for name, truth in {"K": 2.0, "T": 10.0, "D": 1.5}.items():
        assert result["model"][name] == pytest.approx(truth, rel=0.02)


def test_identify_takes_a_known_gain_a_structure_columns_and_a_window(capsys, relay_csv):
    text = relay_csv.read_text(encoding="utf-8").replace("t,u,y", "when,heater,oven")
    relay_csv.write_text(text, encoding="utf-8")
    code, out, _ = run(
        capsys, "identify", relay_csv, "--json", "--known-gain", 2.0, "--structure", "fopdt",
        "--columns", "t=when,u=heater,y=3", "--window", ":20",
    )  # fmt: skip
    assert code == 0
    assert json.loads(out)["model"]["K"] == 2.0


def test_identify_goes_on_after_a_file_that_fails(capsys, relay_csv, tmp_path):
    bad = tmp_path / "bad.csv"
    bad.write_text("t,u\n0,1\n1,1\n", encoding="utf-8")
    code, out, err = run(capsys, "identify", bad, relay_csv, "--json", "--jobs", 2)
    lines = [json.loads(line) for line in out.splitlines()]
    assert code == 1
    assert lines[0]["error"]["error"] == "RecordingError"
    assert lines[1]["structure"] == "fopdt"
    assert "has no column for pv" in err


def test_identify_draws_a_picture(capsys, relay_csv, tmp_path):
    code, out, _ = run(capsys, "identify", relay_csv, "--picture", tmp_path / "fit.svg")
    assert code == 0
    assert "fopdt" in out
    assert "<svg" in (tmp_path / "fit.svg").read_text(encoding="utf-8")


def test_identify_draws_one_picture_a_file_into_a_folder(capsys, relay_csv, tmp_path):
    other = tmp_path / "other.csv"
    other.write_text(relay_csv.read_text(encoding="utf-8"), encoding="utf-8")
    code, out, _ = run(capsys, "identify", relay_csv, other, "--json", "--picture", tmp_path / "drawn")
    assert code == 0
    assert len(out.splitlines()) == 2
    assert {file.name for file in (tmp_path / "drawn").iterdir()} == {f"{relay_csv.stem}.png", "other.png"}


def test_identify_takes_the_moments_of_the_output(capsys, relay_csv):
    """Held to be between the samples, the same changes came half a sample earlier, and the dead time is that longer."""
    exact, between = (
        json.loads(run(capsys, "identify", relay_csv, "--json", "--moments", moments)[1])
        for moments in ("exact", "between")
    )
    least_squares = between["estimates"]["least_squares"]
    assert least_squares["evidence"]["moments_free"] is True
    assert between["model"]["D"] > exact["model"]["D"]
    assert any("between the samples" in warning for warning in between["warnings"])


def test_gains_by_rule_and_by_goal(capsys):
    """Ziegler-Nichols PID from the closed form of the ultimate point: Kp = 0.6 Ku, Ti = Pu/2, Td = Pu/8."""
    w = brentq(lambda x: np.pi - np.arctan(10.0 * x) - 1.5 * x, 0.1, 3.0)
    Ku, Pu = np.hypot(1.0, 10.0 * w) / 2.0, 2.0 * np.pi / w
    model = json.dumps({"K": 2.0, "T": 10.0, "D": 1.5})
    code, out, _ = run(capsys, "gains", "--model", model, "--rule", "ziegler_nichols_pid", "--json")
    gains = json.loads(out)["gains"]
    assert code == 0
    assert (gains["Kp"], gains["Ti"], gains["Td"]) == pytest.approx((0.6 * Ku, Pu / 2.0, Pu / 8.0), rel=1e-6)
    code, out, _ = run(capsys, "gains", "--model", model)
    assert code == 0
    assert "simc_pid" in out


def test_gains_reads_a_result_of_identify(capsys, relay_csv, tmp_path):
    result = tmp_path / "result.json"
    result.write_text(run(capsys, "identify", relay_csv, "--json")[1], encoding="utf-8")
    assert run(capsys, "gains", "--model", result, "--json")[0] == 0


WRONG = [
    (["gains"], 2, "--model"),
    (["gains", "--model", "{"], 2, "is not JSON"),
    (["gains", "--model", "[1]"], 2, "neither a JSON object nor a readable file"),
    (["gains", "--model", '{"K": 0, "T": 1, "D": 1}'], 2, "model.K"),
    (["gains", "--model", '{"K": 1, "T": 1, "D": 1}', "--rule", "magic"], 2, "ziegler_nichols_pid"),
    (["gains", "--model", '{"K": 1, "T": 1, "D": 1}', "--goal", "wild"], 2, "balanced"),
    (["tune", "nowhere"], 2, "Use one of demo"),
    (["tune", "--amplitude", "-1"], 2, "amplitude"),
    (["tune", "--amplitude", "185"], 2, "half the swing"),
    (["tune", "--ratio", "nan"], 2, "ratio"),
    (["tune", "--config", "absent.toml"], 2, "cannot be read"),
    (["serve", "--port", "70000"], 2, "service: port"),
    (["serve", "--host", "0.0.0.0"], 2, "service.host"),
    (["identify", "absent.csv"], 1, "cannot be read"),
    (["identify", "absent.csv", "--columns", "pv"], 2, "--columns"),
    (["identify", "absent.csv", "--window", "9:1"], 2, "--window"),
    (["identify", "a.csv", "b.csv", "--picture", "p.png"], 2, "several recordings"),
]


@pytest.mark.parametrize(("arguments", "code", "words"), WRONG, ids=lambda value: str(value)[:40])
def test_wrong_input_names_the_field_and_the_remedy(capsys, tmp_path, monkeypatch, arguments, code, words):
    monkeypatch.chdir(tmp_path)
    got, out, err = run(capsys, *arguments)
    assert got == code
    assert words in err
    assert "Traceback" not in err + out


CONFIGURATIONS = [
    ("[loops", "is not valid TOML"),
    ("[service]\nport = 1\n", "loops: is missing"),
    ('[loops.A]\ndriver = "teleport"\n', "is not an installed driver"),
    ('[loops.A]\ndriver = "modbus"\nsample_time_s = -1\n', "loops.A.sample_time_s"),
    ('[loops.A]\ndriver = "modbus"\nsample_time = 1\n', "loops.A.sample_time"),
    ('[loops.A]\ndriver = "modbus"\n[loops.A.limits]\noutput = [100.0, 0.0]\n', "loops.A.limits.output"),
    ('[loops.A]\ndriver = "modbus"\n[loops.A.relay]\namplitude = "ten"\n', "loops.A.relay.amplitude"),
    ('[loops.A]\ndriver = "modbus"\n[loops.A.device]\nhost = "x"\n', "loops.A.device.registers"),
    (
        (
            '[loops.A]\ndriver = "modbus"\n[loops.A.device]\nhost = "x"\n[loops.A.device.registers]\n'
            'pv = { table = "input", address = 70000 }\noutput = { table = "holding", address = 0 }\n'
        ),
        "address",
    ),
]


@pytest.mark.parametrize(("text", "words"), CONFIGURATIONS, ids=[words for _, words in CONFIGURATIONS])
def test_a_wrong_configuration_names_the_key(capsys, tmp_path, text, words):
    config = tmp_path / "loops.toml"
    config.write_text(text, encoding="utf-8")
    code, _, err = run(capsys, "check", config)
    assert code == 2
    assert words in err


def test_a_right_configuration_is_accepted(capsys, request):
    code, out, _ = run(capsys, "check", request.config.rootpath / "examples" / "plc.toml")
    assert code == 0
    assert "TIC-101" in out


@pytest.mark.parametrize("arguments", [["--help"], ["tune", "--help"], ["identify", "--help"], ["reproduce", "--help"]])
def test_every_command_explains_itself(capsys, arguments):
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 0
    assert "usage: autotuner" in capsys.readouterr().out


@pytest.mark.parametrize("arguments", [[], ["fly"], ["tune", "--speed", "9"]])
def test_wrong_usage_is_exit_code_2(capsys, arguments):
    assert main(arguments) == 2
    assert capsys.readouterr().err.startswith("autotuner: ")
