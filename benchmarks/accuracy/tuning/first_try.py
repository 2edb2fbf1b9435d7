"""Every kind of plant of `autotuner plc`, without noise: tuned at the first try, with default settings?

    OMP_NUM_THREADS=1 python benchmarks/accuracy/tuning/first_try.py [--only KIND ...] [--side 3]

For each kind a PLC is started as a user would (`autotuner plc --noise 0 --structure KIND`), and tuned over Modbus in
real time with `examples/plc.toml`, of which only the port is another. The PLC shows its PV in steps of 0.1.

Judged on the simulator, not by the tuning's own words: `Ms` of the true loop with the gains found, from its frequency
response, and the PV after a set-point step of 5 under the controller of `autotuner_sim`: where it is at the end.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from autotuner_sim import SteppedPlant
from autotuner_sim.devices.loop_device import Gains, LoopDevice
from autotuner_sim.plants import PLANTS
from benchmarks.baselines.isa_loop import controller, largest_sensitivity

ROOT = Path(__file__).parents[3]
CONFIG = (ROOT / "examples" / "plc.toml").read_text()
KINDS: dict[str, dict[str, float | tuple[float, ...]]] = {
    "fopdt": {"K": 2.0, "T": 10.0, "D": 1.5},
    "sopdt_overdamped": {"K": 2.0, "T1": 8.0, "T2": 3.0, "D": 1.0},
    "sopdt_underdamped": {"K": 2.0, "m": 3.0, "n": 1.5, "D": 1.0},
    "integrating": {"K": 0.2, "T": 2.0, "D": 1.0},
    "unstable_fopdt": {"K": 2.0, "T": 10.0, "D": 1.0},
    "inverse_response": {"K": 2.0, "T1": 6.0, "T2": 4.0, "Z": 2.0, "D": 1.0},
    "lag_chain": {"K": 2.0, "lags": (3.0, 3.0, 3.0), "D": 0.5},
}
"""Parameters of each kind: periods of a few seconds, so that a tuning takes about a minute."""
STEP, SETTLED_S, SCAN_S = 5.0, 300.0, 0.05
NEAR = 0.05
"""Share of the step within which the PV counts as settled."""
PLANT_AT_REST = (40.0, 80.0)
TIME_LIMIT_S = 900.0


@dataclass(frozen=True)
class Tried:
    """What came of one plant: the verdict's code, how long it took, and the gains."""

    code: str
    seconds: float
    said: str
    gains: dict[str, Any] | None


def main() -> None:
    """Print a row for each kind."""
    parser = argparse.ArgumentParser(description="Every kind of plant without noise, at the first try.")
    parser.add_argument("--only", nargs="+", choices=tuple(KINDS), default=list(KINDS))
    parser.add_argument("--side", type=int, default=3, help="how many plants side by side")
    args = parser.parse_args()
    print(f"{'plant':20}{'verdict':>14}{'time, s':>10}{'Ms':>8}{'settled':>10}  gains")
    with ThreadPoolExecutor(args.side) as pool:
        for kind, tried in zip(args.only, pool.map(try_once, args.only), strict=True):
            print(row(kind, tried), flush=True)


def row(kind: str, tried: Tried) -> str:
    """Return what is printed of one kind."""
    if tried.gains is None:
        return f"{kind:20}{tried.code:>14}{tried.seconds:10.0f}{'-':>8}{'-':>10}  {tried.said}"
    Kp, Ti, Td = (float(tried.gains[name] or 0.0) for name in ("Kp", "Ti", "Td"))
    where = "yes" if settles(kind, Gains(Kp, Ti, Td)) else "no"
    words = f"Kp {Kp:.4g}, Ti {Ti:.4g} s, Td {Td:.4g} s"
    return f"{kind:20}{tried.code:>14}{tried.seconds:10.0f}{sensitivity(kind, Kp, Ti, Td):8.2f}{where:>10}  {words}"


def try_once(kind: str) -> Tried:
    """Start a PLC and tune it."""
    given = [f"{name}={_text(value)}" for name, value in KINDS[kind].items()]
    plc = [
        sys.executable,
        "-m",
        "autotuner",
        "plc",
        "--port",
        "0",
        "--noise",
        "0",
        "--structure",
        kind,
        "--plant",
        *given,
    ]
    with (
        tempfile.TemporaryDirectory() as folder,
        subprocess.Popen(plc, stdout=subprocess.PIPE, text=True, cwd=ROOT) as served,  # noqa: S603
    ):
        try:
            assert served.stdout is not None
            port = json.loads(served.stdout.readline())["port"]
            threading.Thread(target=served.stdout.read, daemon=True).start()
            (config := Path(folder) / "plc.toml").write_text(CONFIG.replace("port = 1502", f"port = {port}"))
            tune = [sys.executable, "-m", "autotuner", "tune", "--config", str(config), "--json"]
            tune += ["--data-directory", folder]
            done = subprocess.run(tune, capture_output=True, text=True, check=False, cwd=ROOT, timeout=TIME_LIMIT_S)  # noqa: S603
        finally:
            served.terminate()
    if not done.stdout:
        return Tried("no result", 0.0, done.stderr.strip(), None)
    found = json.loads(done.stdout)
    verdict = found["verdict"]
    return Tried(verdict["code"], found["samples"] * 0.2, verdict["message"], found["gains"])


def _text(value: float | tuple[float, ...]) -> str:
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)


def settles(kind: str, gains: Gains) -> bool:
    """Return whether the true loop is at a new set point in the end."""
    output0, pv0 = PLANT_AT_REST
    plant = SteppedPlant(PLANTS[kind](**KINDS[kind]), output0=output0, pv0=pv0)
    device = LoopDevice(plant, scan_s=SCAN_S, gains=gains, auto=True)
    device.set_point += STEP
    device.advance(0.9 * SETTLED_S)
    seen = []
    for t in np.arange(0.9 * SETTLED_S, SETTLED_S, 1.0):
        device.advance(t)
        seen.append(plant.pv)
    return bool(np.all(np.abs(np.array(seen) - pv0 - STEP) < NEAR * STEP))


def sensitivity(kind: str, Kp: float, Ti: float, Td: float) -> float:
    """Return Ms of the true loop: the largest |1 / (1 + C G)|."""
    s = np.array(1j * np.logspace(-4.0, 2.0, 4000), dtype=np.complex128)
    plant = PLANTS[kind](**KINDS[kind])
    return largest_sensitivity(controller(s, Kp, Ti, Td) * np.array([plant.transfer(one) for one in s]))


if __name__ == "__main__":
    main()
