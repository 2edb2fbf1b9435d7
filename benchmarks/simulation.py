"""How much faster and how much more exact the event-driven relay tests are than a fixed-step loop.

Each row is one relay test of ten periods from rest under an ideal relay of height 1: by Euler's method at a step of
0.01 s with a deque for the dead time, by python-control where it is installed, by the general event-driven course
(`run_relay`), in closed form (`quick_relay`), and as one of 10,000 random plants of that structure in closed form on
arrays (`cycle_batch`), per plant. All are timed in turn, in processor time, and the best of seven rounds counts. There
are several plants of each structure, since Euler's method takes the longer the slower a plant is and the others do not,
and two that ring while switches are on their way: one at a time, and three.

python-control has no relay and no dead time. Its fastest way that is correct is taken: `forced_response` of the plant
from one arrival of the relay's output at it to the next possible one, on a grid of 0.01 s, its crossings interpolated.

Period and amplitude of the tenth period are compared with those of the same test by matrix exponentials (SciPy's
`expm`) and Brent's method, which share nothing with what is tested.

    python benchmarks/simulation.py
"""

from __future__ import annotations

import importlib.util
import math
import time
from collections import deque
from typing import TYPE_CHECKING

import numpy as np
import scipy
from rich.console import Console
from rich.table import Table

