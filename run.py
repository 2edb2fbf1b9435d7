"""Run the tuner, or its tests, on a machine that has Python 3.11 or later and nothing else.

    python3 run.py tune        install what the tuner needs, then tune a simulated loop
    python3 run.py test        install what the tests need, then check and test everything
    python3 run.py quick       the same without the tests on the wall clock
    python3 run.py long        the tests that `test` leaves out: what they show is in a shorter test too
    python3 run.py coverage    those of `quick`, and which lines of the product they ran
    python3 run.py release     make a wheel and its software bill of materials (CycloneDX) in `dist`
    python3 run.py WORD ...    install what the tuner needs, then do `autotuner WORD ...`

Invariants:

1. Standard library only; down to the version check it is readable for every Python 3, to be able to say what is wrong.
2. Everything goes into `.venv` beside this file, pinned by hash; nothing outside of it is changed.
3. The stamp is written last, so an interrupted installation is done again and a finished one costs nothing.
"""

import sys

if sys.version_info < (3, 11):  # noqa: UP036 - this line is written for the older ones
    sys.exit(
        "run.py: Python 3.11 or later is needed and this is Python %d.%d. "  # noqa: UP031 - see rule 1
        "Install a newer one and call it by its name, such as: python3.12 run.py tune" % sys.version_info[:2]
    )

import hashlib
import importlib.util
import os
import re
import shutil
import subprocess
import tempfile
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

ROOT = Path(__file__).resolve().parent
VENV = ROOT / ".venv"
STAMP = VENV / "installed-by-run.txt"
DIST = ROOT / "dist"
TOOLS = ROOT / ".venv-release"
"""What makes a release and is no part of it."""
BOM = "relay-autotuner.cdx.json"
PYTHON = VENV / ("Scripts/python.exe" if os.name == "nt" else "bin/python")

REDIRECTING = ("PIP_CONSTRAINT", "PIP_PREFIX", "PIP_TARGET", "PIP_USER", "PYTHONHOME", "PYTHONPATH")
"""Settings of the caller that would send the installation, or its imports, somewhere else."""
SLOWING = ("PYTHONDONTWRITEBYTECODE",)
"""Settings of the caller under which each process of the tests would compile all that it imports."""

PINNED = ("--require-hashes", "--no-deps")
"""How pip installs pins: they are complete, so nothing is resolved, and no newer release can get in the way."""
PACKAGE = re.compile(r"^\S.*\n?(?:\s.*\n?)*", re.MULTILINE)
"""A package in a file of pins: its version, then its hashes in lines that begin with a space."""
INSTALLERS = 2
"""Processes that install packages at once: as many as the smallest machine has processors."""
UNCOMPILED = r"[/\\](tests?|pip|setuptools)[/\\]"
"""Folders that are not compiled beforehand: the packages' own tests, and pip."""
COMPILING = ["-m", "compileall", "-qq", "-j", "0", "-x", UNCOMPILED]
"""How what was installed is compiled: on all processors, where pip takes one."""
COLLECTING = ["-m", "pytest", "--collect-only", "-qq"]
"""How one process imports, and so compiles, what the tests do: a third of what is installed with them."""

CHECKS = {
    "ruff check": ["-m", "ruff", "check"],
    "ruff format": ["-m", "ruff", "format", "--check"],
    "mypy --strict": ["-m", "mypy"],
    "import contracts": ["-c", "from importlinter.cli import lint_imports_command as check; check()"],
}

UNUSED = ("-p", "no:schemathesis")
"""A plugin that takes half a second to import in each process, and that no test on the wall clock uses."""
RUNS = {
    "side by side": [
        "-m",
        "not long and not realtime",
        "--numprocesses=auto",
        "--dist=loadfile",
        "--no-loadscope-reorder",
    ],
    "on the wall clock": [
        "-m",
        "not long and realtime and not alone",
        "--numprocesses=4",
        "--dist=loadfile",
        *UNUSED,
    ],
    "alone on the machine": ["-m", "not long and realtime and alone", *UNUSED],
    "of the long run": ["-m", "long", "--numprocesses=auto", "--dist=load"],
}
"""The tests by runs. Most that are on the wall clock wait for processes; those that measure it run alone."""
QUICK = "side by side"
WAITING = "on the wall clock"
"""The run that waits more than it computes: it has the first turn on the processors, beside `QUICK`."""
ALONE = "alone on the machine"
MARK = "realtime"
"""The mark of the tests of `WAITING` and `ALONE`, whose workers import only the files that have it."""
YIELDING = ["nice", "-n", "5"]
"""How `QUICK` is run beside `WAITING`: a third of the weight of what is on the wall clock (`nice`, POSIX)."""
COVERAGE = ["--cov", "--cov-report=term"]
WORDS: dict[str, tuple[list[str], list[str]]] = {
    "test": ([QUICK, WAITING, ALONE], []),
    "quick": ([QUICK], []),
    "long": (["of the long run"], []),
    "coverage": ([QUICK], COVERAGE),
}
"""The runs of each word, and what it tells pytest beside."""
FAILED = 1
"""What pytest answers when tests failed."""
NO_TESTS = 5
"""What pytest answers when a selection is empty."""
MOST_REPEATED = 3
"""Tests of a run on the wall clock that may fail and are repeated: what disturbs a machine strikes few of them."""

