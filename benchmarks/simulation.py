"""How much faster and how much more exact the event-driven relay tests are than a fixed-step loop.

Each row is one relay test of ten periods from rest under an ideal relay of height 1: by Euler's method at a step of
0.01 s with a deque for the dead time, by the general event-driven course (`run_relay`), in closed form (`quick_relay`),
and as one of 10,000 random plants of that structure in closed form on arrays (`cycle_batch`), per plant. All are timed
in turn, in processor time, and the best of seven rounds counts. Period and amplitude of the tenth period are compared
with the steady limit cycle; what is left of the transient shows too.

    python benchmarks/simulation.py
"""

from __future__ import annotations

import math
import time
from collections import deque
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.table import Table

from autotuner_sim import (
    Fopdt,
    Plant,
    SopdtOverdamped,
    SopdtUnderdamped,
    cycle_batch,
    find_limit_cycle,
    quick_relay,
    relay_tests,
    run_relay,
    symmetric_relay,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner_sim import RelayTests

SWITCHES = 20
STEP_S = 0.01
ROUNDS = 7
RELAY = symmetric_relay()
PLANTS: tuple[tuple[Plant, tuple[float, float]], ...] = (
    (Fopdt(1.0, 10.0, 2.0), (0.0, 10.0)),
    (SopdtOverdamped(1.0, 10.0, 1.0, 2.0), (10.0, 11.0)),
    (SopdtUnderdamped(1.0, 9.0, 2.4, 1.0), (9.0, 2.4)),
)
"""Plants, with `m` and `n` of `m y'' + n y' + y = u`."""
MANY = 10_000
METHODS = {"Euler": 1, "run_relay": 1, "quick_relay": 100, "cycle_batch": 5}
"""What is timed, and how many times at once: a few microseconds are too short for a clock."""

Found = tuple[float, float]


def euler(m: float, n: float, D: float) -> Found:
    """Return period and amplitude of the last cycle of a fixed-step relay test."""
    pipe = deque([0.0] * round(D / STEP_S))
    y = slope = t = 0.0
    output, switches, turns = 1.0, [], [0.0]
    while len(switches) < SWITCHES:
        if (output > 0.0) == (y > 0.0) and y != 0.0:
            output = -output
            switches.append(t)
            turns.append(0.0)
        if abs(y) > abs(turns[-1]):
            turns[-1] = y
        pipe.append(output)
        u = pipe.popleft()
        if m:
            y, slope = y + STEP_S * slope, slope + STEP_S * (u - y - n * slope) / m
        else:
            y += STEP_S * (u - y) / n
        t += STEP_S
    return switches[-1] - switches[-3], abs(turns[-2] - turns[-3]) / 2.0


def event_driven(plant: Plant) -> Found:
    """Return period and amplitude of the last cycle of an exact relay test."""
    run = run_relay(plant, RELAY, 1e6, max_switches=SWITCHES)
    start, end = run.times_s[-3], run.times_s[-1]
    lowest, highest = run.extremes(start, end)
    return end - start, (highest - lowest) / 2.0


def in_closed_form(plant: Plant) -> Found:
    """Return the same in closed form."""
    run = quick_relay(plant, RELAY, SWITCHES)
    return run.period_s, run.peak


def batch_of(plant: Plant, m: float, n: float) -> RelayTests:
    """Return random plants of the structure, dead times from a hundredth to ten lags, after the row's own."""
    rng = np.random.default_rng(1)
    T, part = 10.0 ** rng.uniform(-1.0, 2.0, MANY), rng.uniform(0.05, 1.0, MANY)
    D = T * 10.0 ** rng.uniform(-2.0, 1.0, MANY)
    of_structure = {
        "fopdt": (0.0 * T, T),
        "sopdt_overdamped": (part * T**2, (1.0 + part) * T),
        "sopdt_underdamped": (T**2, 2.0 * part * T),
    }
    columns = zip(
        (plant.K, m, n, plant.D), (rng.uniform(0.1, 10.0, MANY), *of_structure[plant.structure], D), strict=True
    )
    return relay_tests(*(np.concatenate(([own], random)) for own, random in columns))


def in_a_batch(tests: RelayTests) -> Found:
    """Return period and amplitude of the first plant of a batch."""
    batch = cycle_batch(tests, SWITCHES)
    return float(batch.period_s[0]), float(batch.peak[0])


def timed(functions: dict[str, Callable[[], Found]]) -> dict[str, tuple[float, Found]]:
    """Return the best time of each, s, taken in turn, with its result."""
    best = dict.fromkeys(functions, (math.inf, (math.nan, math.nan)))
    for _ in range(ROUNDS):
        for name, function in functions.items():
            begun = time.process_time()
            for _ in range(METHODS[name]):
                found = function()
            best[name] = min(best[name], ((time.process_time() - begun) / METHODS[name], found))
    return best


def main() -> None:
    """Print the table."""
    table = Table(title=f"One relay test of {SWITCHES // 2} periods")
    for heading in ("plant", "method", "us a plant", "times faster than Euler", "period error", "amplitude error"):
        table.add_column(heading, justify="left" if heading in {"plant", "method"} else "right")
    for plant, (m, n) in PLANTS:
        tests = batch_of(plant, m, n)
        functions = (
            lambda m=m, n=n, D=plant.D: euler(m, n, D),
            lambda plant=plant: event_driven(plant),
            lambda plant=plant: in_closed_form(plant),
            lambda tests=tests: in_a_batch(tests),
        )
        best = timed(dict(zip(METHODS, functions, strict=True)))
        cycle = find_limit_cycle(plant, RELAY)
        for name, (seconds, found) in best.items():
            share = seconds / (MANY + 1 if name == "cycle_batch" else 1)
            errors = (
                abs(value / truth - 1.0) for value, truth in zip(found, (cycle.period_s, cycle.peak), strict=True)
            )
            table.add_row(
                plant.structure,
                name,
                f"{share * 1e6:.3g}",
                f"{best['Euler'][0] / share:.3g}",
                *(f"{e:.0e}" for e in errors),
            )
        table.add_section()
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
