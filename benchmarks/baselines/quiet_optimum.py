"""The optimal PID controller whose output the PV's noise moves little, by code that shares nothing with the package.

    minimise IAE after a load step over Kp, Ti, Td, Tf, subject to Ms <= 1.4, Mt <= 1.4 and output movement <= limit
    output movement^2 = sigma^2 h/pi integral of |C / (1 + C G)|^2 dw from 0 to pi/h

for white noise `sigma` at the sample time `h`. Simplexes over the logarithms of gain and times with a penalty, from
several starts, some with next to no derivative action; the last one on a fine grid. Sensitivities and errors are those
of `loop_judge`; everything rests on the true frequency response.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import minimize

from benchmarks.baselines.amigo_batch import ultimate
from benchmarks.baselines.loop_judge import FREQUENCIES, controller, iae, is_stable
from benchmarks.baselines.optimum import LIMIT

if TYPE_CHECKING:
    from collections.abc import Callable

Gains = tuple[float, float, float, float]
"""`Kp`, `Ti`, `Td`, `Tf`."""
SCANNED = np.geomspace(2e-3, 2.0, 30)
"""Gains that are scanned, in ultimate gains."""
NOISE_POINTS = 160
GRID = np.sort(np.concatenate((np.geomspace(2e-3, 200.0, 120), np.linspace(0.1, 6.0, 180))))
"""Frequencies of the search, in ultimate ones."""
STRETCHES, FILTERS, DERIVATIVES = (0.8, 1.2, 2.0, 5.0), (0.1, 0.3, 1.0, 3.0), (1.0, 0.05)
"""Starts: the times of the optimum without the limit, stretched; `Tf` and `Td` as shares of its `Td`."""
SIMPLEXES = 4
"""Best starts from which simplexes run."""
EDGES = (0.3, 0.1, 0.03)
"""First edges of the simplexes, in logarithms: from each start, then from the best point."""
PENALTY = 50.0
"""Cost of a controller that does not keep the limits, beyond any logarithm of an error."""


def output_movement(process: Any, gains: Gains, sigma: float, h: float) -> float:
    """Return the standard deviation of the output that noise of the PV causes, output units."""
    w = noise_grid(h, 4 * NOISE_POINTS)
    C = controller(1j * w, *gains)
    through = np.abs(C / (1.0 + C * process(1j * w))) ** 2
    return sigma * math.sqrt(h / math.pi * float(np.trapezoid(through, w)))


def noise_grid(h: float, points: int) -> Any:
    """Return frequencies up to that of Nyquist, rad in units of time."""
    low, high = np.geomspace(1e-5, 0.1, points // 2), np.linspace(0.1, 1.0, points // 2)
    return np.concatenate((low, high[1:])) * math.pi / h


class Quiet:
    """The problem: the process, its ultimate point, and the noise with what it may do to the output."""

    def __init__(self, process: Any, sigma: float, h: float, movement: float) -> None:
        self.process, self.movement = process, movement
        self.Ku, self.Pu = ultimate(process)
        self.scale = sigma * math.sqrt(h / math.pi)
        self.noise_w = noise_grid(h, NOISE_POINTS)
        self.noise_G = process(1j * self.noise_w)
        self.grids = {grid.size: process(2j * math.pi / self.Pu * grid) for grid in (GRID, FREQUENCIES)}

    def gains(self, x: Any) -> Gains:
        """Return the controller of the logarithms of its gain in `Ku` and its three times in `Pu`."""
        Kp, Ti, Td, Tf = np.exp(np.clip(x, math.log(1e-4), math.log(300.0))) * (self.Ku, self.Pu, self.Pu, self.Pu)
        return float(Kp), float(Ti), float(Td), float(Tf)

    def cost(self, x: Any, grid: Any = GRID) -> float:
        """Return the logarithm of the error, or a penalty that grows with the excess over a limit."""
        Kp, *times = found = self.gains(x)
        excess = float(self._excess(np.array([Kp]), times, grid)[0])
        return math.log(iae(self.process, found, self.Pu)) if excess <= 0.0 else PENALTY * (1.0 + min(excess, 100.0))

    def start(self, times: Any) -> Any:
        """Return the start at these times, in `Pu`, with the most promising of the scanned gains."""
        excess = self._excess(SCANNED * self.Ku, [float(time) * self.Pu for time in times], GRID)
        padded = np.concatenate(([math.inf], excess, [math.inf]))
        valleys = (excess <= padded[:-2]) & (excess <= padded[2:]) & np.isfinite(excess)
        kept = np.flatnonzero(valleys | (excess <= 0.0))
        points = [np.log((SCANNED[i], *times)) for i in kept]
        return min(points, key=self.cost, default=np.log((SCANNED[0], *times)))

    def _excess(self, k: Any, times: list[float], grid: Any) -> Any:
        """Return by how much each gain exceeds the limit that it keeps least, as a share; infinite if unstable."""
        C = k[:, None] * controller(2j * math.pi / self.Pu * grid, 1.0, *times)
        L = C * self.grids[grid.size]
        distance = np.abs(1.0 + L)
        robust = np.maximum(1.0 / distance.min(axis=1), (np.abs(L) / distance).max(axis=1)) / LIMIT
        noisy = k[:, None] * controller(1j * self.noise_w, 1.0, *times)
        through = np.abs(noisy / (1.0 + noisy * self.noise_G)) ** 2
        moves = self.scale * np.sqrt(np.trapezoid(through, self.noise_w, axis=1)) / self.movement
        return np.where(is_stable(1.0 + L, self.process.integrators), np.maximum(robust, moves) - 1.0, math.inf)


def quiet_optimum(process: Any, noise: tuple[float, float], movement: float, near: Gains) -> tuple[Gains, float] | None:
    """Return gains and integrated error of the optimal controller inside the limit of output movement.

    Parameters
    ----------
    process : Process
        The true process.
    noise : tuple of float
        Standard deviation, PV units, and sample time of the noise.
    movement : float
        Largest standard deviation of the output, output units.
    near : tuple of float
        The optimal controller without this limit: where the search starts.
    """
    problem = Quiet(process, *noise, movement)
    Ti, Td = (near[1] if near[1] < math.inf else problem.Pu), near[2] or 0.1 * problem.Pu
    starts = [
        problem.start(np.array((s * Ti, s * d * Td, s * f * Td)) / problem.Pu)
        for s, d, f in itertools.product(STRETCHES, DERIVATIVES, FILTERS)
    ]
    best = sorted(starts, key=problem.cost)[:SIMPLEXES]
    x = min((_simplex(problem.cost, start, EDGES[0]) for start in best), key=problem.cost)
    for edge in EDGES[1:]:
        x = _simplex(problem.cost, x, edge)
    x = _simplex(lambda x: problem.cost(x, FREQUENCIES), x, EDGES[-1])
    found = problem.gains(x)
    return None if problem.cost(x, FREQUENCIES) >= PENALTY else (found, float(iae(process, found, problem.Pu)))


def _simplex(cost: Callable[[Any], float], start: Any, edge: float) -> Any:
    corners = np.vstack((start, start - edge * np.eye(start.size)))
    options: Any = {"initial_simplex": corners, "xatol": 1e-3, "fatol": 1e-5, "maxfev": 500}
    return minimize(cost, start, method="Nelder-Mead", options=options).x
