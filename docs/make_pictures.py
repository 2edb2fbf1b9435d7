"""Make the pictures of docs/images.

python docs/make_pictures.py           those that are computed
python docs/make_pictures.py --page    those of the page too, with a headless Chromium, as its tests see it
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from autotuner.core.process import Fopdt
from autotuner.core.tuning import PidSettings, Scenario, predict, tune
from autotuner.reports.document import STYLE
from autotuner.reports.svg import Curve, Panel, picture

if TYPE_CHECKING:
    from autotuner.core.arrays import FloatArray

DOCS = Path(__file__).resolve().parent
EVERY = 5
"""Samples of a simulation per point of a picture."""
COLOURS = 96
"""Of a picture of the page: it is flat, and a quarter of the bytes does."""
SHOTS = ("loops-1280-light", "form-1280-light", "result-1280-light", "live-390-dark")
MADE = {"ziegler-nichols.svg", "process.svg", "demo.png", *(f"page-{name}.png" for name in SHOTS)}
"""Every picture of the documentation."""


def pictures() -> None:
    """Write the pictures that are computed."""
    model = Fopdt(2.0, 10.0, 1.5)
    chosen = [
        ("Ziegler-Nichols", tune(model, rule="ziegler_nichols_pid"), 1),
        *((goal, tune(model, goal=goal), colour) for goal, colour in (("calm", 5), ("balanced", 0), ("brisk", 2))),
    ]
    scenario = Scenario(60.0, 0.05, set_point_step=1.0)
    runs = [(name, predict(model, PidSettings(tuning.gains), scenario), colour) for name, tuning, colour in chosen]
    t = np.asarray(runs[0][1].t)[::EVERY]
    panels = [
        Panel("PV", [Curve(name, np.asarray(run.pv)[::EVERY], colour) for name, run, colour in runs], 190.0),
        Panel("output", [Curve(name, np.asarray(run.output)[::EVERY], colour) for name, run, colour in runs], 110.0),
    ]
    drawn = picture(t, panels, "A step of the set point by 1 under four sets of gains")
    _keep("ziegler-nichols.svg", drawn)
    shape = [Panel("PV after 1 % of output", [Curve("process", np.asarray(model.K * _lag(t, model)), 0)], 150.0)]
    _keep("process.svg", picture(t, shape, "Step response of K 2, T 10 s, D 1.5 s"))
    _demo()


def _demo() -> None:
    command = [sys.executable, "-m", "autotuner.cli", "tune", "--picture", str(DOCS / "images" / "demo.png")]
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(command, cwd=folder, check=True, capture_output=True)  # noqa: S603


def _lag(t: FloatArray, model: Fopdt) -> FloatArray:
    return np.where(t < model.D, 0.0, 1.0 - np.exp(-np.maximum(t - model.D, 0.0) / model.T))


def _keep(name: str, svg: str) -> None:

    style = f"<style>svg{{background:#fff;font:13px sans-serif}}{STYLE.replace('color-scheme:light dark;', '')}</style>"
    start, rest_of_it = svg.split(">", 1)
    if "xmlns" not in start:
        start = start.replace("<svg", '<svg xmlns="http://www.w3.org/2000/svg"', 1)
    (DOCS / "images" / name).write_text(f"{start}>{style}{rest_of_it}\n", encoding="utf-8")


def page() -> None:
    """Take the pictures of the page that its tests keep, and name them for the documentation."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pytest", "-q", "-m", "realtime", "tests/page"]
        subprocess.run(command, cwd=DOCS.parent, check=True, env=os.environ | {"AUTOTUNER_SHOTS": folder})  # noqa: S603
        for name in SHOTS:
            shot = Image.open(Path(folder) / f"{name}.png").convert("RGB")
            shot.quantize(COLOURS).save(DOCS / "images" / f"page-{name}.png", optimize=True)


if __name__ == "__main__":
    pictures()
    if "--page" in sys.argv:
        page()
