"""What a simulated relay test costs: the kernel beside Euler's method, python-control and a C program of the same loop.

Every test is of ten periods from rest under a relay of height 1. The kernel (`autotuner_sim.relay.batch`) is compared
with Euler's method in Python at a step of 0.01 s, with python-control where it is installed, and with `relay_loop.c`
where a C compiler is: Euler's method, the same event-driven loop, and the loop over noisy samples, compiled by
`cc -O2`. All take turns, in processor time, and the best of the rounds counts.

    plants     ten plants one by one; "single" is one plant simulated again and again within one call, "a call" a call
               of `run_relay_tests` for one plant; errors of period and amplitude are those of the tenth period against
               matrix exponentials (SciPy's `expm`) with Brent's method, which share nothing with the kernel
    random     10,000 random plants of each structure in one call; gains 1, lags of 0.1 to 100 s, dead times of a
               hundredth to ten lags; how far period and amplitude are from those of the C program
    noise      the ten plants by samples every 0.01 s with white noise, alone and 1,000 alike in one call; "same" is the
               number of tests whose last switch is at the same sample as in the C program

python-control has neither relay nor dead time. Its fastest way that is correct is taken: `forced_response` of the plant
from one arrival of the relay's output at it to the next possible one, on a grid of 0.01 s, its crossings interpolated.

    python benchmarks/latency/simulation.py [--rounds 5] [plants] [random] [noise]
"""

from __future__ import annotations

import argparse
import ctypes
import importlib.util
import math
import shutil
import subprocess
import tempfile
import time
from collections import deque
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from rich.console import Console
from rich.table import Table

