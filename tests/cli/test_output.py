"""What a command prints, on any encoding, width and standard output, and where results go that cannot be written."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from autotuner.cli import main
from autotuner.commands.command_line import command_line
from autotuner.commands.terminal import show
from autotuner.commands.terminal.progress import Progress
from autotuner.commands.terminal.usage import Parser
from autotuner.control.reporting.events import EstimateUpdated, ModelUpdated, PhaseChanged

GAINS = f"""{sys.executable} -m autotuner gains --model '{{"K": 2, "T": 10, "D": 1.5}}' --rule simc_pi"""
ROOT = Path(__file__).parents[2]


def shell(line, **environment):
    done = subprocess.run(
        ["bash", "-c", f"set -o pipefail; {line}"],
        cwd=ROOT, env={**os.environ, **environment}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    return done.returncode, done.stdout, done.stderr


def test_an_encoding_without_frames_is_no_error():
    code, out, err = shell(GAINS, PYTHONIOENCODING="ascii")
    assert (code, err) == (0, "")
    assert out.isascii()
    assert "Kp" in out


@pytest.mark.long  # a full standard output is the same call
def test_a_reader_that_leaves_is_no_error():
    code, _, err = shell(f"{GAINS} | head -c 1 > /dev/null")
    assert (code, err) == (0, "")


@pytest.mark.long  # the full one is the same error of the same call
def test_a_closed_standard_output_is_no_traceback():
    assert shell(f"{GAINS} >&-") == (0, "", "")


def test_a_full_standard_output_is_one_sentence():
    code, _, err = shell(f"{GAINS} > /dev/full")
    assert code == 1
    assert err.startswith("autotuner: standard output: cannot be written")
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize("command", ["identify", "diagnose"])
def test_results_of_a_file_that_cannot_be_printed_end_in_one_sentence(command, tmp_path):
    file = tmp_path / "step.csv"
    t = np.arange(120.0)
    u = np.where(t < 10.0, 40.0, 50.0)
    y = 60.0 - 10.0 * np.expm1(-np.maximum(t - 15.0, 0.0) / 20.0) + np.random.default_rng(1).normal(0.0, 0.05, t.size)
    np.savetxt(file, np.column_stack((t, u, y)), delimiter=",", header="t,u,y", comments="")
    code, _, err = shell(f"{sys.executable} -m autotuner {command} {file} > /dev/full")
    assert code == 1
    assert err.splitlines()[-1].startswith("autotuner: standard output: cannot be written")
    assert "Traceback" not in err


@pytest.fixture
def results(state, monkeypatch, tmp_path):
    """Return the files that were kept in the data directory."""
    monkeypatch.chdir(tmp_path)
    return lambda: list(Path(os.environ["XDG_STATE_HOME"]).rglob("results/*"))


def test_files_that_cannot_be_written_after_the_experiment_are_kept_and_named(capsys, results):
    """`/dev/full` can be opened: that it holds nothing shows only when it is written."""
    code = main(["tune", "--no-check", "--json", "--recording", "/dev/full", "--report", "/dev/full"])
    told = capsys.readouterr().err
    assert code == 1
    assert {file.name.rpartition("-")[2] for file in results()} == {"full"}
    assert all(f"the result is in {file}" in told for file in results())
    assert "--recording: cannot be written: No space left on device" in told


def test_a_result_that_cannot_be_printed_is_kept(capsys, monkeypatch, results):
    with Path("/dev/full").open("w", encoding="utf-8") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert main(["tune", "--no-check"]) == 1
    (file,) = results()
    assert '"outcome": "done"' in file.read_text(encoding="utf-8")
    assert f"the result is in {file}" in capsys.readouterr().err


def test_on_80_columns_no_number_is_broken_and_the_end_is_what_matters(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(show, "PIPE_WIDTH", 80)
    assert main(["tune"]) == 0
    lines = capsys.readouterr().out.rstrip().splitlines()
    assert all(len(line.rstrip()) <= 80 for line in lines)
    assert lines[-1].startswith("next: autotuner tune demo")
    assert lines[-2].startswith("done: fopdt")
    assert any(re.match(r"in the device \(ideal\): +Kp [\d.]+ +Ti [\d.]+ +Td [\d.]+", line) for line in lines[-5:])
    assert any(re.search(r"K [\d.]+ \+- [\d.]+ +T [\d.]+ \+- [\d.]+ +D [\d.]+ \+- [\d.]+", line) for line in lines)
    assert not any("…" in line for line in lines)


def test_a_half_period_is_one_line_that_fits():
    progress = Progress(80)
    events = [
        EstimateUpdated(10.0, 2, 6.8, 3.0, 2.4, 4.128),
        ModelUpdated(10.0, "fopdt", {"K": 2.1, "T": 10.0, "D": 1.5}, {}, 0.02, "learned"),
        ModelUpdated(10.0, "sopdt_overdamped", {"K": 2.0, "T1": 9.1, "T2": 1.2, "D": 1.5}, {}, 0.011, "least_squares"),
        EstimateUpdated(13.4, 3, 6.8, 3.0, 2.4, 4.128),
        PhaseChanged(13.5, "check"),
    ]  # fmt: skip
    lines = [text for event in events for _, text in progress.take(event)]
    assert len(lines) == 3
    assert lines[0].startswith("half period  2  Pu 6.8 s  Ku 4.128  sopdt_overdamped +-1.1 %")
    assert lines[1].startswith("half period  3")
    assert all(len(line) + 12 <= 80 for line in lines[:2])


@pytest.mark.parametrize("name", sorted(command_line(None, whole=True)[0].commands()))
def test_every_help_has_examples_that_the_parser_accepts(name):
    parser, _ = command_line(None, whole=True)
    below = parser.commands()[name]
    assert isinstance(below, Parser)
    examples = [line.strip() for line in below.epilog.splitlines() if line.startswith(f"  autotuner {name}")]
    assert len(examples) >= 2
    for example in examples:
        parser.parse(shlex.split(example.partition(" > ")[0])[1:])


def test_the_list_of_commands_says_what_each_does(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    out = capsys.readouterr().out
    assert "from relay-autotuner" not in out
    assert "serve a simulated plant" in out


COMPLETED = [
    ("autotuner tu", "tune"),
    ("autotuner tune --goal ca", "calm"),
    ("autotuner identify --str", "--structure"),
    ("autotuner tune --structure unst", "unstable_fopdt"),
]


@pytest.mark.parametrize(("line", "completed"), COMPLETED)
def test_bash_completes(capsys, tmp_path, line, completed):
    assert main(["completion", "bash"]) == 0
    script = tmp_path / "completion.bash"
    script.write_text(capsys.readouterr().out, encoding="utf-8")
    words = shlex.join(line.split())
    code, out, err = shell(
        f"source {script}; COMP_WORDS=({words}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1)); _autotuner; "
        'echo "${COMPREPLY[@]}"'
    )
    assert (code, out.split(), err) == (0, [completed], "")


@pytest.mark.parametrize("name", ["zsh", "fish"])
def test_other_shells_are_given_every_command_and_option(capsys, name):
    assert main(["completion", name]) == 0
    out = capsys.readouterr().out
    for option in ("tune", "amplitude", "structure", "calm balanced brisk"):
        assert option in out


def test_the_next_command_of_a_loop_with_gains_in_the_device_writes_them():
    gains = SimpleNamespace(Kp=1.5, Ti=7.25, Td=0.5)
    tuning = SimpleNamespace(
        succeeded=True, id="3f", loop="TIC 101", applied=None, verification=None,
        analysis=SimpleNamespace(gains=SimpleNamespace(gains=gains)),
    )  # fmt: skip
    loop = SimpleNamespace(gains=object())
    command = show.next_command(tuning, loop, Path("my loops.toml"))
    assert shlex.split(command) == [
        "autotuner",
        "apply",
        "TIC 101",
        "--config",
        "my loops.toml",
        "--gains",
        "1.5,7.25,0.5",
    ]
