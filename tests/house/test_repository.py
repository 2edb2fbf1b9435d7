"""What lies in the repository, and what must not."""

import re

REGISTRY = re.compile(r"(?i)\b(?:files\.pythonhosted|pypi|anaconda|npmjs|crates)\.(?:org|io|com)\b|/simple/|find-links")
"""Addresses to install from: they belong to the machine that installs, never to a file that everybody gets."""


HERE = "test_repository.py"
"""This file has to name what it looks for."""


def test_no_file_names_a_place_to_install_from(repository_files):
    named = [path for path in repository_files if path.name != HERE and REGISTRY.search(_text(path))]
    assert named == []


def test_no_work_is_left_for_later(repository_files):
    later = re.compile(r"\b(TODO|FIXME|XXX)\b")
    written = [path for path in repository_files if path.name != HERE and path.suffix != ".png"]
    assert [path for path in written if later.search(_text(path))] == []


def test_no_large_or_generated_file(repository_files):
    generated = {".pyc", ".whl", ".db", ".sqlite", ".log"}
    assert [path for path in repository_files if path.suffix in generated] == []
    assert [path for path in repository_files if path.stat().st_size > 1_000_000] == []


def test_changelog_opens_with_what_is_to_come_and_the_version(root, pyproject):
    text = (root / "CHANGELOG.md").read_text(encoding="utf-8")
    headings = re.findall(r"^## (\S+)", text, re.MULTILINE)
    assert next(name for name in headings if name != "Unreleased") == pyproject["project"]["version"]
    assert "Unreleased" not in headings[1:]


def test_every_path_that_the_packaging_names_exists(root, pyproject):
    hatch = pyproject["tool"]["hatch"]["build"]["targets"]
    named = [*hatch["wheel"]["packages"], *(name.lstrip("/") for name in hatch["sdist"]["include"])]
    assert [name for name in named if not (root / name).exists()] == []


def _text(path):
    return path.read_bytes().decode("utf-8", errors="replace")
