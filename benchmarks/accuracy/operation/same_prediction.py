"""One prediction in every place, and what the device then does: a tuning of a PLC on libmodbus, in real time.

    python benchmarks/accuracy/operation/same_prediction.py [--peer PLC.py] [--b 1 0.25] [--goal balanced]

A service tunes a loop of the simulated PLC, writes its gains and steps the set point under the PLC's own controller.
Overshoot and settling time are read where a user sees them: in the API's result (which the page's first screen shows),
in the table of goals, off the chart's curve, and in the text of the report. Beside them is the step as the device made
it: overshoot of the mean of `SMOOTHED` samples, settling to within 2 % of the step plus the noise. The PLC's controller
has the set-point weight 1; for another one a copy of it gets that weight, in its one line that makes the output.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import urllib.request
from contextlib import ExitStack
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np

PEER = os.environ.get("AUTOTUNER_PEER")
PLANT = ("2", "12", "2")
"""K, T s and D s of the plant: slow beside the delays of a busy machine; a tuning takes a minute and a half."""
SAMPLE_S = 0.2
NOISE = 0.02
STEP = 8.0
"""Step of the set point, PV units: hundreds of times the noise, so that the device shows its overshoot."""
SETTLED, SMOOTHED = 0.02, 3
LONGEST_CALL_S = 300.0
LOOPS = """
[service]
data_directory = "{folder}/data"
[loops.TIC-101]
driver = "modbus"
sample_time_s = {sample}
relay = {{ amplitude = 10.0 }}
limits = {{ output = [0.0, 100.0], pv = [0.0, 200.0] }}
gains = {{ form = "ideal", scan_s = {sample}, set_point_weight = {b} }}
[loops.TIC-101.device]
host = "127.0.0.1"
port = {port}
[loops.TIC-101.device.registers]
pv = {{ table = "input", address = 0, type = "float32" }}
output = {{ table = "holding", address = 0, type = "float32" }}
set_point = {{ table = "holding", address = 2, type = "float32" }}
auto = {{ table = "coil", address = 0 }}
kp = {{ table = "holding", address = 10, type = "float32" }}
ti = {{ table = "holding", address = 12, type = "float32" }}
td = {{ table = "holding", address = 14, type = "float32" }}
"""
MAP = "pv=ir:0:float32,out=hr:0:float32,sp=hr:2:float32,auto=co:0,kp=hr:10:float32,ti=hr:12:float32,td=hr:14:float32"
CONTROLLER, TAKES_OVER = "u = self.integ + kp * e - ", 'self.integ = self.get("out", a.u0)'


def peer_with(source: Path, b: float, folder: Path) -> Path:
    """Return the PLC, or a copy of it whose controller weighs its set point by `b` and takes over without a bump."""
    if b == 1.0:
        return source
    text, weighted = source.read_text(encoding="utf-8"), f'kp * ({b} * self.get("sp", a.sp) - self.pv)'
    assert text.count(CONTROLLER) == text.count(TAKES_OVER) == 1, "the PLC's controller is no longer in these lines"
    start = f'{TAKES_OVER} - self.get("kp", a.own_pid[0]) * ({b} * self.get("sp", a.sp) - self.pv)'
    copy = folder / "plc.py"
    copy.write_text(text.replace(CONTROLLER, f"u = self.integ + {weighted} - ").replace(TAKES_OVER, start), "utf-8")
    return copy


def started(stack: ExitStack, folder: Path, command: list[str]) -> Any:
    """Start a program until the stack ends, and return its first line."""
    process = subprocess.Popen(  # noqa: S603
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    stack.callback(process.wait)
    stack.callback(process.terminate)
    assert process.stdout is not None
    return json.loads(process.stdout.readline())


def fetched(url: str, body: dict[str, object] | None = None) -> Any:
    request = urllib.request.Request(url, None if body is None else json.dumps(body).encode())  # noqa: S310
    request.add_header("Content-Type", "application/json")
    with urllib.request.urlopen(request, timeout=LONGEST_CALL_S) as answer:  # noqa: S310
        text = answer.read().decode()
    return json.loads(text) if text.startswith(("{", "[")) else text


def tuned(address: str, goal: str) -> dict[str, Any]:
    told: dict[str, Any] = fetched(f"{address}/v1/loops/TIC-101/tunings", {"goal": goal, "check": False})
    while told["state"] != "ended":
        Event().wait(1.0)
        told = fetched(address + told["links"]["self"])
    assert told["tuning"], told["verdict"]
    return told


def shape(t: np.ndarray, pv: np.ndarray, tolerance: float = SETTLED) -> tuple[float, float]:
    """Return overshoot and settling time of the response to a unit step."""
    outside = np.flatnonzero(np.abs(pv - 1.0) > tolerance)
    return max(0.0, float(np.max(pv)) - 1.0), float(t[min(outside[-1] + 1, t.size - 1)]) if outside.size else 0.0


def in_device(verification: dict[str, Any]) -> tuple[float, float]:
    """Return overshoot and settling time as measured; the noise widens the band in which a response has settled."""
    t, pv, _ = np.array(verification["response"]).T
    share = (pv - verification["rest"]["pv"]) / verification["step"]
    mean = np.convolve(share, np.full(SMOOTHED, 1.0 / SMOOTHED), "same")[1:-1]
    noise = 3.0 * verification["rest"]["noise_sigma"] / abs(verification["step"])
    return shape(t[1:-1], mean, SETTLED + noise)


def in_report(html: str, goal: str) -> str:
    """Return overshoot and settling time in the report's row of a goal, as they are printed."""
    rows = [
        re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row, re.DOTALL)
        for row in re.findall(r"<tr>(.*?)</tr>", html, re.DOTALL)
    ]
    cells = [[re.sub(r"<[^>]+>", "", cell).strip() for cell in row] for row in rows]
    found = next(row for row in cells if row and row[0] == goal and any(cell.endswith("%") for cell in row))
    at = next(index for index, cell in enumerate(found) if cell.endswith("%"))
    return f"{found[at]:>7}   settling {found[at + 1]:>8}"


