"""Gains on loops unlike the plants that anything here was developed on: what is wrong, and whether it was said.

    python benchmarks/accuracy/tuning/unlike.py [--cases 300] [--first 0] [--jobs 2]
                                         [--plant "wrong way first"] [--around "drift"]

Each case draws a plant, a time scale, noise and one circumstance (`_unlike_draw`), runs the product's whole tuning in
virtual time, and judges the gains of every goal on the true plant, by a judge that shares nothing with the product:
unstable, Ms above 2.8, or an error after a load step over four times that of the best PID controller of a scan within
the goal's Ms. Where the plant has a gain for each direction the worse one counts. A case is silent when its gains are
bad and nothing was said: no warning but that the check was left out, that another structure fits about as well, or of
the noise's memory. Exit code 1 where one is.
"""

import argparse
import asyncio
import collections
import logging
import math
import sys
import warnings
from dataclasses import dataclass

import async_solipsism
import joblib
import numpy as np
from rich.console import Console
from rich.table import Table

from autotuner.application.analysis.procedure import gains_for
from autotuner.application.computing.compute_pool import InPlace
from autotuner.application.tuning_run import TuningRequest, TuningRun
from autotuner.configuration import LoopTable
from autotuner.core.design import DesignSpec
from autotuner.errors import InputError
from autotuner_sim import Noise, SteppedPlant
from autotuner_sim.devices.loop_device import LoopDevice
from autotuner_sim.plants.rational import RationalPlant
from benchmarks.accuracy.cases._unlike_draw import CIRCUMSTANCES, OUTPUT0, PLANTS, PV0, Around, Scaled, ultimate
from benchmarks.baselines.loop_judge import controller, iae
from benchmarks.safety._device import BenchDevice, Line

GOALS = {"calm": 1.25, "balanced": 1.4, "brisk": 1.7}
WORST_MS, SLOW = 2.8, 4.0
SAID_OF_OTHERS = ("the check was left out", "about as well as", "noise on the PV is not white")
"""Parts of warnings that say nothing against the gains."""
ROWS = ("refused", "gains, nothing said", "gains, with warnings")


@dataclass(frozen=True)
class Case:
    kind: str
    around_name: str
    plant: RationalPlant
    scale: float
    Pu: float
    Ku: float
    dt: float
    h: float
    around: Around

    @property
    def table(self):
        period_s, rises = self.Pu * self.scale, (self.plant.b[0] > 0.0) is not self.around.turned
        relay = {"amplitude": self.h, "response_limit_s": 40.0 * period_s, "time_limit_s": 400.0 * period_s}
        return {
            "driver": "simulated",
            "sample_time_s": self.dt,
            "process_action": "direct" if rises else "reverse",
            "limits": {"output": [0.0, 100.0], **self.around.limits},
            "relay": relay,
            "device": {"plant": {"structure": "fopdt", "K": 2.0, "T": 10.0, "D": 1.5}},
        }


@dataclass(frozen=True)
class Process:
    """A plant for the judge, in its own time."""

    plant: RationalPlant
    gain: float
    D: float

    def undelayed(self, s):
        return self.gain * np.polyval(self.plant.b[::-1], s) / np.polyval(self.plant.a[::-1], s)

    def __call__(self, s):
        return self.undelayed(s) * np.exp(-self.D * s)


def draw(number, kinds, arounds):
    """Return the case of that number; the same for ever."""
    rng = np.random.default_rng([number, 2026])
    kind, around_name = str(rng.choice(kinds)), str(rng.choice(arounds))
    point = None
    while point is None:
        plant = PLANTS[kind](rng)
        point = ultimate(plant)
    (Pu, Ku), h = point, float(rng.choice([3.0, 5.0, 10.0, 15.0]))
    gain = float(10 ** rng.uniform(-1.5, 1.5) * rng.choice([-1.0, 1.0], p=[0.25, 0.75]))
    scale = float(10 ** rng.uniform(-1.7, 4.2)) / Pu
    P, A = Pu * scale, 4.0 / math.pi * h * abs(gain) / Ku
    dt = P / float(10 ** rng.uniform(math.log10(8.0), 2.0))
    around = Around(noise=Noise(A * float(10 ** rng.uniform(-3.0, -1.5)), number))
    CIRCUMSTANCES[around_name](around, h, A, P, dt, rng)
    plant = RationalPlant(tuple(gain * b for b in plant.b), plant.a, plant.D)
    return Case(kind, around_name, plant, scale, Pu, Ku / abs(gain), dt, h, around)


def device_of(case):
    around = case.around
    moving = any(actuator.moves_by_itself for actuator in around.actuators)
    plant = SteppedPlant(
        Scaled(case.plant, case.scale),
        output0=OUTPUT0,
        pv0=PV0,
        output_limits=(0.0, 100.0),
        actuators=around.actuators,
        loads=around.loads,
        offsets=around.offsets,
        sensors=[around.noise, *around.quantisation],
        actuator_scan_s=case.dt / 5.0 if moving else None,
    )
    return BenchDevice(LoopDevice(plant, scan_s=case.dt, set_point=PV0), plant, Line())


@dataclass(frozen=True)
class Sums(InPlace):
    """Analysis at once; the estimates while the test runs, which decide nothing here, are left out."""

    async def run(self, function, /, *args, **kwargs):
        if function.__name__ in {"running_model", "learned_so_far"}:
            return None
        return await super().run(function, *args, **kwargs)