HINTS = {
    "DO NOT MATCH THE HASHES": "a downloaded package is not the one that was tested. Nothing of it was installed. "
    "Check what stands between this machine and the package index, then run the same command again.",
    "No space left": "the disk is full. Make room and run the same command again.",
    "connection broken": "the package index cannot be reached. Connect to the network (behind a proxy: set "
    "HTTPS_PROXY; with a mirror: configure pip for it) and run the same command again.",
    "No matching distribution": "a package is not offered for this Python on this machine, or pip was told to look "
    "elsewhere. Use a 64-bit CPython 3.11, 3.12 or 3.13.",
}
"""What pip says, and what it means."""


class InstallError(Exception):
    """The installation cannot go on; the text says why and what to do."""


def main(words: list[str]) -> int:
    """Install what is missing, then do what was asked."""
    if not words or words[0] in {"-h", "--help"}:
        print(__doc__.partition("Invariants")[0].strip())
        return 0 if words else 2
    try:
        installed = install("test" if words[0] in WORDS else "runtime")
    except (InstallError, OSError) as error:
        say(str(error))
        return 1
    except KeyboardInterrupt:
        say("interrupted; the same command goes on where it stopped")
        return 130
    if words[0] == "release":
        return release()
    return test(*words, new=installed) if words[0] in WORDS else become([str(PYTHON), "-P", "-m", "autotuner", *words])


def say(text: str) -> None:
    """Speak on standard error: standard output belongs to the program that is run."""
    print(f"run.py: {text}", file=sys.stderr, flush=True)


def install(kind: str) -> bool:
    """Bring `.venv` to the pins of `constraints/KIND.txt`; return False, at once, when it is there already."""
    if STAMP.exists() and fingerprint(kind) in STAMP.read_text(encoding="utf-8").split():
        return False
    pip = working_pip()
    STAMP.unlink(missing_ok=True)
    pins = ROOT / "constraints" / f"{kind}.txt"
    packages = PACKAGE.findall(pins.read_text(encoding="utf-8"))
    say(f"installing {len(packages)} packages into {VENV} (once; a minute or two)")
    install_pinned(pip, packages)
    run_pip([*pip, "install", "--no-deps", "--no-build-isolation", "-e", ROOT])
    if kind == "runtime":
        compile_installed()
    covered = {kind, "runtime"}  # the pins of the tests contain those of the tuner
    STAMP.write_text("\n".join(map(fingerprint, sorted(covered))) + "\n", encoding="utf-8")
    return True


def install_pinned(pip: list[str | Path], packages: list[str]) -> None:
    """Install packages by several processes: one takes a processor to unpack, and complete pins wait for no others."""
    shares = [packages[number::INSTALLERS] for number in range(INSTALLERS)]
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor() as pool:
        files = [Path(folder) / f"{number}.txt" for number, share in enumerate(shares) if share]
        for file, share in zip(files, shares, strict=False):
            file.write_text("".join(share), encoding="utf-8")
        command = [*pip, "install", *PINNED, "--no-compile", "--only-binary", ":all:", "-r"]
        for done in [pool.submit(run_pip, [*command, file]) for file in files]:
            done.result()


def fingerprint(kind: str) -> str:
    """Return what an installation depends on, as one word."""
    files = (ROOT / "constraints" / f"{kind}.txt", ROOT / "pyproject.toml")
    parts = [os.fsencode(ROOT), repr(sys.version_info[:2]).encode(), *(file.read_bytes() for file in files)]
    return hashlib.sha256(b"\0".join(parts)).hexdigest()


