"""Take screenshots of the page from real runs: a PLC in real time, three sizes, light and dark.

python docs/take_screenshots.py FOLDER [--peer PLC.py]

The peer is a simulated PLC on libmodbus with a controller of its own; its path may also be in AUTOTUNER_PEER. The
pictures are of what fits the window, as a user sees it without scrolling; `-whole` is the whole page.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import urllib.request
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from make_pictures import browser_module, started

SIZES = ((1440, 900), (1280, 800), (390, 844))
SCHEMES = ("light", "dark")
TREND_S, RELAY_S, STEP_S, SETTLING_S = 25.0, 25.0, 8.0, 60.0
"""Time before a picture is taken, s: of a loop at rest, under the relay, after the step of a verification; and before
another tuning."""
LOOPS = """
[service]
data_directory = "{folder}"
[loops.TIC-101]
driver = "modbus"
sample_time_s = 0.1
pv_unit = "degC"
output_unit = "%"
relay = {{ amplitude = 5.0 }}
limits = {{ output = [0.0, 100.0], pv = [0.0, 200.0] }}
gains = {{ form = "ideal", scan_s = 0.1 }}
[loops.TIC-101.device]
host = "127.0.0.1"
port = {port}
[loops.TIC-101.device.registers]
pv = {{ table = "input", address = 0, type = "int16", scale = 0.1 }}
output = {{ table = "holding", address = 0, type = "int16", scale = 0.1 }}
set_point = {{ table = "holding", address = 1, type = "int16", scale = 0.1 }}
auto = {{ table = "coil", address = 0 }}
kp = {{ table = "holding", address = 10, type = "float32" }}
ti = {{ table = "holding", address = 12, type = "float32" }}
td = {{ table = "holding", address = 14, type = "float32" }}
"""
PLC = (
    "--tcp",
    "0",
    "--plant",
    "2",
    "10",
    "1.5",
    "--noise",
    "0.05",
    "--y0",
    "0",
    "--u0",
    "40",
    "--own-pid",
    "1",
    "20",
    "0",
)
"""What the PLC holds: gain, time constant and dead time of its plant, noise, and its controller's gains before."""
PAUSE = "new Promise((done) => setTimeout(done, 1000 * {}))"
READY = "document.querySelector('[data-state=ready]') && !document.querySelector('[data-start]').disabled"


class Camera:
    """Takes the pictures of one view in every size and scheme.

    Parameters
    ----------
    browser : Browser
        The browser of the tests of the page.
    folder : Path
        Where the pictures go.
    """

    def __init__(self, browser: Any, folder: Path) -> None:
        self.browser, self.folder = browser, folder

    def take(self, name: str, scroll_to: str | None = None) -> None:
        """Take what fits the window, from the top of the page or of an element."""
        for width, height in SIZES:
            for scheme in SCHEMES:
                self.browser.size(width, height, scheme)
                where = f"document.querySelector({json.dumps(scroll_to)}).scrollIntoView()" if scroll_to else ""
                self.browser.run(f"window.scrollTo(0, 0); {where}; 1")
                self.browser.run(PAUSE.format(0.25))
                self.browser.picture(self.folder / f"{name}-{width}-{scheme}.png", whole=False)
        self.browser.size(*SIZES[1])

    def whole(self, name: str) -> None:
        """Take the whole page at the widest and the narrowest size."""
        for width, height in (SIZES[1], SIZES[2]):
            self.browser.size(width, height)
            self.browser.run(PAUSE.format(0.25))
            self.browser.picture(self.folder / f"{name}-whole-{width}.png")
        self.browser.size(*SIZES[1])

    def press(self, text: str) -> None:
        """Press the button that begins with a text."""
        found = (
            f"[...document.querySelectorAll('button')].find((one) => one.textContent.startsWith({json.dumps(text)}))"
        )
        self.browser.wait(f"{found} && !{found}.disabled")
        self.browser.run(f"{found}.click()")

    def confirm(self) -> None:
        """Confirm what a dialog asks."""
        self.browser.click("dialog[open] button.main")


def _fetched(url: str, body: dict[str, object] | None = None) -> Any:
    """Return the JSON answer of the service, or its text where it is none."""
    request = urllib.request.Request(url, None if body is None else json.dumps(body).encode())  # noqa: S310
    request.add_header("Content-Type", "application/json")
    with urllib.request.urlopen(request, timeout=60) as answer:  # noqa: S310 - this machine
        text = answer.read().decode()
    return json.loads(text) if text.startswith(("{", "[")) else text


