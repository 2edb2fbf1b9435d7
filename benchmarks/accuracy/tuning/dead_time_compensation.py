"""What a dead-time compensator buys over PI and PID controllers of the same robustness.

    python benchmarks/accuracy/tuning/dead_time_compensation.py

    Smith predictor:  T = T0 e^{-Ds},  T0 = C G0/(1 + C G0),  S = 1 - T,   PV after a unit load step = G0 S/s

`C` is PI or PID, `G0` the process without its dead time; times from a grid, the gain the largest with Ms and Mt at most
1.4 on the exact model. The integrated error counts from the first response on, for all controllers. PI and PID are the
product's designs. Processes are `1/(s + 1)` and `1/(s + 1)^2` with a dead time.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import numpy as np

from autotuner.core.design import Controller, PidGains, Requirements, controller_response, design
from autotuner.core.design.nyquist import encircles_nothing, path_ends
from autotuner.core.design.optimisation.loop_grid import LoopGrid, loop_grid
from autotuner.core.model.process import Fopdt, SopdtOverdamped, sum_of_lags

LIMIT = 1.4
DEAD_TIMES = (0.1, 0.3, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0)
TIMES = tuple(product(np.geomspace(0.05, 4.0, 24), (0.0, 0.1, 0.25, 0.5)))
"""`Ti` by the sum of the lags, `Td` by `Ti`."""
GAINS = np.geomspace(1e-2, 1e2, 400)


def smith_error(grid: LoopGrid, shape: PidGains) -> float:
    """Return the smallest integrated error of a Smith predictor with the times of `shape`."""
    C = controller_response(shape, grid.w)
    undelayed, turn = replace(grid.model, D=0.0), np.exp(-1j * grid.w * grid.model.D)  # type: ignore[type-var]
    for Kp in GAINS[::-1]:
        L0 = Kp * C * grid.undelayed
        T0 = L0 / (1.0 + L0)
        S = 1.0 - T0 * turn
        if max(np.abs(S).max(), np.abs(T0).max()) > LIMIT:
            continue
        if encircles_nothing(path_ends(undelayed, replace(shape, Kp=float(Kp))), L0):
            return grid.integral_of(grid.matrix @ (grid.undelayed * S / (1j * grid.w)).real)
    return math.inf


def main() -> None:
    print(f"{'process':24s} PI/PID  Smith/PID  Smith/PI")
    for kind, D in product((lambda D: Fopdt(1.0, 1.0, D), lambda D: SopdtOverdamped(1.0, 1.0, 1.0, D)), DEAD_TIMES):
        model = kind(D)
        PI, PID = (design(model, Requirements(LIMIT, LIMIT, part)).iae for part in (Controller.PI, Controller.PID))
        grid, lags = loop_grid(model), sum_of_lags(model)
        shapes = [PidGains(1.0, a * lags, b * a * lags, b * a * lags / 10.0) for a, b in TIMES]
        smith = min(smith_error(grid, shape) for shape in shapes)
        name = f"{model.structure} D/T {D / lags:g}"
        print(f"{name:24s} {PI / PID:6.2f} {smith / PID:10.2f} {smith / PI:9.2f}", flush=True)


if __name__ == "__main__":
    main()