def working_pip() -> list[str | Path]:
    """Return the pip command for `.venv`, which is made anew when it is missing, damaged or of another Python."""
    check = f"import sys, pip; sys.exit(sys.version_info[:2] != {sys.version_info[:2]})"
    if PYTHON.exists() and call([PYTHON, "-P", "-c", check], stderr=subprocess.DEVNULL).returncode == 0:
        return [PYTHON, "-P", "-m", "pip"]
    present = {name for name in ("venv", "ensurepip", "pip") if importlib.util.find_spec(name)}
    if "venv" not in present or not present & {"ensurepip", "pip"}:
        raise InstallError(
            "this Python cannot make virtual environments (no ensurepip). On Debian and Ubuntu: "
            "apt-get install python3-venv; elsewhere install a complete Python 3.11 or later."
        )
    borrowed = [] if "ensurepip" in present else ["--without-pip"]
    if call([sys.executable, "-P", "-m", "venv", "--clear", *borrowed, VENV]).returncode:
        raise InstallError(f"{VENV} could not be made; the reason stands above.")
    return [sys.executable, "-P", "-m", "pip", "--python", PYTHON] if borrowed else [PYTHON, "-P", "-m", "pip"]


def run_pip(command: list[str | Path]) -> None:
    """Run pip; raise `InstallError` with its words and their meaning when it fails."""
    quiet = ["--quiet", "--no-input", "--disable-pip-version-check", "--no-warn-script-location"]
    done = call([*command, *quiet], stderr=subprocess.PIPE, text=True, errors="replace")
    if done.returncode:
        sys.stderr.write(done.stderr)
        meaning = (hint for words, hint in HINTS.items() if words in done.stderr)
        raise InstallError(f"not installed: {next(meaning, 'pip says why above.')}")


def compile_installed() -> None:
    """Compile the installed modules; templates, which are no Python yet, are passed over."""
    call([PYTHON, "-P", *COMPILING, VENV])


def call(
    command: list[str | Path], without: tuple[str, ...] = REDIRECTING, **options: Any
) -> "subprocess.CompletedProcess[str]":
    """Run a program to its end, free of the caller's redirections."""
    return subprocess.run(command, check=False, env=clean(without), **options)


def clean(without: tuple[str, ...] = REDIRECTING) -> dict[str, str]:
    """Return the environment without some settings, such as what would redirect an installation or an import."""
    return {name: value for name, value in os.environ.items() if name not in without}


def become(command: list[str]) -> int:
    """Let the program take the place of this one, so that a signal reaches it and the loop is given back."""
    if os.name == "posix":
        os.execve(command[0], command, clean())  # noqa: S606 - no shell is wanted
    with subprocess.Popen(command, env=clean()) as process:
        while True:
            try:
                return process.wait()
            except KeyboardInterrupt:
                continue  # the program got it too, and is giving the loop back


def test(word: str, *extra: str, new: bool) -> int:
    """Run the checks and the tests of a word; `extra` goes to pytest.

    What is `new` is compiled by one process beside the checks: otherwise each worker would compile it for itself.
    """
    chosen, options = WORDS[word]
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(1) as pool:
        checks = pool.submit(failed_checks)
        if new:
            call([PYTHON, *COLLECTING, *extra], (*REDIRECTING, *SLOWING), cwd=ROOT, stdout=subprocess.DEVNULL)
        results = {name: Path(folder) / f"{name}.xml" for name in chosen}
        codes = run_all(results, [*options, *extra], checks)
        failed = checks.result()
        counts = count_tests([file for file in results.values() if file.exists()])
        for name in [name for name, file in results.items() if is_repeated(name, codes[name], file)]:
            codes[name], said = run_again(name, results[name], [*extra])
            counts += f" ({said})"
    if set(codes.values()) == {NO_TESTS}:
        failed.append("pytest (no test was selected)")
    failed += [f"pytest {name} (code {code})" for name, code in codes.items() if code not in {0, NO_TESTS}]
    say(f"{counts}; {'FAILED: ' + ', '.join(failed) if failed else 'all clean: ' + ', '.join(CHECKS)}")
    return 1 if failed else 0


def is_repeated(name: str, code: int, results: Path) -> bool:
    """Return whether the failed tests of a run are run again: few of them, on the wall clock."""
    few = 1 <= len(failed_tests(results)) <= MOST_REPEATED
    return name in {WAITING, ALONE} and code == FAILED and few


def run_again(name: str, results: Path, extra: list[str]) -> tuple[int, str]:
    """Run the failed tests of a run once more, alone; return the code of both runs together, and both results."""
    failed, again = failed_tests(results), results.with_suffix(".again.xml")
    say(f"failed: {', '.join(failed)}; run once more, alone")
    run_tests(name, again, [*extra, "--last-failed", "--last-failed-no-failures=none", "--numprocesses=0"])
    passed = [test for test in failed if test in all_tests(again) and test not in failed_tests(again)]
    said = {
        "failed at first, passed alone": passed,
        "failed at first and not passed alone": [test for test in failed if test not in passed],
    }
    code = 0 if passed == failed else FAILED
    return code, "; ".join(f"{words}: {', '.join(tests)}" for words, tests in said.items() if tests)


