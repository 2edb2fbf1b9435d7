"""Make the pictures of docs/images.

python docs/make_pictures.py           those that are computed
python docs/make_pictures.py --compare    prints the table of Ziegler and Nichols' rule beside the goals
python docs/make_pictures.py --page FOLDER    those of the page, from what docs/take_screenshots.py has put there
python docs/make_pictures.py --live    the moving picture of a tuning on the page (a simulated PLC, two minutes)
"""

from __future__ import annotations

import importlib.util
import io
import json
import subprocess
import sys
import tempfile
import urllib.request
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from autotuner.core.design import PidGains, PidSettings, Scenario, margins, predict, tune
from autotuner.core.model.process import Fopdt
from autotuner.reports.document import STYLE
from autotuner.reports.pictures.chart import Chart, Curve, Panel
from autotuner.reports.pictures.svg import svg

DOCS = Path(__file__).resolve().parent
HEATER = Fopdt(2.0, 10.0, 1.5)
FILTER_RATIO = 10.0
"""Derivative time over the time constant of the measurement filter, in the comparison with a rule that states none."""
EVERY = 5
"""Samples of a simulation per point of a picture."""
COLOURS = 96
"""Of a picture of the page: it is flat, and a quarter of the bytes does."""
SHOTS = {
    "loops-1280-light": "first-1280-light",
    "form-1280-light": "first-whole-1280",
    "result-1280-light": "result-1280-light",
    "live-390-dark": "running-390-dark",
}
"""Pictures of the page in the documentation, and the screenshots that they are of."""
LIVE = "live.gif"
LIVE_SIZE, LIVE_WIDTH = (1100, 760), 880
"""Size of the window, and width of the moving picture, px."""
SCROLL_BAR = 15
"""Width of the browser's own scroll bar, px, which a picture of the page shows as an empty strip."""
LIVE_EVERY_S, LIVE_FRAME_MS = 6.0, 600
"""Time between two frames in the plant, s, and in the picture, ms."""
LIVE_COLOURS = 40
MADE = {LIVE, "ziegler-nichols.svg", "demo.png", *(f"page-{name}.png" for name in SHOTS)}
"""Every picture of the documentation."""


def pictures() -> None:
    """Write the pictures that are computed."""
    scenario = Scenario(60.0, 0.05, set_point_step=1.0)
    runs = [
        (name, predict(HEATER, PidSettings(gains), scenario), colour)
        for (name, gains), colour in zip(compared(1.0).items(), (1, 5, 0, 2), strict=True)
    ]
    t = np.asarray(runs[0][1].t)[::EVERY]
    panels = [
        Panel("PV", [Curve(name, np.asarray(run.pv)[::EVERY], colour) for name, run, colour in runs], 190.0),
        Panel("output", [Curve(name, np.asarray(run.output)[::EVERY], colour) for name, run, colour in runs], 110.0),
    ]
    drawn = Chart(t, panels, "A step of the set point by 1 under four sets of gains, b = 1")
    _keep("ziegler-nichols.svg", svg(drawn))
    _demo()


def compared(b: float) -> dict[str, PidGains]:
    """Return the rule's gains and those of the goals, all in one controller: the same set-point weight and filter."""
    designs = {"Ziegler-Nichols": tune(HEATER, rule="ziegler_nichols_pid")}
    designs |= {goal: tune(HEATER, goal=goal) for goal in ("calm", "balanced", "brisk")}
    return {name: replace(one.gains, b=b, Tf=one.gains.Td / FILTER_RATIO) for name, one in designs.items()}


COLUMNS = (
    "Kp",
    "Ti, s",
    "Td, s",
    "Ms",
    "gain margin",
    "overshoot",
    "b = 0",
    "highest output",
    "b = 0",
    "IAE of a load",
)


def compare() -> None:
    """Print the rule beside the goals, in the same controller."""
    print("|", " | ".join(("", *COLUMNS)), "|")
    for name, gains in compared(1.0).items():
        edge = margins(HEATER, gains)
        weighted = [PidSettings(replace(gains, b=b)) for b in (1.0, 0.0)]
        steps = [predict(HEATER, one, Scenario(60.0, 0.01, set_point_step=1.0)) for one in weighted]
        load = predict(HEATER, weighted[0], Scenario(60.0, 0.01, load_step=1.0))
        cells = [
            name, f"{gains.Kp:.3f}", f"{gains.Ti:.3f}", f"{gains.Td:.3f}", f"{edge.Ms:.2f}", f"{edge.gain_margin:.2f}",
            *(f"{100.0 * (max(step.pv) - 1.0):.0f} %" for step in steps),
            *(f"{max(step.output):.2f}" for step in steps),
            f"{np.trapezoid(np.abs(load.pv), load.t):.2f}",
        ]  # fmt: skip
        print("|", " | ".join(cells), "|")


def _demo() -> None:
    command = [sys.executable, "-m", "autotuner.cli", "tune", "--picture", str(DOCS / "images" / "demo.png")]
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(command, cwd=folder, check=True, capture_output=True)  # noqa: S603


