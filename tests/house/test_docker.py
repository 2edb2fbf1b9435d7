"""The container's files, as far as they can be held to the project without a container engine."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
import yaml

from autotuner.cli import main
from autotuner.configuration import load_configuration

ROOT = Path(__file__).resolve().parents[2]
DOCKER = ROOT / "docker"
DOCKERFILE = (DOCKER / "Dockerfile").read_text(encoding="utf-8").replace("\\\n", " ")
COMPOSE = yaml.safe_load((DOCKER / "compose.yaml").read_text(encoding="utf-8"))
STAGES = DOCKERFILE.split("\nFROM ")[1:]


def test_whatever_is_copied_exists_and_is_not_ignored() -> None:
    ignored = (ROOT / ".dockerignore").read_text(encoding="utf-8").split()
    copies = [shlex.split(line)[1:-1] for line in re.findall(r"^COPY (?!--from).*$", DOCKERFILE, re.MULTILINE)]
    names = [name for copy in copies for name in copy]
    assert names
    assert all((ROOT / name).exists() for name in names)
    assert not {Path(name).parts[0] for name in names} & set(ignored)


def test_every_import_package_is_copied() -> None:
    for package in ("autotuner", "drivers", "sim", "models"):
        assert f"COPY {package} {package}" in STAGES[0]


def test_packages_are_pinned_by_hash() -> None:
    installs = re.findall(r"pip install (.*)", DOCKERFILE)
    assert all("--require-hashes" in line or "--no-deps" in line for line in installs)


def test_it_does_not_run_as_root() -> None:
    assert re.search(r"^USER autotuner$", STAGES[-1], re.MULTILINE)


def test_the_served_configuration_is_sound(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(DOCKER / "autotuner.toml")]) == 0
    assert "TIC-101" in capsys.readouterr().out


def test_the_loops_are_those_of_the_example() -> None:
    assert load_configuration(DOCKER / "autotuner.toml").loops == load_configuration(ROOT / "examples/plc.toml").loops


def test_tunings_are_kept_on_the_volume() -> None:
    kept = load_configuration(DOCKER / "autotuner.toml").service.data_directory
    assert f"data:{kept}" in COMPOSE["services"]["autotuner"]["volumes"]
    assert f"VOLUME {kept}" in STAGES[-1]


@pytest.mark.parametrize("name", COMPOSE["services"])
def test_a_service_has_no_more_rights_than_it_needs(name: str) -> None:
    service = COMPOSE["services"][name]
    assert service["read_only"]
    assert service["cap_drop"] == ["ALL"]


def test_the_health_check_asks_the_port_that_is_served() -> None:
    port = load_configuration(DOCKER / "autotuner.toml").service.port
    assert f"127.0.0.1:{port}/healthz" in STAGES[-1]
