"""What random plants take: relay tests by a fixed-step loop, by python-control, one by one and in a batch.

The plants are those of `benchmarks/simulation.py`'s batches: gains of 0.1 to 10, lags of 0.1 to 100 s, dead times of a
hundredth to ten lags, a relay of height 1 at rest, ten periods. The first 30 of each structure are simulated by Euler's
method at a step of 0.01 s, by python-control where it is installed, and in closed form (`quick_relay`); beside each of
them runs the batch of 10,001 (`cycle_batch`, per plant). All take turns, in processor time, and the best of three
rounds counts. The ratio of the means says what a set of plants costs, which the slow ones decide; the median is that of
each plant's own ratio.

    python benchmarks/random_simulation.py
"""

from __future__ import annotations

import importlib.util
import math
import time
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table
from simulation import MANY, PLANTS, batch_of, by_control, euler, in_a_batch, in_closed_form

from autotuner_sim import Fopdt, Plant, SopdtOverdamped, SopdtUnderdamped

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner_sim import RelayTests

SOME, ROUNDS = 30, 3
METHODS = {"Euler": 1, "control": 1, "quick_relay": 500, "cycle_batch": 1}
"""What is timed, and how many times at once: a few microseconds are too short for a clock."""

Row = tuple[float, float, float, float]
"""K, m, n and D of `m y'' + n y' + y = K u(t - D)`."""


def plant_of(structure: str, row: Row) -> Plant:
    """Return a plant by the name of its structure."""
    K, m, n, D = row
    if structure == "fopdt":
        return Fopdt(K, n, D)
    if structure == "sopdt_underdamped":
        return SopdtUnderdamped(K, m, n, D)
    gap = math.sqrt(max(n * n - 4.0 * m, 0.0))
    return SopdtOverdamped(K, (n + gap) / 2.0, (n - gap) / 2.0, D)


def spent_s(function: Callable[[], object], times: int) -> float:
    """Return the processor time of one call, s."""
    begun = time.process_time()
    for _ in range(times):
        function()
    return (time.process_time() - begun) / times


def of_structure(structure: str, tests: RelayTests) -> dict[str, np.ndarray]:
    """Return the best time of each plant by each method, s; of a batch, what each of its plants takes."""
    known = [name for name in METHODS if name != "control" or importlib.util.find_spec("control")]
    spent = {name: np.full(SOME, math.inf) for name in known}
    for k in track(range(SOME), structure):
        row = _, m, n, D = tuple(float(column[k + 1]) for column in (tests.K, tests.m, tests.n, tests.D))
        plant = plant_of(structure, row)
        functions = {
            "Euler": lambda m=m, n=n, D=D: euler(m, n, D),
            "control": lambda m=m, n=n, D=D: by_control(m, n, D),
            "quick_relay": lambda plant=plant: in_closed_form(plant),
            "cycle_batch": lambda: in_a_batch(tests),
        }
        for name in known * ROUNDS:
            spent[name][k] = min(spent[name][k], spent_s(functions[name], METHODS[name]))
    spent["cycle_batch"][:] = spent["cycle_batch"].min() / (MANY + 1)
    return spent


def ratios(peer: np.ndarray | None, seconds: np.ndarray) -> tuple[str, str]:
    """Return the ratio of the means and the median ratio, in words."""
    if peer is None:
        return "not installed", ""
    return f"{peer.mean() / seconds.mean():.3g}", f"{np.median(peer / seconds):.3g}"


def main() -> None:
    """Print the table."""
    table = Table(title=f"{SOME} random plants of each structure, relay tests of 10 periods")
    headings = "structure", "method", "mean us", "Euler/this, means", "median", "control/this, means", "median"
    for heading in headings:
        table.add_column(heading, justify="left" if heading in {"structure", "method"} else "right")
    for structure, (plant, row) in {plant.structure: (plant, row) for _, plant, row in PLANTS}.items():
        spent = of_structure(structure, batch_of(plant, *row))
        for name, seconds in spent.items():
            cells = (cell for peer in ("Euler", "control") for cell in ratios(spent.get(peer), seconds))
            table.add_row(structure, name, f"{1e6 * seconds.mean():.3g}", *cells)
        table.add_section()
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