def _tuned(browser: Any, address: str, **body: object) -> dict[str, Any]:
    """Tune once more over REST, to the end."""
    told: dict[str, Any] = _fetched(f"{address}/v1/loops/TIC-101/tunings", body)
    while told["state"] != "ended":
        browser.run(PAUSE.format(1.0))
        told = _fetched(address + told["links"]["self"])
    return told


def _drop(browser: Any, content: str) -> None:
    """Drop a file on the view of uploads, as a user does."""
    browser.wait("document.querySelector('.drop')")
    browser.run(
        f"""(() => {{
        const data = new DataTransfer();
        data.items.add(new File([{json.dumps(content)}], "historian.csv", {{ type: "text/csv" }}));
        const event = new DragEvent("drop", {{ dataTransfer: data, cancelable: true }});
        document.querySelector(".drop").dispatchEvent(event);
        }})()"""
    )


def _tuning(camera: Camera, address: str) -> None:
    """Show the first screen, a running test, its result, a verification, and the result verified."""
    browser = camera.browser
    browser.size(*SIZES[1])
    browser.open(address)
    browser.wait(READY)
    browser.run(PAUSE.format(TREND_S))
    camera.take("first")
    camera.whole("first")
    browser.click("[data-start]")
    camera.confirm()
    browser.wait("document.querySelector('[data-phase=relay].now')")
    browser.run(PAUSE.format(RELAY_S))
    camera.take("running")
    browser.wait("document.querySelector('[data-verdict]')")
    browser.wait(
        "document.querySelectorAll('canvas').length >= 3 && !document.querySelector('.slot [role=status].muted')"
    )
    camera.take("result")
    camera.whole("result")
    camera.press("Apply")
    camera.confirm()
    browser.wait("document.querySelector('[data-applied]')")
    camera.press("Verify")
    camera.confirm()
    browser.wait("document.querySelector('[data-step=step].now')")
    browser.run(PAUSE.format(STEP_S))
    camera.take("verification", "[data-verification]")
    browser.wait("['true', 'false'].includes(document.querySelector('[data-verification]')?.dataset.verification)")
    camera.take("verified", "[data-verification]")


def _others(camera: Camera, address: str, recording: str) -> None:
    """Show history, comparison, and an upload: its columns, and its result."""
    browser = camera.browser
    browser.open(f"{address}/#/tunings")
    browser.wait("document.querySelectorAll('tbody input').length >= 2")
    camera.take("history")
    browser.run("[...document.querySelectorAll('tbody input')].slice(0, 2).forEach((box) => box.click())")
    camera.press("Compare")
    browser.wait("document.querySelector('[aria-label=\"Both recordings\"] canvas')")
    camera.take("comparison")
    browser.open(f"{address}/#/upload")
    _drop(browser, recording)
    browser.wait("document.querySelector('[aria-label=\"Columns and units\"] canvas')")
    camera.take("upload")
    camera.press("Identify")
    browser.wait("document.querySelector('[aria-label=Model]')")
    camera.take("upload-result", "[data-verdict]")


def main() -> None:
    """Take every picture."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--peer", type=Path, default=os.environ.get("AUTOTUNER_PEER"))
    given = parser.parse_args()
    if given.peer is None:
        parser.error("--peer: name the PLC's script, or set AUTOTUNER_PEER")
    given.folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True)))
        plc = subprocess.Popen([sys.executable, str(given.peer), *PLC], stdout=subprocess.PIPE, text=True)  # noqa: S603
        stack.callback(plc.wait)
        stack.callback(plc.terminate)
        assert plc.stdout is not None  # noqa: S101 - a pipe was asked for
        port = json.loads(plc.stdout.readline())["tcp"]
        (folder / "loops.toml").write_text(LOOPS.format(folder=folder, port=port), encoding="utf-8")
        address = started(stack, folder, "serve", "--json", "--config", "loops.toml", "--port", "0")["listening"]
        module = browser_module()
        browser = module.Browser(module.find(), folder / "profile")
        stack.callback(browser.close)
        camera = Camera(browser, given.folder)
        _tuning(camera, address)
        browser.run(PAUSE.format(SETTLING_S))
        second = _tuned(browser, address, goal="calm", check=False)
        _others(camera, address, _fetched(address + second["links"]["recording"]))
        plc.terminate()
        plc.wait()
        browser.open(address)
        browser.wait("document.querySelector('[data-state=dead]')")
        browser.run(PAUSE.format(STEP_S))
        camera.take("dead")


if __name__ == "__main__":
    main()