from autotuner_sim import Fopdt, SopdtOverdamped, SopdtUnderdamped
from autotuner_sim.relay.batch import (
    RelayTests,
    coefficients,
    relay_tests,
    run_relay_tests,
    run_sampled_relay_tests,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    Numbers = NDArray[np.float64]

SWITCHES = 20
STEP_S = 0.01
AGAIN, MANY, ALIKE = 2_000, 10_000, 1_000
"""Times that a single test is repeated within a call; random plants in a batch; plants in a batch with noise."""
SIGMA, DEAD_ZONE, MOST_SAMPLES = 0.01, 0.05, 120_000
"""Noise and half the dead zone, of the PV that the relay's height gives in the long run; samples drawn."""
PLANTS: dict[str, Fopdt | SopdtOverdamped | SopdtUnderdamped] = {
    "fopdt T 10, D 2 s": Fopdt(1.0, 10.0, 2.0),
    "fopdt T 10, D 10 s": Fopdt(1.0, 10.0, 10.0),
    "overdamped T1 10, T2 1, D 2 s": SopdtOverdamped(1.0, 10.0, 1.0, 2.0),
    "overdamped T1 10, T2 8, D 8 s": SopdtOverdamped(1.0, 10.0, 8.0, 8.0),
    "overdamped T1 60, T2 15, D 5 s": SopdtOverdamped(1.0, 60.0, 15.0, 5.0),
    "underdamped m 9 s2, n 2.4, D 1 s": SopdtUnderdamped(1.0, 9.0, 2.4, 1.0),
    "underdamped m 100 s2, n 12, D 8 s": SopdtUnderdamped(1.0, 100.0, 12.0, 8.0),
    "underdamped m 400 s2, n 30, D 20 s": SopdtUnderdamped(1.0, 400.0, 30.0, 20.0),
    "underdamped m 100 s2, n 4, D 30 s": SopdtUnderdamped(1.0, 100.0, 4.0, 30.0),
    "underdamped m 9 s2, n 0.6, D 20 s": SopdtUnderdamped(1.0, 9.0, 0.6, 20.0),
}
"""The last two ring while one switch, and while three, are on their way."""

Found = tuple["Numbers", "Numbers"]
"""Periods and amplitudes."""


class CProgram:
    """`relay_loop.c`, compiled into a folder of its own."""

    def __init__(self, compiler: str, folder: str) -> None:
        library = Path(folder) / "relay_loop.so"
        source = Path(__file__).with_name("relay_loop.c")
        subprocess.run([compiler, "-O2", "-shared", "-fPIC", "-o", library, source, "-lm"], check=True)  # noqa: S603
        self._library = ctypes.CDLL(str(library))

    def by_events(self, tests: RelayTests) -> Found:
        """Return periods and amplitudes by events."""
        return self._cycles(self._library.by_events, tests)

    def by_euler(self, tests: RelayTests) -> Found:
        """Return periods and amplitudes by Euler's method."""
        return self._cycles(self._library.by_euler, tests, ctypes.c_double(STEP_S))

    def by_samples(self, tests: RelayTests, noise: Numbers, starts: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the samples of the last switches."""
        rows, last = _rows(tests), np.zeros(tests.K.size, dtype=np.int64)
        sizes = ctypes.c_long(tests.K.size), ctypes.c_long(SWITCHES)
        read = _pointer(noise), ctypes.c_long(noise.size), _pointer(starts), ctypes.c_double(STEP_S)
        self._library.by_samples(_pointer(rows), *sizes, *read, _pointer(last))
        return last

    @staticmethod
    def _cycles(function: Callable[..., object], tests: RelayTests, *options: object) -> Found:
        rows, periods, peaks = _rows(tests), np.zeros(tests.K.size), np.zeros(tests.K.size)
        sizes = ctypes.c_long(tests.K.size), ctypes.c_long(SWITCHES)
        function(_pointer(rows), *sizes, *options, _pointer(periods), _pointer(peaks))
        return periods, peaks


def _rows(tests: RelayTests) -> Numbers:
    return np.stack((tests.m, tests.n, tests.D, tests.hysteresis), axis=1)


def _pointer(array: NDArray[np.float64] | NDArray[np.int64]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def by_kernel(tests: RelayTests) -> Found:
    """Return periods and amplitudes by the kernel."""
    batch = run_relay_tests(tests, SWITCHES)
    return batch.period_s, batch.peak


def by_calls(tests: RelayTests) -> Found:
    """Return periods and amplitudes by the kernel, called again and again."""
    return [by_kernel(tests) for _ in range(AGAIN)][-1]


def by_kernel_with_noise(tests: RelayTests, noise: Numbers, starts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the samples of the last switches by the kernel."""
    batch = run_sampled_relay_tests(tests, noise, STEP_S, starts=starts, switches=SWITCHES)
    last = batch.switches_s[:, -1] / STEP_S
    return np.where(np.isnan(last), -1, np.rint(last)).astype(np.int64)


def by_euler(m: float, n: float, D: float) -> tuple[float, float]:
    """Return period and amplitude of the last cycle of a fixed-step relay test in Python."""
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


def by_control(m: float, n: float, D: float) -> tuple[float, float]:
    """Return the same by python-control, from responses to a constant input no longer than one dead time."""
    import control  # noqa: PLC0415 - where it is installed

    plant = control.ss(control.tf([1.0], [m, n, 1.0] if m else [n, 1.0]))
    x: Any = 0.0
    t, u, output = 0.0, 0.0, 1.0
    arrivals, switches, extremes = deque([(D, 1.0)]), [], []
    while len(switches) < SWITCHES:
        until = arrivals[0][0] if arrivals and arrivals[0][0] < t + D else t + D
        grid = np.linspace(0.0, until - t, max(round((until - t) / STEP_S), 1) + 1)
        found = control.forced_response(plant, grid, np.full(grid.size, u), x)
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


def exact(m: float, n: float, D: float) -> tuple[float, float]:
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


def passages(A: Numbers, x: Numbers, row: int, span_s: float) -> list[float]:
    """Return when a state passes 0 within a span; from rest it does so at once, where it leaves 0."""

    def at(h: float) -> float:
        return float((scipy.linalg.expm(A * h) @ x)[row])

    grid = np.linspace(0.0, span_s, 33)
    values = np.array([at(h) for h in grid])
    if not x[:-1].any():
        return [0.0] if row == 0 and x[-1] else []
    # a passage at the very beginning belongs to the span before
    changes = np.flatnonzero(values[1:] * values[:-1] < 0.0)
    return [scipy.optimize.brentq(at, grid[k], grid[k + 1], xtol=1e-300, rtol=1e-15) for k in changes]


def timed(functions: Mapping[str, Callable[[], Any]], rounds: int) -> dict[str, tuple[float, Any]]:
    """Return the best processor time of each, s, taken in turn, with its result."""
    best: dict[str, tuple[float, Any]] = {}
    for _ in range(max(rounds, 2)):  # the first compiles the kernel where no cache has it
        for name, function in functions.items():
            begun = time.process_time()
            found = function()
            seconds = time.process_time() - begun
            best[name] = min(best.get(name, (math.inf, found)), (seconds, found), key=lambda one: one[0])
    return best


def alike(m: float, n: float, D: float, count: int, hysteresis: float = 0.0) -> RelayTests:
    """Return the test of one plant so many times."""
    return relay_tests(np.ones(count), m, n, D, hysteresis=hysteresis)


def random_plants(structure: str) -> RelayTests:
    """Return random plants of a structure."""
    rng = np.random.default_rng(1)
    T, part = 10.0 ** rng.uniform(-1.0, 2.0, MANY), rng.uniform(0.05, 1.0, MANY)
    m, n = {
        "fopdt": (0.0 * T, T),
        "overdamped": (part * T**2, (1.0 + part) * T),
        "underdamped": (T**2, 2.0 * part * T),
    }[structure]
    return relay_tests(1.0, m, n, T * 10.0 ** rng.uniform(-2.0, 1.0, MANY))


def table_of(title: str, *headings: str) -> Table:
    """Return a table whose first two columns are words."""
    table = Table(title=title)
    for k, heading in enumerate(headings):
        table.add_column(heading, justify="left" if k < 2 else "right")
    return table


def plants_table(rounds: int, program: CProgram | None) -> Table:
    """Return the table of ten plants one by one."""
    table = table_of("One relay test of 10 periods", "plant", "method", "us", "to C", "period error", "amplitude error")
    for text, plant in PLANTS.items():
        m, n = coefficients(plant)
        one, many, truth = alike(m, n, plant.D, 1), alike(m, n, plant.D, AGAIN), exact(m, n, plant.D)
        slow: dict[str, Callable[[], Any]] = {"Euler, Python": partial(by_euler, m, n, plant.D)}
        if importlib.util.find_spec("control") is not None:
            slow["python-control"] = partial(by_control, m, n, plant.D)
        fast: dict[str, tuple[Callable[[], Any], int]] = {"kernel, single": (partial(by_kernel, many), AGAIN)}
        fast["kernel, a call"] = (partial(by_calls, one), AGAIN)
        if program is not None:
            slow["Euler, C"] = partial(program.by_euler, one)
            fast["same loop, C"] = (partial(program.by_events, many), AGAIN)
        best = timed({**slow, **{name: function for name, (function, _) in fast.items()}}, rounds)
        each = {name: seconds / fast.get(name, (None, 1))[1] for name, (seconds, _) in best.items()}
        for name, (_, found) in best.items():
            errors = (abs(float(np.ravel(value)[0]) / true - 1.0) for value, true in zip(found, truth, strict=True))
            to_c = f"{each[name] / each['same loop, C']:.2f}" if program is not None else "no C compiler"
            table.add_row(text, name, f"{each[name] * 1e6:.3g}", to_c, *(f"{error:.0e}" for error in errors))
        table.add_section()
    return table


def random_table(rounds: int, program: CProgram | None) -> Table:
    """Return the table of batches of random plants."""
    table = table_of(f"{MANY} random plants in one call", "structure", "method", "us a plant", "to C", "from C")
    for structure in ("fopdt", "overdamped", "underdamped"):
        tests = random_plants(structure)
        functions: dict[str, Callable[[], Found]] = {"kernel, batch": partial(by_kernel, tests)}
        if program is not None:
            functions["same loop, C"] = partial(program.by_events, tests)
        best = timed(functions, rounds)
        peer = best.get("same loop, C")
        for name, (seconds, found) in best.items():
            words = ("no C compiler", "")
            if peer is not None:
                away = max(
                    float(np.nanmax(np.abs(one / other - 1.0))) for one, other in zip(found, peer[1], strict=True)
                )
                words = f"{seconds / peer[0]:.2f}", f"{away:.0e}"
            table.add_row(structure, name, f"{seconds / MANY * 1e6:.3g}", *words)
        table.add_section()
    return table


def noise_table(rounds: int, program: CProgram | None) -> Table:
    """Return the table of tests by noisy samples."""
    table = table_of("By samples of 0.01 s with noise", "plant", "method", "us a test", "to C", "samples", "same")
    noise = np.random.default_rng(1).normal(0.0, SIGMA, MOST_SAMPLES)
    for text, plant in PLANTS.items():
        for words, count in (("single", 20), ("batch", ALIKE)):
            tests = alike(*coefficients(plant), plant.D, count, DEAD_ZONE)
            starts = np.arange(count) * 7919 % noise.size if words == "batch" else np.zeros(count, dtype=np.int64)
            functions: dict[str, Callable[[], NDArray[np.int64]]] = {
                f"kernel, {words}": partial(by_kernel_with_noise, tests, noise, starts)
            }
            if program is not None:
                functions[f"same loop, C, {words}"] = partial(program.by_samples, tests, noise, starts)
            best = timed(functions, rounds // 2)
            peer = best.get(f"same loop, C, {words}")
            for name, (seconds, found) in best.items():
                ratio = "no C compiler" if peer is None else f"{seconds / peer[0]:.2f}"
                same = "" if peer is None else f"{np.count_nonzero(found == peer[1])}/{count}"
                table.add_row(text, name, f"{seconds / count * 1e6:.3g}", ratio, f"{found.mean():.0f}", same)
        table.add_section()
    return table


TABLES = {"plants": plants_table, "random": random_table, "noise": noise_table}


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("tables", nargs="*", metavar="TABLE", help=f"which of {', '.join(TABLES)}; default all")
    parser.add_argument("--rounds", type=int, default=5, help="rounds of which the best counts")
    args = parser.parse_args()
    compiler = shutil.which("cc") or shutil.which("gcc")
    console = Console(width=140)
    with tempfile.TemporaryDirectory() as folder:
        program = CProgram(compiler, folder) if compiler else None
        if program is None:
            console.print("no C compiler (cc, gcc) is installed: the C program is left out")
        for name in args.tables or TABLES:
            console.print(TABLES[name](args.rounds, program))


if __name__ == "__main__":
    main()