def tuned(case):
    loop = LoopTable.model_validate(case.table)
    tuning = TuningRun("T1", "TIC-101", TuningRequest(loop.experiment_settings()))
    with asyncio.Runner(loop_factory=async_solipsism.EventLoop) as runner:
        runner.run(tuning.conduct(loop, device_of(case), Sums()))
    return tuning


def sensitivity(process, gains, Pu, points=12_000):
    """Return Ms and whether the loop is stable, by the turns of its characteristic function (Mikhailov's criterion)."""
    w = np.sort(np.concatenate((np.geomspace(1e-5, 1e4, points), np.linspace(0.01, 60.0, points))))
    s = 2j * math.pi / Pu * w
    L = controller(s, *gains) * process(s)
    _, _, _, Tf = gains
    chi = s * np.polyval(process.plant.a[::-1], s) * (1.0 + s * Tf + (s * Tf) ** 2 / 2.0) * (1.0 + L)
    turns = np.unwrap(np.angle(chi))
    degree = len(process.plant.a) + (2 if Tf > 0.0 else 0)
    stable = chi[0].real > 0.0 and abs(turns[-1] - np.angle(chi[0].real) - degree * math.pi / 2.0) < math.pi / 2.0
    return float((1.0 / np.abs(1.0 + L)).max()), bool(stable)


def best_error(process, M, case):
    """Return the error of the best of a scan of PID controllers within `M`, NaN where there is none."""
    s = 2j * math.pi / case.Pu * np.geomspace(2e-3, 60.0, 400)
    g, sign, tried = process(s), math.copysign(1.0, process.plant.b[0]), []
    for Ti in np.geomspace(0.05, 30.0, 14) * case.Pu:
        for Td in np.array([0.0, 0.1, 0.25, 0.4]) * min(Ti, case.Pu):
            unit = controller(s, 1.0, Ti, Td, Td / 10.0) * g
            gains = sign * case.Ku * np.geomspace(0.003, 2.0, 40)
            peaks = (1.0 / np.abs(1.0 + gains[:, None] * unit)).max(axis=1)
            tried += [(Ti / abs(Kp), (Kp, Ti, Td, Td / 10.0)) for Kp in gains[peaks <= M]]
    found = []
    for _, gains in sorted(tried)[:1000]:
        if sensitivity(process, gains, case.Pu, 1500)[1]:
            found.append(iae(process, gains, case.Pu))
        if len(found) == 5:
            break
    return min(found, default=math.nan)


def fault(case, found, M):
    """Return what is wrong with gains on the true plant; empty for nothing."""
    g, scale = found.gains, case.scale
    filter_s = g.Tf / scale if g.Tf > 1e-4 * case.Pu * scale else 0.0
    gains = (g.Kp, g.Ti / scale, g.Td / scale, filter_s)
    later = case.plant.D + (case.around.later_s + case.dt / 2.0) / scale
    processes = [Process(case.plant, gain, later) for gain in case.around.gains]
    judged = [sensitivity(process, gains, case.Pu) for process in processes]
    if not all(stable for _, stable in judged):
        return "unstable"
    if max(Ms for Ms, _ in judged) > WORST_MS:
        return "Ms"
    best = best_error(processes[0], M, case)
    return "slow" if min(iae(process, gains, case.Pu) for process in processes) > SLOW * best else ""


def perform(number, kinds, arounds):
    """Return the plant, what was around it, the kind of answer, its code, and the goals whose gains are bad."""
    warnings.simplefilter("ignore")
    logging.disable(logging.CRITICAL)
    case = draw(number, kinds, arounds)
    tuning = tuned(case)
    analysis, said, bad = tuning.analysis, list(tuning.warnings), []
    if not tuning.succeeded or analysis is None or analysis.gains is None:
        return number, case, "refused", tuning.verdict.code, bad
    for goal, M in GOALS.items():
        try:
            found = gains_for(analysis.identification, DesignSpec(goal), analysis.sample_time_s)
        except InputError:
            continue
        said += found.warnings
        wrong = fault(case, found, M)
        bad += [f"{goal} {wrong}"] if wrong else []
    warned = any(not any(part in one for part in SAID_OF_OTHERS) for one in said)
    return number, case, ROWS[2] if warned else ROWS[1], tuning.verdict.code, bad


def report(results):
    """Print the tables."""
    table = Table("answer", "cases", "bad gains", "which")
    for row in ROWS:
        bad = [result[4] for result in results if result[2] == row]
        which = collections.Counter(one for goals in bad for one in goals)
        told = ", ".join(f"{name} {count}" for name, count in which.most_common())
        table.add_row(row, str(len(bad)), str(sum(map(bool, bad))), told)
    Console().print(table)
    for number, case, answer, _, bad in sorted(results, key=lambda result: result[0]):
        if bad:
            print(f"{number}: {case.kind}, {case.around_name}: {answer}: {', '.join(bad)}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=300)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--plant", action="append", choices=list(PLANTS))
    parser.add_argument("--around", action="append", choices=list(CIRCUMSTANCES))
    args = parser.parse_args()
    kinds, arounds = args.plant or list(PLANTS), args.around or list(CIRCUMSTANCES)
    numbers = range(args.first, args.first + args.cases)
    results = joblib.Parallel(args.jobs)(joblib.delayed(perform)(number, kinds, arounds) for number in numbers)
    report(results)
    return 1 if any(result[2] == ROWS[1] and result[4] for result in results) else 0


if __name__ == "__main__":
    sys.exit(main())
