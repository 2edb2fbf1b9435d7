"""Shared by the tests of the page: a browser, and the service as a process."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

_spec = importlib.util.spec_from_file_location("page_browser", Path(__file__).with_name("browser.py"))
_module = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(_module)


@pytest.fixture
def browser(tmp_path):
    """Return a headless Chromium."""
    program = _module.find()
    if program is None:
        pytest.skip("no Chromium is installed on this machine")
    opened = _module.Browser(program, tmp_path / "profile")
    yield opened
    opened.close()


@pytest.fixture
def start(tmp_path):
    """Return a function that starts a command of the product and returns what its first line tells."""
    running = []

    def run(*arguments, config=None):
        if config is not None:
            (tmp_path / "loops.toml").write_text(config, encoding="utf-8")
            arguments = (*arguments, "--config", str(tmp_path / "loops.toml"))
        process = subprocess.Popen(
            [sys.executable, "-m", "autotuner.cli", *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=tmp_path,
        )
        running.append(process)
        return json.loads(process.stdout.readline())

    yield run
    for process in running:
        process.terminate()
    for process in running:
        process.communicate(timeout=30.0)


@pytest.fixture
def shots(tmp_path, request):
    """Return the folder for pictures of the page; `AUTOTUNER_SHOTS` names another one to keep them."""
    folder = Path(os.environ.get("AUTOTUNER_SHOTS", tmp_path / "shots"))
    folder.mkdir(parents=True, exist_ok=True)
    return folder
