"""How much faster a relay test by noisy samples is, event by event, than a fixed-step loop over all of them.

Each row is one relay test of ten periods from rest, its PV read every 0.01 s with white noise, by a relay with a dead
zone: by Euler's method at that step with a deque for the dead time, by the exact state at every sample, event by event
(`noisy_relay`), and as one of 10,000 plants (`noisy_batch`), per plant; the others have up to 40 % more or less of each
time. All have the same noise, drawn beforehand, and are timed in turn, in processor time; the best of seven rounds
counts. "same" tells whether the relay switched at the same samples as by the exact states at all samples.

    python benchmarks/noisy_simulation.py
"""

from __future__ import annotations

import math
import time
from collections import deque
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.table import Table
from simulation import PLANTS, STEP_S, SWITCHES

from autotuner_sim import noisy_batch, noisy_relay, relay_tests, symmetric_relay

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner_sim import Plant, RelayTests

ROUNDS = 7
MANY = 10_000
METHODS = {"Euler": (1, 1), "every sample": (1, 1), "noisy_relay": (20, 1), "noisy_batch": (1, MANY)}
"""What is timed, how many times at once, for a few microseconds are too short for a clock, and of how many tests."""
SIGMA, DEAD_ZONE = 0.01, 0.05
"""Noise and half the dead zone, of the PV that the relay's height gives in the long run."""
MOST_SAMPLES = 120_000

RELAY = symmetric_relay(hysteresis=DEAD_ZONE)
Switches = list[int]


def by_euler(m: float, n: float, D: float, noise: list[float]) -> Switches:
    """Return the switches of a fixed-step test."""
    pipe = deque([0.0] * round(D / STEP_S))
    y = slope = 0.0
    output, switches = 1.0, []
    for k, e in enumerate(noise):
        if output * (y + e) > DEAD_ZONE:
            output = -output
            switches.append(k)
            if len(switches) == SWITCHES:
                break
        pipe.append(output)
        u = pipe.popleft()
        if m:
            y, slope = y + STEP_S * slope, slope + STEP_S * (u - y - n * slope) / m
        else:
            y += STEP_S * (u - y) / n
    return switches


def by_every_sample(plant: Plant, noise: list[float]) -> Switches:
    """Return the switches from the exact state at every sample; the dead time is a whole number of them."""
    motion = plant.motion()
    x, pipe = motion.rest, deque([0.0] * round(plant.D / STEP_S))
    output, switches = 1.0, []
    for k, e in enumerate(noise):
        if output * (motion.output(x) + e) > DEAD_ZONE:
            output = -output
            switches.append(k)
            if len(switches) == SWITCHES:
                break
        pipe.append(output)
        x = motion.move(x, pipe.popleft(), STEP_S)
    return switches


def alike(plant: Plant, m: float, n: float) -> RelayTests:
    """Return tests of plants with about the same times, after that of the plant."""
    more = 1.4 ** np.random.default_rng(2).uniform(-1.0, 1.0, (3, MANY))
    more[:, 0] = 1.0
    return relay_tests(plant.K, m * more[0] ** 2, n * more[0], plant.D * more[1], hysteresis=DEAD_ZONE)


def in_a_batch(tests: RelayTests, noise: np.ndarray) -> Switches:
    """Return the switches of the first plant of a batch, each of which begins elsewhere in the noise."""
    starts = np.arange(tests.K.size) * 7919 % noise.size
    return noisy_batch(tests, noise, STEP_S, starts=starts, switches=SWITCHES).switches[0].tolist()


def timed(functions: dict[str, Callable[[], Switches]]) -> dict[str, tuple[float, Switches]]:
    """Return the best time of each, s, taken in turn, with its switches."""
    best: dict[str, tuple[float, Switches]] = {}
    for _ in range(ROUNDS):
        for name, function in functions.items():
            calls, tests = METHODS[name]
            begun = time.process_time()
            for _ in range(calls):
                found = function()
            seconds = (time.process_time() - begun) / calls / tests
            best[name] = min(best.get(name, (math.inf, found)), (seconds, found))
    return best


def main() -> None:
    """Print the table."""
    table = Table(title=f"One relay test of {SWITCHES // 2} periods by samples of {STEP_S} s with noise of {SIGMA}")
    for heading in ("plant", "method", "us", "Euler/this", "samples", "same"):
        table.add_column(heading, justify="left" if heading in {"plant", "method"} else "right")
    for text, plant, (m, n) in PLANTS:
        noise = np.random.default_rng(1).normal(0.0, SIGMA, MOST_SAMPLES)
        row, tests = noise.tolist(), alike(plant, m, n)
        best = timed(
            {
                "Euler": lambda m=m, n=n, D=plant.D, row=row: by_euler(m, n, D, row),
                "every sample": lambda plant=plant, row=row: by_every_sample(plant, row),
                "noisy_relay": lambda plant=plant, noise=noise: list(
                    noisy_relay(plant, RELAY, noise, STEP_S, SWITCHES).switches
                ),
                "noisy_batch": lambda tests=tests, noise=noise: in_a_batch(tests, noise),
            }
        )
        for name, (seconds, found) in best.items():
            table.add_row(
                f"{plant.structure} {text}",
                name,
                f"{seconds * 1e6:.3g}",
                f"{best['Euler'][0] / seconds:.3g}",
                str(found[-1]),
                "yes" if found == best["every sample"][1] else "no",
            )
        table.add_section()
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
