"""Sticking valves named by the diagnosis, and by four published tests.

    python benchmarks/accuracy/diagnosis/stiction.py --data DIR [DIR ...] [--loops 20] [--seed 1] [--without-diagnosis]

Two sets of closed loops are judged. The labelled ones are those of `field.py`, from recordings that are not part of
this repository. The others are simulated here, by code of this file alone: a PI loop of a lag with dead time, in one of
five conditions. Of these one has a valve that sticks (the two-parameter model of He et al., 2007):

    sticks          the valve stays until the command is `static` away, then moves up to `kinetic` short of it
    disturbed       a sine on the PV
    tight           gains at 0.97 of the stability limit, with noise that keeps the loop ringing
    quiet           good gains, white noise
    wandering       good gains, a load that is a random walk

For each test the table gives the sticking loops that it names, the others that it names, and the ones it leaves open.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import autotuner
from autotuner.core.diagnosis.record.dataset import dataset_of
from autotuner.core.diagnosis.record.waiting import waiting_of
from autotuner.errors import AutotunerError
from benchmarks.accuracy.diagnosis.field import FRICTION, ITEMS
from benchmarks.baselines.stiction_tests import TESTS, Verdict

if TYPE_CHECKING:
    from collections.abc import Callable

OTHERS = ("disturbed", "tight", "quiet", "wandering")
SAMPLES, FINE = 1000, 10
"""Samples of a loop, and steps of the integration for each."""
NOISE = 0.02
"""Standard deviation of the PV's noise."""


@dataclass(frozen=True)
class Loop:
    """A record of a loop and its label."""

    name: str
    sticks: bool
    recording: autotuner.Recording


def simulated(kind: str, seed: int) -> autotuner.Recording:
    """Return the record of a PI loop in one condition, 1 s."""
    random = np.random.default_rng([seed, *kind.encode()])
    lag, delay, K = random.uniform(4.0, 15.0), int(random.integers(1, 6)), random.uniform(0.5, 3.0)
    ultimate = _ultimate_gain(lag, delay + 1.0) / K
    Kp = ultimate * (0.97 if kind == "tight" else random.uniform(0.15, 0.35))
    Ti = lag if kind != "tight" else 20.0 * lag
    static = random.uniform(0.8, 2.5)
    kinetic = static * random.uniform(0.2, 0.8)
    amplitude, period = random.uniform(0.3, 1.0), random.uniform(6.0, 14.0) * (lag + delay) ** 0.5 * 2.0
    x, integral, position, load, bias = 0.0, 0.0, 0.0, 0.0, random.uniform(-1.0, 1.0)
    waits, u, y = [0.0] * (delay * FINE + 1), [], []
    for k in range(SAMPLES):
        wave = amplitude * math.sin(2.0 * math.pi * k / period) if kind == "disturbed" else 0.0
        pv = x + wave + NOISE * random.standard_normal()
        integral -= Kp / Ti * pv
        command = -Kp * pv + integral
        if kind != "sticks":
            position = command
        elif abs(command - position) > static:
            position = command - math.copysign(kinetic, command - position)
        load += 0.05 * random.standard_normal() if kind == "wandering" else 0.0
        y.append(pv)
        u.append(command)
        for _ in range(FINE):
            waits.append(position + load + bias)
            x += (K * waits.pop(0) - x) / lag / FINE
    return autotuner.Recording(np.arange(float(SAMPLES)), 50.0 + np.array(u), 100.0 + np.array(y))


def _ultimate_gain(lag: float, delay: float) -> float:
    """Return the gain at which a lag of unit gain with dead time oscillates: `w D + atan(w T) = pi`."""
    low, high = 0.0, math.pi / delay
    for _ in range(60):
        w = (low + high) / 2.0
        low, high = (w, high) if w * delay + math.atan(w * lag) < math.pi else (low, w)
    return math.hypot(1.0, low * lag)


def labelled(folders: list[Path]) -> list[Loop]:
    """Return the labelled loops that are in some folders."""
    loops = []
    for item in ITEMS:
        path = next((file for folder in folders if (file := folder / item.file).is_file()), None)
        if path is not None and item.group in ("sticking", "not sticking") and item.name != "dryer":
            loops.append(Loop(item.name, item.group == "sticking", item.read(path)))
    return loops


def generated(count: int, seed: int) -> list[Loop]:
    """Return as many loops that stick as others."""
    sticking = [Loop(f"sticks {k}", sticks=True, recording=simulated("sticks", seed + k)) for k in range(count)]
    kinds = [OTHERS[k % len(OTHERS)] for k in range(count)]
    free = [Loop(f"{kind} {k}", sticks=False, recording=simulated(kind, seed + k)) for k, kind in enumerate(kinds)]
    return sticking + free


def _of_samples(test: Callable[[np.ndarray, np.ndarray], Verdict]) -> Callable[[autotuner.Recording], Verdict]:
    return lambda recording: test(np.array(recording.output), np.array(recording.pv))


def waits(recording: autotuner.Recording) -> Verdict:
    """Judge by the waiting of the PV alone: the evidence that the diagnosis has beside the errors of its models."""
    seen = waiting_of(dataset_of(recording))
    return Verdict.STICKS if seen.sticks else Verdict.FREE if seen.follows else Verdict.OPEN


def diagnosed(recording: autotuner.Recording) -> Verdict:
    """Judge by the effects that the diagnosis names."""
    try:
        found = autotuner.diagnose(recording)
    except AutotunerError:
        return Verdict.OPEN
    return Verdict.STICKS if FRICTION & {effect.name for effect in found.effects} else Verdict.FREE


def show(title: str, loops: list[Loop], *, each: bool, with_diagnosis: bool) -> None:
    judges = {**{name: _of_samples(test) for name, test in TESTS.items()}, "waiting": waits}
    judges |= {"diagnosis": diagnosed} if with_diagnosis else {}
    verdicts = {name: [judge(loop.recording) for loop in loops] for name, judge in judges.items()}
    sticking = sum(loop.sticks for loop in loops)
    print(f"{title}: {sticking} that stick, {len(loops) - sticking} others")
    print(f"  {'':18} {'named of sticking':>18} {'named of others':>16} {'open':>6}")
    for name, given in verdicts.items():
        named = [loop.sticks for loop, verdict in zip(loops, given, strict=True) if verdict is Verdict.STICKS]
        left = sum(verdict is Verdict.OPEN for verdict in given)
        print(f"  {name:18} {sum(named):>18} {len(named) - sum(named):>16} {left:>6}")
    if each:
        for k, loop in enumerate(loops):
            print(
                f"  {loop.name:12} {'+' if loop.sticks else '-'} ",
                ", ".join(f"{n}: {v[k]}" for n, v in verdicts.items()),
            )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--data", type=Path, nargs="*", default=[], help="folders of the labelled recordings")
    parser.add_argument("--loops", type=int, default=20, help="simulated loops of either kind")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--without-diagnosis", action="store_true", help="the published tests alone: seconds")
    parser.add_argument("--each", action="store_true", help="print the verdicts on each loop, too")
    options = parser.parse_args()
    for title, loops in (
        ("labelled loops", labelled(options.data)),
        ("simulated loops", generated(options.loops, options.seed)),
    ):
        if loops:
            show(title, loops, each=options.each, with_diagnosis=not options.without_diagnosis)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
