"""Shared by the tests of the house itself: the repository's files as they stand in a checkout."""

import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = {
    "autotuner": ROOT / "autotuner",
    "autotuner_drivers": ROOT / "drivers" / "autotuner_drivers",
    "autotuner_sim": ROOT / "sim" / "autotuner_sim",
    "autotuner_models": ROOT / "models" / "autotuner_models",
}


@pytest.fixture(scope="session")
def root():
    return ROOT


@pytest.fixture(scope="session")
def packages():
    """Folder of each import package by its name."""
    return PACKAGES


@pytest.fixture(scope="session")
def modules():
    """Every module of the product."""
    return sorted(path for folder in PACKAGES.values() for path in folder.rglob("*.py"))


@pytest.fixture(scope="session")
def pyproject():
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


@pytest.fixture(scope="session")
def repository_files():
    """Every file that a clone contains, or would contain after the next commit."""
    listed = subprocess.run(
        ["git", "-C", str(ROOT), "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        capture_output=True,
        text=True,
        check=False,
    )
    if listed.returncode:
        pytest.skip("this is no git checkout, so its files cannot be told from what lies beside them")
    return sorted(path for name in listed.stdout.split("\0") if name and (path := ROOT / name).is_file())