def release() -> int:
    """Make the wheel and the bill of its materials: every package that comes with it, with version and hashes."""
    tool = TOOLS / PYTHON.relative_to(VENV)
    steps: list[list[str | Path]] = [
        [PYTHON, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", DIST, ROOT],
        [sys.executable, "-m", "venv", TOOLS],
        [tool, "-m", "pip", "install", "--quiet", *PINNED, "-r", ROOT / "constraints/release.txt"],
        [tool, "-m", "cyclonedx_py", "requirements", "--pyproject", ROOT / "pyproject.toml", "--output-reproducible",
         "--output-file", DIST / BOM, ROOT / "constraints/runtime.txt"],
    ]  # fmt: skip
    for step in steps:
        if call(step, cwd=ROOT).returncode:
            say(f"no release: {' '.join(map(str, step))}")
            return 1
    say(f"{DIST}: {', '.join(sorted(file.name for file in DIST.iterdir()))}")
    return 0


def run_all(results: dict[str, Path], extra: list[str], checks: "Future[list[str]]") -> dict[str, int]:
    """Run the tests of each kind and return pytest's exit codes.

    `QUICK`, `WAITING` and the checks run beside each other; `ALONE` begins after them.
    """
    beside = {QUICK, WAITING} <= set(results) and shutil.which(YIELDING[0]) is not None
    codes = {}
    with ThreadPoolExecutor() as pool:
        waiting = pool.submit(run_tests, WAITING, results[WAITING], extra, quiet=True) if beside else None
        for name, file in results.items():
            if name == ALONE:
                checks.result()
            if waiting is not None and name == WAITING:
                codes[name] = waiting.result()
            else:
                codes[name] = run_tests(name, file, extra, yielding=beside and name == QUICK)
    return codes


def run_tests(name: str, results: Path, extra: list[str], *, quiet: bool = False, yielding: bool = False) -> int:
    """Run the tests of one kind and return pytest's exit code.

    A `quiet` run shows its words at its end, a `yielding` one leaves the processors to others first.
    """
    command: list[str | Path] = [*(YIELDING if yielding else []), PYTHON, "-m", "pytest", *RUNS[name]]
    command += ["-o", f"cache_dir=.pytest_cache/{name}"]  # what failed is noted by each run for itself
    if name in {WAITING, ALONE} and not extra:
        command += marked_files()
    said: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True} if quiet else {}
    if not quiet:
        print(f"== tests {name}", flush=True)
    done = call([*command, f"--junitxml={results}", *extra], cwd=ROOT, without=(*REDIRECTING, *SLOWING), **said)
    if quiet:
        print(f"== tests {name}\n{done.stdout}", flush=True)
    return done.returncode


def marked_files() -> list[Path]:
    """Return the files with tests on the wall clock."""
    files = sorted((ROOT / "tests").rglob("test_*.py"))
    return [file.relative_to(ROOT) for file in files if MARK in file.read_text(encoding="utf-8")]


def failed_checks() -> list[str]:
    """Run the checks one after another and return the names of those that found something."""
    return [name for name, command in CHECKS.items() if not passes(name, command)]


def passes(name: str, command: list[str]) -> bool:
    """Run one check and return whether it found nothing; its output is printed at its end."""
    yielding = YIELDING if shutil.which(YIELDING[0]) else []
    done = call([*yielding, PYTHON, *command], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    print(f"== {name}\n{done.stdout}", flush=True)
    return done.returncode == 0


def all_tests(results: Path, outcomes: tuple[str, ...] = ("",)) -> list[str]:
    """Return the tests of a run by name: those of certain outcomes, or all."""
    cases = ET.parse(results).iter("testcase") if results.exists() else ()  # noqa: S314 - our own files
    chosen = [case.attrib for case in cases if any(not word or case.find(word) is not None for word in outcomes)]
    return list(dict.fromkeys(f"{case['classname']}::{case['name']}" for case in chosen))


def failed_tests(results: Path) -> list[str]:
    """Return the tests that failed in a run, or whose fixtures did, by name."""
    return all_tests(results, ("failure", "error"))


def count_tests(results: list[Path]) -> str:
    """Return the numbers of passed, failed and skipped tests in words."""
    suites = [next(ET.parse(file).iter("testsuite")).attrib for file in results]  # noqa: S314 - our own files
    total, skipped = (sum(int(suite[word]) for suite in suites) for word in ("tests", "skipped"))
    failed = sum(int(suite["failures"]) + int(suite["errors"]) for suite in suites)
    return f"{total - failed - skipped} passed, {failed} failed, {skipped} skipped" if suites else "no test was run"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
