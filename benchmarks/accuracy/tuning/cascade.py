"""A cascade tuned by one command, against a sequential tuning by the rules of the literature.

    OMP_NUM_THREADS=1 python benchmarks/accuracy/tuning/cascade.py [--seeds 3] [--first 100]

Plant: `examples/heated-tank.toml`: the flow of steam inside, the temperature of a tank outside, with noise. The command
gets nothing but that file: `autotuner tune FIC-7 --cascade TIC-7`. The rules get the true processes. For the outer loop
the inner one is to them a lag and a dead time as long as its own dead time, which is what the rule of SIMC makes of it
(Skogestad, J. Process Control 13, 2003). No engineer at the plant knows them that well.

Judged on the simulator without noise: integrated absolute error of the outer PV after a load step of 10 % of the valve,
after a load step of 20 kg/h of steam at the tank, and after a set-point step of 2 degC, each over that of the command
at the first seed, and the overshoot of that step. `Ms` is that of the outer loop with the inner one closed, on the true
processes, with the derivative filtered at an eighth of its time. Both loops run the controller of `autotuner_sim`, with
a set-point weight of 1. Less error may have been paid for by overshoot or by robustness: look at the whole row.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from autotuner.core.design import PidGains, apply_rule
from autotuner.core.model.process import Fopdt, SopdtOverdamped
from autotuner_sim import Fopdt as SimFopdt
from autotuner_sim import LoadStep, SteppedPlant
from autotuner_sim import SopdtOverdamped as SimSopdt
from autotuner_sim.cascade import OuterDevice
from autotuner_sim.devices.loop_device import Gains, LoopDevice
from benchmarks.baselines.isa_loop import controller, largest_sensitivity

if TYPE_CHECKING:
    from autotuner.core.model.arrays import FloatArray

ROOT = Path(__file__).parents[3]
PLANT = ROOT / "examples" / "heated-tank.toml"
INNER, OUTER = "FIC-7", "TIC-7"
FLOW, TANK = (4.0, 2.0, 0.4), (0.2, 60.0, 12.0, 5.0)
"""True processes: K, T, D and K, T1, T2, D, s."""
RULES = ("simc_pi", "simc_pid", "amigo_pi", "amigo_pid", "tyreus_luyben_pi", "ziegler_nichols_pid")
STEP_AT_S, DURATION_S, LOOK_S = 10.0, 1200.0, 0.5
SCAN_S = 0.1
GOALS = ("balanced", "brisk")
SET_POINT_STEP = 2.0
CASES = {
    "load at the valve": (10.0, 0.0, 0.0),
    "load at the tank": (0.0, 20.0, 0.0),
    "set point": (0.0, 0.0, SET_POINT_STEP),
}
"""Steps of the inner load, %, of the outer load, kg/h, and of the outer set point, degC."""

Pair = tuple[PidGains, PidGains]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="One command against sequential tuning by rules, on a cascade.")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=100)
    args = parser.parse_args()
    pairs: dict[str, Pair] = {f"{goal}, seed {seed}": tuned(seed, goal) for goal in GOALS for seed in seeds(args)}
    pairs |= {rule: by_rule(rule) for rule in RULES}
    errors = {name: [error(pair, *steps) for steps in CASES.values()] for name, pair in pairs.items()}
    unit = next(iter(errors.values()))
    print(f"{'integrated error':24}" + "".join(f"{column:>20}" for column in (*CASES, "Ms", "overshoot")))
    for name, values in errors.items():
        shares = [f"{value / one:.2f}" for value, one in zip(values, unit, strict=True)]
        figures = [*shares, f"{sensitivity(pairs[name]):.2f}", f"{overshoot(pairs[name]):.0%}"]
        print(f"{name:24}" + "".join(f"{figure:>20}" for figure in figures))
    for name, (inner, outer) in pairs.items():
        print(f"{name:24}inner {inner.words}; outer {outer.words}")


def seeds(args: argparse.Namespace) -> range:
    return range(args.first, args.first + args.seeds)


def tuned(seed: int, goal: str) -> Pair:
    """Return the gains that the command finds on the plant with noise of this seed."""
    text = (
        PLANT.read_text()
        .replace("seed = 1\n", f"seed = {2 * seed}\n")
        .replace("seed = 2\n", f"seed = {2 * seed + 1}\n")
    )
    assert tomllib.loads(text)["loops"][OUTER]["device"]["seed"] == 2 * seed + 1
    with tempfile.TemporaryDirectory() as folder:
        (file := Path(folder) / "plant.toml").write_text(text)
        command = [
            sys.executable,
            "-m",
            "autotuner",
            "tune",
            INNER,
            "--cascade",
            OUTER,
            "--config",
            str(file),
            "--json",
            "--goal",
            goal,
        ]
        done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)  # noqa: S603
    found = json.loads(done.stdout)
    return _gains(found[INNER]), _gains(found[OUTER])


def _gains(tuning: dict[str, Any]) -> PidGains:
    held = tuning["gains"]
    return PidGains(held["Kp"], held["Ti"], held["Td"])


def by_rule(rule: str) -> Pair:
    """Return the gains of a rule for the true processes, the inner loop first."""
    inner_delay = FLOW[2]
    K, T1, T2, D = TANK
    behind = SopdtOverdamped(K, T1, T2 + inner_delay, D + inner_delay)
    return apply_rule(rule, Fopdt(*FLOW)).gains, apply_rule(rule, behind).gains


def error(pair: Pair, inner_load: float, outer_load: float, set_point_step: float) -> float:
    """Return the integrated absolute error of the outer PV, PV units times s."""
    return float(np.sum(np.abs(errors_of(pair, inner_load, outer_load, set_point_step)))) * LOOK_S


def overshoot(pair: Pair) -> float:
    """Return how far the outer PV goes beyond a step of its set point, as a share of the step."""
    return max(0.0, -float(np.min(errors_of(pair, 0.0, 0.0, SET_POINT_STEP)))) / SET_POINT_STEP


def errors_of(pair: Pair, inner_load: float, outer_load: float, set_point_step: float) -> FloatArray:
    """Return the error of the outer PV over time, PV units."""
    inner, outer = pair
    valve = SteppedPlant(SimFopdt(*FLOW), output0=40.0, pv0=200.0, loads=[LoadStep(STEP_AT_S, inner_load)])
    tank = SteppedPlant(SimSopdt(*TANK), output0=200.0, pv0=70.0, loads=[LoadStep(STEP_AT_S, outer_load)])
    flow = LoopDevice(valve, scan_s=SCAN_S, gains=_of(inner), auto=True)
    loop = OuterDevice(flow, tank, scan_s=SCAN_S, limits=(0.0, 500.0), gains=_of(outer), set_point=70.0, auto=True)
    found = []
    for t in np.arange(LOOK_S, DURATION_S, LOOK_S):
        loop.advance(t)
        if t == STEP_AT_S:
            loop.set_point += set_point_step
        found.append(loop.set_point - tank.pv)
    return np.array(found)


def sensitivity(pair: Pair) -> float:
    """Return Ms of the outer loop: the largest |1 / (1 + L)|, L = C2 G2 T1, T1 = C1 G1 / (1 + C1 G1)."""
    s = np.array(1j * np.logspace(-4.0, 1.0, 20_000), dtype=np.complex128)
    inner, outer = (controller(s, gains.Kp, gains.Ti, gains.Td) for gains in pair)
    (K1, T1, D1), (K2, T2, T3, D2) = FLOW, TANK
    inside = inner * K1 * np.exp(-D1 * s) / (1.0 + T1 * s)
    behind = K2 * np.exp(-D2 * s) / ((1.0 + T2 * s) * (1.0 + T3 * s))
    return largest_sensitivity(outer * behind * inside / (1.0 + inside))


def _of(gains: PidGains) -> Gains:
    return Gains(gains.Kp, gains.Ti, gains.Td)


if __name__ == "__main__":
    main()
