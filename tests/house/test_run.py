"""`run.py`: what it does on a machine of which nothing is known."""

import ast
import importlib.util
import re
import subprocess
import sys
import threading

import pytest

GRACE_S = 60.0
"""Longest wait of a check for the tests that run beside it, s."""
XML = '<testsuites><testsuite tests="12" failures="2" errors="1" skipped="4"/></testsuites>'


@pytest.fixture
def run(root, tmp_path, monkeypatch):
    """The module, looking at a project of its own under a path with a space; pip only notes what it was asked."""
    spec = importlib.util.spec_from_file_location("run_under_test", root / "run.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    project = tmp_path / "a project"
    (project / "constraints").mkdir(parents=True)
    (project / ".venv").mkdir()
    for name in ("pyproject.toml", "constraints/runtime.txt", "constraints/test.txt"):
        (project / name).write_text(f"{name}==1\n")
    monkeypatch.setattr(module, "ROOT", project)
    monkeypatch.setattr(module, "STAMP", project / ".venv" / "stamp.txt")
    monkeypatch.setattr(module, "working_pip", lambda: ["pip"])
    module.asked = []
    module.installed = []
    module.compile_now = module.compile_installed
    monkeypatch.setattr(module, "compile_installed", lambda: None)

    def pip(command):
        module.asked.append([str(word) for word in command])
        if command[-2] == "-r":
            module.installed.append(command[-1].read_text())

    monkeypatch.setattr(module, "run_pip", pip)
    return module


def test_installs_by_hash_first_and_the_project_last(run):
    run.install("runtime")
    pins, project = run.asked
    assert {"--require-hashes", "--no-deps", "-r"} <= set(pins)
    assert run.installed == ["constraints/runtime.txt==1\n"]
    assert project[-2:] == ["-e", str(run.ROOT)]
    assert {"--no-deps", "--no-build-isolation"} <= set(project)


def test_each_pin_is_installed_once_with_its_hashes(run, root):
    pins = (root / "constraints" / "test.txt").read_text()
    (run.ROOT / "constraints" / "test.txt").write_text(pins)
    run.install("test")
    assert len(run.installed) == run.INSTALLERS
    assert all("==" in text.partition("\n")[0] for text in run.installed)
    assert sorted("".join(run.installed).splitlines()) == sorted(pins.splitlines())


def test_what_pip_leaves_to_be_compiled_is_compiled(run, monkeypatch):
    monkeypatch.setattr(run, "compile_installed", lambda: run.asked.append("compiled"))
    run.install("runtime")
    assert "--no-compile" in run.asked[0]
    assert run.asked[-1] == "compiled"


@pytest.mark.parametrize("new", [True, False])
def test_what_the_tests_import_is_compiled_once_before_them(run, monkeypatch, new):
    asked = []
    monkeypatch.setattr(run, "install", lambda _kind: new)
    monkeypatch.setattr(run, "failed_checks", list)
    monkeypatch.setattr(run, "call", lambda command, *_without, **_options: asked.append(command[1:]))
    monkeypatch.setattr(run, "run_tests", lambda *_words, **_options: asked.append("tests") or 0)
    assert run.main(["quick", "tests/house"]) == 0
    assert asked == [[*run.COLLECTING, "tests/house"]] * new + ["tests"]


def test_modules_are_compiled_without_the_tests_of_packages(run, tmp_path, monkeypatch):
    monkeypatch.setattr(run, "VENV", tmp_path)
    monkeypatch.setattr(run, "PYTHON", sys.executable)
    for name in ("package/module.py", "package/tests/test_module.py", "package/template.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("def {name}" if "template" in name else "x = 1\n")
    run.compile_now()
    assert [file.name.partition(".")[0] for file in tmp_path.rglob("*.pyc")] == ["module"]


@pytest.mark.parametrize(("first", "second", "installations"), [
    ("runtime", "runtime", 1),
    ("test", "test", 1),
    ("test", "runtime", 1),
    ("runtime", "test", 2),
])  # fmt: skip
def test_installs_what_is_missing_and_no_more(run, first, second, installations):
    run.install(first)
    run.install(second)
    assert len(run.asked) == 2 * installations


@pytest.mark.parametrize("changed", ["pyproject.toml", "constraints/runtime.txt"])
def test_a_changed_file_installs_again(run, changed):
    run.install("runtime")
    (run.ROOT / changed).write_text("changed==2\n")
    run.install("runtime")
    assert len(run.asked) == 4


def test_an_interrupted_installation_is_done_again(run, monkeypatch):
    run.install("test")
    (run.ROOT / "pyproject.toml").write_text("changed\n")

    def interrupted(command):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(run, "run_pip", interrupted)
        assert run.main(["tune"]) == 130
    run.asked.clear()
    run.install("runtime")
    assert len(run.asked) == 2


@pytest.mark.parametrize("words", [[], ["--help"], ["-h"]])
def test_without_a_word_it_says_what_it_can_do(run, capsys, words):
    assert run.main(words) == (0 if words else 2)
    assert "python3 run.py tune" in capsys.readouterr().out
    assert run.asked == []


@pytest.mark.parametrize("says", [
    ("THESE PACKAGES DO NOT MATCH THE HASHES FROM THE REQUIREMENTS FILE", "not the one that was tested"),
    ("Retrying after connection broken by 'NewConnectionError'\nERROR: No matching distribution", "network"),
    ("ERROR: No matching distribution found for scipy==1.17.1", "64-bit CPython"),
    ("OSError: [Errno 28] No space left on device", "disk is full"),
    ("ERROR: something new", "pip says why above"),
])  # fmt: skip
def test_a_failing_pip_is_explained(root, capfd, says, monkeypatch):
    spec = importlib.util.spec_from_file_location("run_explaining", root / "run.py")
    run = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(run)
    words, meaning = says
    script = f"import sys; sys.stderr.write({words!r}); sys.exit(1)"
    with pytest.raises(run.InstallError, match=meaning):
        run.run_pip([sys.executable, "-c", script])
    assert words in capfd.readouterr().err


def test_settings_that_send_an_installation_elsewhere_are_dropped(run, monkeypatch):
    for name in ("PIP_TARGET", "PIP_USER", "PYTHONPATH"):
        monkeypatch.setenv(name, "elsewhere")
    monkeypatch.setenv("PIP_INDEX_URL", "kept: where to download from is the machine's own affair")
    environment = run.clean()
    assert "PIP_INDEX_URL" in environment
    assert not {"PIP_TARGET", "PIP_USER", "PYTHONPATH"} & set(environment)


def test_the_tests_start_with_compiled_modules_whatever_the_caller_sets(run, monkeypatch):
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    commands = []
    monkeypatch.setattr(run.subprocess, "run", lambda command, **options: commands.append((command, options["env"])))
    run.call(["tuner"])
    run.call(["tests"], without=(*run.REDIRECTING, *run.SLOWING))
    assert ["PYTHONDONTWRITEBYTECODE" in environment for _, environment in commands] == [True, False]


def test_the_files_on_the_wall_clock_hold_every_mark(run, root, monkeypatch):
    """A mark that a shared module sets would be met by no run of the tests."""
    monkeypatch.setattr(run, "ROOT", root)
    files = {root / file for file in run.marked_files()}
    marked = {file for file in (root / "tests").rglob("*.py") if "mark.realtime" in file.read_text(encoding="utf-8")}
    assert marked == files


def test_the_closing_line_counts(run, tmp_path):
    (tmp_path / "results.xml").write_text(XML)
    assert run.count_tests([tmp_path / "results.xml"]) == "5 passed, 3 failed, 4 skipped"
    assert run.count_tests([tmp_path / "results.xml"] * 2) == "10 passed, 6 failed, 8 skipped"
    assert run.count_tests([]) == "no test was run"


@pytest.mark.parametrize(("codes", "expected"), [
    ((0, 0, 0), 0),
    ((0, 5, 5), 0),  # a selection that has nothing in real time
    ((5, 5, 5), 1),
    ((1, 0, 0), 1),
    ((0, 1, 0), 1),
    ((0, 0, 2), 1),
])  # fmt: skip
def test_each_run_of_the_tests_can_fail(run, monkeypatch, codes, expected):
    left = iter(codes)
    monkeypatch.setattr(run, "passes", lambda *_: True)
    monkeypatch.setattr(run, "run_tests", lambda *_, **__: next(left))
    assert run.test("test", new=False) == expected


def test_the_checks_run_beside_the_tests_and_end_before_what_is_alone(run, monkeypatch):
    begun, order = threading.Event(), []

    def passes(name, _):
        order.append(name)
        return begun.wait(GRACE_S)

    def run_tests(name, *_, **__):
        if name == run.QUICK:
            begun.set()
        order.append(name)
        return 0

    monkeypatch.setattr(run, "passes", passes)
    monkeypatch.setattr(run, "run_tests", run_tests)
    assert run.test("test", new=False) == 0
    assert order[-1] == run.ALONE
    assert {*order} == {*run.CHECKS, run.QUICK, run.WAITING, run.ALONE}


def test_a_check_that_finds_something_fails_the_run(run, monkeypatch, capsys):
    monkeypatch.setattr(run, "passes", lambda name, _: name != "ruff check")
    monkeypatch.setattr(run, "run_tests", lambda *_, **__: 0)
    assert run.test("test", new=False) == 1
    assert capsys.readouterr().err.strip().endswith("FAILED: ruff check")


PYTEST = "[tool.pytest]\nmarkers = ['long: -', 'realtime: -', 'alone: -']\naddopts = ['-p', 'xdist.plugin']\n"
DISTURBED = """
import pathlib, pytest

@pytest.mark.realtime
@pytest.mark.parametrize("number", range(2))
def test_disturbed(number):
    file = pathlib.Path(__file__).with_name(f"seen-{number}")
    seen = file.exists()
    file.touch()
    assert seen and pathlib.Path(__file__).with_name("quiet").exists() >= number
"""


@pytest.fixture
def disturbed(run, monkeypatch):
    """The module, with a project of two tests that fail at first; one passes alone, both do when `quiet` is there."""
    (run.ROOT / "pyproject.toml").write_text(PYTEST)
    (run.ROOT / "test_inner.py").write_text(DISTURBED)
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")  # a quick start
    monkeypatch.setattr(run, "PYTHON", sys.executable)
    monkeypatch.setattr(run, "passes", lambda *_: True)
    for name, options in run.RUNS.items():  # one worker each, for two tests
        alone = [re.sub("^--numprocesses=.*", "--numprocesses=1", option) for option in options]
        monkeypatch.setitem(run.RUNS, name, alone)
    return run


def test_a_disturbed_test_passes_alone_and_is_told(disturbed, capfd):
    (disturbed.ROOT / "quiet").touch()
    assert disturbed.main(["test"]) == 0
    names = "test_inner::test_disturbed[0], test_inner::test_disturbed[1]"
    assert capfd.readouterr().err.splitlines()[-2:] == [
        f"run.py: failed: {names}; run once more, alone",
        f"run.py: 0 passed, 2 failed, 0 skipped (failed at first, passed alone: {names}); all clean: "
        + ", ".join(disturbed.CHECKS),
    ]


def test_a_test_that_fails_again_fails_the_run(disturbed, capfd):
    assert disturbed.main(["test"]) == 1
    said = capfd.readouterr().err.splitlines()[-1]
    assert "failed at first, passed alone: test_inner::test_disturbed[0];" in said
    assert "failed at first and not passed alone: test_inner::test_disturbed[1]" in said
    assert "FAILED: pytest on the wall clock (code 1)" in said


@pytest.mark.parametrize(("name", "code", "failures", "expected"), [
    ("on the wall clock", 1, 3, True),
    ("on the wall clock", 1, 4, False),
    ("on the wall clock", 2, 3, False),  # interrupted
    ("alone on the machine", 1, 1, True),
    ("alone on the machine", 1, 0, False),
    ("side by side", 1, 1, False),
])  # fmt: skip
def test_few_failures_on_the_wall_clock_are_run_again(run, tmp_path, name, code, failures, expected):
    cases = "".join(f'<testcase classname="a" name="{number}"><failure/></testcase>' for number in range(failures))
    (tmp_path / "results.xml").write_text(f"<testsuite>{cases}</testsuite>")
    assert run.is_repeated(name, code, tmp_path / "results.xml") == expected


def test_a_python_that_is_too_old_can_read_why(root):
    """The whole file is compiled before its version check runs, so all of it must be grammar of an old Python."""
    text = (root / "run.py").read_text(encoding="utf-8")
    ast.parse(text, feature_version=(3, 6))
    assert "from __future__" not in text
    head = text.partition("import hashlib")[0]
    old = head.replace("sys.version_info < (3, 11)", "True")
    done = subprocess.run([sys.executable, "-c", old], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "Python 3.11 or later is needed" in done.stderr
