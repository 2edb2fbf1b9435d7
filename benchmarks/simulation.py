"""How much faster and how much more exact the event-driven relay test is than a fixed-step loop.

Each row is one relay test of ten periods from rest under an ideal relay of height 1. The fixed-step loop is Euler's,
with a deque for the dead time, at a step of 0.01 s. Both are timed in turn, and the best of five rounds counts. Period
and amplitude of the tenth period are compared with the steady limit cycle; what is left of the transient shows too.

    python benchmarks/simulation.py
"""

from __future__ import annotations

import math
import time
from collections import deque
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from autotuner_sim import Fopdt, Plant, SopdtOverdamped, SopdtUnderdamped, find_limit_cycle, run_relay, symmetric_relay

if TYPE_CHECKING:
    from collections.abc import Callable

SWITCHES = 20
STEP_S = 0.01
ROUNDS = 5
PLANTS: tuple[tuple[Plant, tuple[float, float]], ...] = (
    (Fopdt(1.0, 10.0, 2.0), (0.0, 10.0)),
    (SopdtOverdamped(1.0, 10.0, 1.0, 2.0), (10.0, 11.0)),
    (SopdtUnderdamped(1.0, 9.0, 2.4, 1.0), (9.0, 2.4)),
)
"""Plants, with `m` and `n` of `m y'' + n y' + y = u`."""


def euler(m: float, n: float, D: float) -> tuple[float, float]:
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


def event_driven(plant: Plant) -> tuple[float, float]:
    """Return period and amplitude of the last cycle of an exact relay test."""
    run = run_relay(plant, symmetric_relay(), 1e6, max_switches=SWITCHES)
    start, end = run.times_s[-3], run.times_s[-1]
    lowest, highest = run.extremes(start, end)
    return end - start, (highest - lowest) / 2.0


def timed(function: Callable[[], tuple[float, float]]) -> tuple[float, tuple[float, float]]:
    begun = time.perf_counter()
    result = function()
    return time.perf_counter() - begun, result


def main() -> None:
    table = Table(title=f"One relay test of {SWITCHES // 2} periods")
    for heading in (
        "plant",
        "Euler ms",
        "event-driven ms",
        "times faster",
        "period, amplitude error Euler",
        "event-driven",
    ):
        table.add_column(heading, justify="left" if heading == "plant" else "right")
    for plant, (m, n) in PLANTS:
        slow, fast = math.inf, math.inf
        for _ in range(ROUNDS):
            seconds, by_euler = timed(lambda m=m, n=n, D=plant.D: euler(m, n, D))
            slow = min(slow, seconds)
            seconds, by_events = timed(lambda plant=plant: event_driven(plant))
            fast = min(fast, seconds)
        cycle = find_limit_cycle(plant, symmetric_relay())
        exact = (cycle.period_s, cycle.peak)
        errors = [
            " ".join(f"{abs(value / truth - 1.0):.0e}" for value, truth in zip(found, exact, strict=True))
            for found in (by_euler, by_events)
        ]
        table.add_row(plant.structure, f"{slow * 1e3:.3g}", f"{fast * 1e3:.3g}", f"{slow / fast:.3g}", *errors)
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
