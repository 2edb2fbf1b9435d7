"""Shared by the tests of the page: one browser and one service with a simulated PLC for all of them."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.control.processes import PATIENCE_S


def _neighbour(name):
    spec = importlib.util.spec_from_file_location(f"page_{name}", Path(__file__).with_name(f"{name}.py"))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


_browser = _neighbour("browser")


@pytest.fixture(scope="session")
def accessibility():
    """Return the module of the checks for people who see little or use a keyboard."""
    return _neighbour("accessibility")


@pytest.fixture(scope="module")
def chromium(tmp_path_factory):
    program = _browser.find()
    if program is None:
        pytest.skip("no Chromium is installed on this machine")
    opened = _browser.Browser(program, tmp_path_factory.mktemp("profile"))
    yield opened
    opened.close()


@pytest.fixture
def browser(chromium):
    """Return a headless Chromium with an empty page, and nothing remembered of what it asked and logged before."""
    chromium.open("about:blank")
    chromium.run("1")
    chromium.events.clear()
    return chromium


@pytest.fixture(scope="module")
def start(tmp_path_factory):
    """Return a function that starts a command of the product and returns what its first line tells."""
    running, folder = [], tmp_path_factory.mktemp("service")

    def run(*arguments, config=None):
        if config is not None:
            (folder / "loops.toml").write_text(config, encoding="utf-8")
            arguments = (*arguments, "--config", str(folder / "loops.toml"))
        process = subprocess.Popen(
            [sys.executable, "-m", "autotuner.cli", *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            cwd=folder,
            env=os.environ | {"XDG_STATE_HOME": str(folder / "state")},
        )
        running.append(process)
        return json.loads(process.stdout.readline())

    yield run
    for process in reversed(running):  # the service gives its loops back before their PLC goes
        process.terminate()
        process.communicate(timeout=PATIENCE_S)


@pytest.fixture(scope="session")
def shots(tmp_path_factory):
    """Return the folder for pictures of the page; `AUTOTUNER_SHOTS` names another one to keep them."""
    folder = Path(os.environ.get("AUTOTUNER_SHOTS") or tmp_path_factory.mktemp("shots"))
    folder.mkdir(parents=True, exist_ok=True)
    return folder