from autotuner_sim import (
    Fopdt,
    Plant,
    SopdtOverdamped,
    SopdtUnderdamped,
    cycle_batch,
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
PLANTS: tuple[tuple[str, Plant, tuple[float, float]], ...] = (
    ("T 10, D 2 s", Fopdt(1.0, 10.0, 2.0), (0.0, 10.0)),
    ("T 10, D 10 s", Fopdt(1.0, 10.0, 10.0), (0.0, 10.0)),
    ("T1 10, T2 1, D 2 s", SopdtOverdamped(1.0, 10.0, 1.0, 2.0), (10.0, 11.0)),
    ("T1 10, T2 8, D 8 s", SopdtOverdamped(1.0, 10.0, 8.0, 8.0), (80.0, 18.0)),
    ("T1 60, T2 15, D 5 s", SopdtOverdamped(1.0, 60.0, 15.0, 5.0), (900.0, 75.0)),
    ("m 9 s2, n 2.4, D 1 s", SopdtUnderdamped(1.0, 9.0, 2.4, 1.0), (9.0, 2.4)),
    ("m 100 s2, n 12, D 8 s", SopdtUnderdamped(1.0, 100.0, 12.0, 8.0), (100.0, 12.0)),
    ("m 400 s2, n 30, D 20 s", SopdtUnderdamped(1.0, 400.0, 30.0, 20.0), (400.0, 30.0)),
    ("m 100 s2, n 4, D 30 s", SopdtUnderdamped(1.0, 100.0, 4.0, 30.0), (100.0, 4.0)),
    ("m 9 s2, n 0.6, D 20 s", SopdtUnderdamped(1.0, 9.0, 0.6, 20.0), (9.0, 0.6)),
)
"""Plants, with `m` and `n` of `m y'' + n y' + y = u`."""
MANY = 10_000
METHODS = {"Euler": 1, "control": 1, "run_relay": 1, "quick_relay": 100, "cycle_batch": 5}
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


def by_control(m: float, n: float, D: float) -> Found:
    """Return the same by python-control."""
    import control  # noqa: PLC0415 - where it is installed

    plant = control.ss(control.tf([1.0], [m, n, 1.0] if m else [n, 1.0]))
    return by_spans(D, STEP_S, lambda x, u, grid: control.forced_response(plant, grid, np.full(grid.size, u), x))


def by_spans(D: float, step_s: float, response: Callable[..., object]) -> Found:
    """Return the same from responses to a constant input, each no longer than one dead time."""
    t, x, u, output = 0.0, 0.0, 0.0, 1.0
    arrivals, switches, extremes = deque([(D, 1.0)]), [], []
    while len(switches) < SWITCHES:
        until = arrivals[0][0] if arrivals and arrivals[0][0] < t + D else t + D
        grid = np.linspace(0.0, until - t, max(round((until - t) / step_s), 1) + 1)
        found = response(x, u, grid)
        y, states = np.ravel(found.outputs), np.atleast_2d(found.states)
        above = y > 0.0
        for k in np.flatnonzero(above[1:] != above[:-1])[: SWITCHES - len(switches)]:
            when = t + grid[k] + (grid[k + 1] - grid[k]) * y[k] / (y[k] - y[k + 1])
            output = -output
            switches.append(when)
            arrivals.append((when + D, output))
        extremes.append((t, y.min(), y.max()))
        t, x = until, states[:, -1]
        if arrivals and arrivals[0][0] <= t:
            u = arrivals.popleft()[1]
    last = [(low, high) for when, low, high in extremes if when >= switches[-3]]
    return switches[-1] - switches[-3], (max(high for _, high in last) - min(low for low, _ in last)) / 2.0


def exact(m: float, n: float, D: float) -> Found:
    """Return the same by matrix exponentials of `(y, y', u)` and Brent's method; for `m = 0` of `(y, u)`."""
    A = np.array([[0.0, 1.0, 0.0], [-1.0 / m, -n / m, 1.0 / m], [0.0] * 3] if m else [[-1.0 / n, 1.0 / n], [0.0] * 2])
    t, x, output = 0.0, np.zeros(len(A)), 1.0
    arrivals, switches, turns = deque([(D, 1.0)]), [], []
    while len(switches) < SWITCHES:
        span_s = min(arrivals[0][0] - t, D) if arrivals else D
        for when in passages(A, x, 0, span_s)[: SWITCHES - len(switches)]:
            output = -output
            switches.append(t + when)
            arrivals.append((t + when + D, output))
        if m:
            turns += [(t + when, (scipy.linalg.expm(A * when) @ x)[0]) for when in passages(A, x, 1, span_s)]
        t, x = t + span_s, scipy.linalg.expm(A * span_s) @ x
        if arrivals and arrivals[0][0] - t <= 1e-12 * t:
            x[-1] = arrivals.popleft()[1]
            turns += [] if m else [(t, x[0])]
    last = [y for when, y in turns if switches[-3] < when < switches[-1]]
    return switches[-1] - switches[-3], float(max(last) - min(last)) / 2.0


def passages(A: np.ndarray, x: np.ndarray, row: int, span_s: float) -> list[float]:
    """Return when a state passes 0 within a span; from rest it does so at once, where it leaves 0."""

    def at(h: float) -> float:
        return float((scipy.linalg.expm(A * h) @ x)[row])

    grid = np.linspace(0.0, span_s, 33)
    values = np.array([at(h) for h in grid])
    if not x[:-1].any():
        return [0.0] if row == 0 and x[-1] else []
    # the first interval holds the passage at its beginning that the span before has told already
    changes = np.flatnonzero(values[1:] * values[:-1] < 0.0)
    return [scipy.optimize.brentq(at, grid[k], grid[k + 1], xtol=1e-300, rtol=1e-15) for k in changes]


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
    table = Table(
        title=f"One relay test of {SWITCHES // 2} periods; Euler's method and python-control at a step of {STEP_S} s"
    )
    for heading in ("plant", "method", "us a plant", "Euler/this", "control/this", "period error", "amplitude error"):
        table.add_column(heading, justify="left" if heading in {"plant", "method"} else "right")
    for text, plant, (m, n) in PLANTS:
        tests = batch_of(plant, m, n)
        functions = {
            "Euler": lambda m=m, n=n, D=plant.D: euler(m, n, D),
            "control": lambda m=m, n=n, D=plant.D: by_control(m, n, D),
            "run_relay": lambda plant=plant: event_driven(plant),
            "quick_relay": lambda plant=plant: in_closed_form(plant),
            "cycle_batch": lambda tests=tests: in_a_batch(tests),
        }
        if importlib.util.find_spec("control") is None:
            del functions["control"]
        best, truth = timed(functions), exact(m, n, plant.D)
        for name, (seconds, found) in best.items():
            share = seconds / (MANY + 1 if name == "cycle_batch" else 1)
            errors = (abs(value / true - 1.0) for value, true in zip(found, truth, strict=True))
            table.add_row(
                f"{plant.structure} {text}",
                name,
                f"{share * 1e6:.3g}",
                *(
                    f"{best[other][0] / share:.3g}" if other in best else "not installed"
                    for other in ("Euler", "control")
                ),
                *(f"{e:.0e}" for e in errors),
            )
        table.add_section()
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