def _keep(name: str, svg: str) -> None:

    style = f"<style>svg{{background:#fff;font:13px sans-serif}}{STYLE.replace('color-scheme:light dark;', '')}</style>"
    start, rest_of_it = svg.split(">", 1)
    if "xmlns" not in start:
        start = start.replace("<svg", '<svg xmlns="http://www.w3.org/2000/svg"', 1)
    (DOCS / "images" / name).write_text(f"{start}>{style}{rest_of_it}\n", encoding="utf-8")


def page(folder: Path) -> None:
    """Take over the screenshots of a folder that the documentation shows."""
    for name, taken in SHOTS.items():
        shot = Image.open(folder / f"{taken}.png").convert("RGB")
        shot.quantize(COLOURS).save(DOCS / "images" / f"page-{name}.png", optimize=True)


LOOP = """
[service]
data_directory = "FOLDER"
[loops.TIC-101]
driver = "modbus"
sample_time_s = 0.1
pv_unit = "degC"
output_unit = "%"
[loops.TIC-101.limits]
output = [0.0, 100.0]
pv = [0.0, 200.0]
[loops.TIC-101.relay]
amplitude = 5.0
[loops.TIC-101.device]
host = "127.0.0.1"
port = PORT
[loops.TIC-101.device.registers]
pv = { table = "input", address = 0, type = "int16", scale = 0.1 }
output = { table = "holding", address = 0, type = "int16", scale = 0.1 }
"""


def live() -> None:
    """Tune a loop of the simulated PLC on the page, and keep the page as it changes."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True)))
        port = started(stack, folder, "plc", "--port", "0", "--noise", "0.1")["port"]
        text = LOOP.replace("PORT", str(port)).replace("FOLDER", str(folder))
        (folder / "loops.toml").write_text(text, encoding="utf-8")
        words = ("serve", "--json", "--config", "loops.toml", "--port", "0")
        address = started(stack, folder, *words)["listening"]
        browser = browser_module().Browser(browser_module().find(), folder / "profile")
        stack.callback(browser.close)
        _save(_frames(browser, address))


def browser_module() -> Any:
    """Return the module that drives a headless Chromium, from the tests of the page."""
    spec = importlib.util.spec_from_file_location("page_browser", DOCS.parent / "tests" / "page" / "browser.py")
    assert spec is not None and spec.loader is not None  # noqa: S101, PT018 - the file is part of the repository
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def started(stack: ExitStack, folder: Path, *words: str) -> Any:
    """Start a command of the product until the stack ends, and return its first line."""
    command = [sys.executable, "-m", "autotuner.cli", *words]
    process = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)  # noqa: S603
    stack.callback(process.wait, timeout=60)
    stack.callback(process.terminate)
    assert process.stdout is not None  # noqa: S101 - a pipe was asked for
    return json.loads(process.stdout.readline())


def _frames(browser: Any, address: str) -> list[Image.Image]:
    browser.size(*LIVE_SIZE)
    start = urllib.request.Request(f"{address}/v1/loops/TIC-101/tunings", data=b"{}", method="POST")  # noqa: S310
    start.add_header("Content-Type", "application/json")
    with urllib.request.urlopen(start) as answer:  # noqa: S310 - this machine
        where = json.load(answer)["links"]["self"]
    browser.open(f"{address}/#/loops/TIC-101")
    frames, ended = [], False
    while not ended:
        browser.run(f"new Promise((done) => setTimeout(done, {1000 * LIVE_EVERY_S}))")
        with urllib.request.urlopen(address + where) as answer:  # noqa: S310 - this machine
            ended = json.load(answer)["state"] == "ended"
        frames.append(_shot(browser))
    browser.wait("!document.body.innerText.includes('being compared')")
    return [*frames, *[_shot(browser)] * 6]


def _shot(browser: Any) -> Image.Image:
    with tempfile.TemporaryDirectory() as folder:
        browser.picture(Path(folder) / "shot.png")
        shot = Image.open(io.BytesIO((Path(folder) / "shot.png").read_bytes())).convert("RGB")
    shot = shot.crop((0, 0, LIVE_SIZE[0] - SCROLL_BAR, LIVE_SIZE[1]))
    return shot.resize((LIVE_WIDTH, round(LIVE_WIDTH * shot.height / shot.width)), Image.Resampling.LANCZOS)


def _save(frames: list[Image.Image]) -> None:
    both = Image.new("RGB", (frames[0].width, 2 * frames[0].height))
    for row, frame in enumerate((frames[len(frames) // 2], frames[-1])):
        both.paste(frame, (0, row * frame.height))
    palette = both.quantize(LIVE_COLOURS)  # of a running tuning and of a result
    drawn = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    path = DOCS / "images" / LIVE
    drawn[0].save(path, save_all=True, append_images=drawn[1:], duration=LIVE_FRAME_MS, loop=0, optimize=True)


if __name__ == "__main__":
    if "--compare" in sys.argv:
        compare()
        sys.exit()
    if "--live" in sys.argv:
        live()
        sys.exit()
    if "--page" in sys.argv:
        page(Path(sys.argv[sys.argv.index("--page") + 1]))
        sys.exit()
    pictures()
