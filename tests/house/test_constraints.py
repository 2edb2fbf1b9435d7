"""The pins: complete, hashed, of one mind, within the declared ranges, and without an address."""

import ast
import importlib.metadata
import re
import sys

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

KINDS = ("runtime", "test", "release")


def read_pins(root, kind):
    """Return the pinned requirements and the number of hashes of each, by name."""
    text = (root / "constraints" / f"{kind}.txt").read_text(encoding="utf-8").replace("\\\n", " ")
    rows = [line.split("--hash=") for line in text.splitlines() if line.strip()]
    return {
        canonicalize_name(requirement.name): (requirement, len(hashes))
        for first, *hashes in rows
        for requirement in [Requirement(first.strip())]
    }


@pytest.fixture(scope="module")
def pins(root):
    return {kind: read_pins(root, kind) for kind in KINDS}


@pytest.mark.parametrize("kind", KINDS)
def test_every_pin_is_exact_and_has_hashes(pins, kind):
    assert len(pins[kind]) > 20
    for requirement, hashes in pins[kind].values():
        assert re.fullmatch(r"==[\w.]+", str(requirement.specifier)), requirement
        assert requirement.url is None
        assert hashes >= 1, requirement


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_is_pins_and_hashes_and_nothing_else(root, kind):
    line = re.compile(r"    --hash=sha256:[0-9a-f]{64}( \\)?|[a-z0-9-]+==[\w.]+( ; [\w .'=!<>()]+)? \\")
    text = (root / "constraints" / f"{kind}.txt").read_text(encoding="utf-8")
    assert [row for row in text.splitlines() if not line.fullmatch(row)] == []


@pytest.mark.parametrize("kind", ["runtime", "test"])
def test_the_pins_are_complete(pins, kind):
    """They are installed without their dependencies: each of these is a pin, too, of a version that will do."""
    wanted = [Requirement(name) for name in pins[kind]]
    seen = set()
    while wanted:
        requirement = wanted.pop()
        name = canonicalize_name(requirement.name)
        assert name in pins[kind], requirement
        if (name, str(requirement)) in seen or not is_installed(name):
            continue
        seen.add((name, str(requirement)))
        assert requirement.specifier.contains(importlib.metadata.version(name), prereleases=True), requirement
        extras = ["", *requirement.extras]
        needed = map(Requirement, importlib.metadata.requires(name) or ())
        wanted += [one for one in needed if not one.marker or any(one.marker.evaluate({"extra": it}) for it in extras)]
    assert len(seen) > 20


def is_installed(name):
    """Whether a package is there; one for another platform is not."""
    try:
        importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def test_the_tests_run_on_the_pins_of_the_tuner(pins):
    test = {name: str(requirement) for name, (requirement, _) in pins["test"].items()}
    assert {name: str(requirement) for name, (requirement, _) in pins["runtime"].items()}.items() <= test.items()


def test_the_tools_of_a_release_agree_with_the_pins_of_the_tests(pins):
    for name, (requirement, _) in pins["release"].items():
        other, _ = pins["test"].get(name, (requirement, 1))
        assert requirement.specifier == other.specifier, name


def test_declared_ranges_hold_the_pins(pins, pyproject):
    project = pyproject["project"]
    needed = {
        "runtime": [*project["dependencies"], *pyproject["dependency-groups"]["build"]],
        "test": project["optional-dependencies"]["dev"],
    }
    for kind, requirements in needed.items():
        for requirement in map(Requirement, requirements):
            pin, _ = pins[kind][canonicalize_name(requirement.name)]
            (version,) = (part.version for part in pin.specifier)
            assert requirement.specifier.contains(version), f"{requirement} does not hold {version}"


PART_OF = {"pydantic_core": "pydantic", "serial": "pyserial", "sklearn": "scikit-learn", "starlette": "fastapi"}
"""Modules of a declared package that has another name, or that comes with one and is part of its interface."""


def test_everything_that_is_imported_is_declared(modules, packages, pyproject):
    needed = {canonicalize_name(Requirement(row).name) for row in pyproject["project"]["dependencies"]}
    client = {
        canonicalize_name(Requirement(row).name) for row in pyproject["project"]["optional-dependencies"]["client"]
    }
    for path in modules:
        declared = needed | client if path.is_relative_to(packages["autotuner"] / "client") else needed
        for name in imported_tops(path) - set(packages) - sys.stdlib_module_names:
            assert canonicalize_name(PART_OF.get(name, name)) in declared, f"{path}: imports {name}"


def imported_tops(path):
    """Return the top-level names that a module imports anywhere."""
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    plain = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    return {name.split(".")[0] for name in plain | {n.module for n in nodes if isinstance(n, ast.ImportFrom)}}
