"""The wheel and the source distribution: what is in them, and that the wheel works where nothing else of ours is."""

import importlib.util
import os
import subprocess
import sys
import sysconfig
import tarfile
import zipfile

import pytest


def build(kind, root, folder):
    """Build offline with what is installed, beside the checkout, not inside it."""
    done = subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "--target", kind, "--directory", str(folder)],
        cwd=root,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return next(folder.iterdir())


@pytest.fixture(scope="module")
def wheel(root, tmp_path_factory):
    return build("wheel", root, tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def names(wheel):
    with zipfile.ZipFile(wheel) as archive:
        return archive.namelist()


def test_top_level_is_exactly_the_four_packages(names, packages, pyproject):
    version = pyproject["project"]["version"]
    assert {name.split("/")[0] for name in names} == {*packages, f"relay_autotuner-{version}.dist-info"}


def test_every_module_type_marker_and_licence_is_in_it(names, packages):
    for package, folder in packages.items():
        modules = {f"{package}/{path.relative_to(folder).as_posix()}" for path in folder.rglob("*.py")}
        assert modules | {f"{package}/py.typed"} <= set(names)
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)


def test_nothing_in_it_but_code_and_data_of_the_packages(names):
    strange = [name for name in names if "__pycache__" in name or name.split("/")[0] in {"tests", "docs", "examples"}]
    assert strange == []


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """Return a function that runs Python in an empty folder, where only the installed wheel is ours.

    `-S` leaves out the `.pth` file through which the checkout itself is installed.
    """
    if importlib.util.find_spec("pip") is None:
        pytest.skip("pip is not installed in this environment")
    target, empty = tmp_path_factory.mktemp("installed"), tmp_path_factory.mktemp("empty")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target", str(target)]
    subprocess.run([*pip, str(wheel)], check=True, capture_output=True)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(target), sysconfig.get_path("purelib")])}

    def run(*words):
        words = [word.replace("TARGET", str(target)) for word in words]
        return subprocess.run(
            [sys.executable, "-S", *words], cwd=empty, env=environment, capture_output=True, text=True, check=False
        )

    return run


def test_its_packages_are_found_in_it(installed, packages):
    script = f"import {', '.join(packages)}; print(*({', '.join(f'{name}.__file__' for name in packages)},))"
    done = installed("-c", script)
    assert done.returncode == 0, done.stderr
    assert all("installed" in place for place in done.stdout.split())


@pytest.mark.parametrize("words", [["--help"], ["--version"], ["plc", "--help"], ["reproduce", "--help"]])
def test_its_command_works_in_an_empty_folder(installed, words):
    done = installed("TARGET/bin/autotuner", *words)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(("usage: autotuner", "autotuner "))


def test_source_distribution_holds_what_it_takes_to_test_it(root, tmp_path):
    with tarfile.open(build("sdist", root, tmp_path)) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    wanted = {"run.py", "pyproject.toml", "README.md", "CHANGELOG.md", "LICENSE", "constraints/test.txt"}
    assert wanted <= names
    assert any(name.startswith("tests/house/") for name in names)