def run(source: Path, b: float, goal: str) -> None:
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True)))
        options = ["--tcp", "0", "--plant", *PLANT, "--noise", str(NOISE), "--scan", str(SAMPLE_S)]
        options += ["--registers", MAP, "--y0", "0", "--u0", "40", "--own-pid", "0.5", "12", "0", "--sp", "80"]
        port = started(stack, folder, [sys.executable, str(peer_with(source, b, folder)), *options])["tcp"]
        (folder / "loops.toml").write_text(LOOPS.format(folder=folder, port=port, b=b, sample=SAMPLE_S), "utf-8")
        serve = [sys.executable, "-m", "autotuner.cli", "serve", "--json", "--config", "loops.toml", "--port", "0"]
        address = started(stack, folder, serve)["listening"]
        told = tuned(address, goal)
        choices = fetched(address + told["links"]["self"] + "/choices")["choices"]
        choice = next(one for one in choices if one["name"] == goal)
        curve, size = choice["responses"], choice["responses"]["set_point_step"]
        chart = shape(np.array(curve["t_s"]), np.array(curve["step_pv"], dtype=float) / size)
        report = in_report(fetched(address + told["links"]["report"]), goal)
        fetched(address + told["links"]["apply"], {"goal": goal})
        verified = fetched(address + told["links"]["verify"], {"step": STEP})
        device = in_device(verified)
        api, table = told["tuning"]["predicted"], choice["predicted"]
        print(f"b = {b:g}, {goal}: {told['verdict']['message']}")
        for place, overshoot, settling in (
            ("API", api["overshoot"], api["settling_time_s"]),
            ("table", table["overshoot"], table["settling_time_s"]),
            ("chart", *chart),
            ("device", *device),
        ):
            print(f"  {place:<8} overshoot {100 * overshoot:5.1f} %   settling {settling:6.2f} s")
        print(f"  report   overshoot {report}")
        print(f"  verification {verified['verdict']['code']}: {verified['verdict']['message']}", flush=True)
        if not verified["passed"]:
            print(json.dumps({name: verified[name] for name in ("rest", "step", "response", "predicted_output")}))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--peer", type=Path, default=PEER)
    parser.add_argument("--b", type=float, nargs="+", default=[1.0, 0.25])
    parser.add_argument("--goal", default="balanced")
    given = parser.parse_args()
    if given.peer is None:
        parser.error("--peer: name the PLC's script, or set AUTOTUNER_PEER")
    for b in given.b:
        run(given.peer, b, given.goal)


if __name__ == "__main__":
    main()
