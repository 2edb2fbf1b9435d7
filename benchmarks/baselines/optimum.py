"""The optimal PID controller for every process of the batch, by code that shares nothing with the package.

    minimise IAE after a load step over Kp, Ti, Td, subject to Ms <= 1.4 and Mt <= 1.4

once for the ideal controller (`Tf = 0`) and once with the filter `Tf = Td/10`. Differential evolution over the three
parameters with a penalty (seeded), then simplexes from its best point, the last ones with the limits on a fine grid.
Takes about half an hour; the result is kept in `data/optimum.csv`.

    python benchmarks/baselines/optimum.py [first last]
"""

import csv
import math
import sys
from pathlib import Path

import numpy as np
from scipy.optimize import differential_evolution, minimize

from benchmarks.baselines.amigo_batch import batch, ultimate
from benchmarks.baselines.loop_judge import FREQUENCIES, iae, sensitivities

LIMIT = 1.4
FILTERS = {"ideal": 0.0, "filtered": 0.1}
RESULT = Path(__file__).parent / "data" / "optimum.csv"
BOUNDS = [(math.log(1e-3), math.log(2.0)), (math.log(0.01), math.log(10.0)), (math.log(0.003), math.log(1.5))]
COARSE = np.concatenate((np.geomspace(1e-3, 1e3, 300), np.linspace(0.05, 15.0, 300)))
COARSE.sort()


def problem(process, ratio):
    """Return the cost with a penalty, and the map from the variables to gains."""
    Ku, Pu = ultimate(process)

    def gains(x):
        Kp, Ti, Td = np.exp(x) * (Ku, Pu, Pu)
        return Kp, Ti, Td, ratio * Td

    def violation(x, grid):
        Ms, Mt, stable = sensitivities(process, gains(x), Pu, grid)
        return max(Ms, Mt) / LIMIT - 1.0 if stable else 10.0

    def cost(x, grid=COARSE):
        excess = violation(x, grid)
        if excess > 0.0:
            return 20.0 + 10.0 * min(excess, 100.0)
        return math.log(iae(process, gains(x), Pu))

    return cost, gains, Pu


def optimum(process, ratio, seed=1):
    """Return gains and integrated error of the optimal controller."""
    cost, gains, Pu = problem(process, ratio)
    search = differential_evolution(
        cost, BOUNDS, popsize=14, maxiter=70, tol=1e-6, seed=seed, polish=False, init="sobol"
    )
    best = simplexes(cost, search.x, (0.3, 0.1, 0.03, 0.1, 0.03, 0.01))
    best = simplexes(lambda x: cost(x, FREQUENCIES), best, (0.03, 0.01, 0.003))
    return gains(best), iae(process, gains(best), Pu)


def simplexes(cost, best, sizes):
    """Return the best point of simplexes that are started again and again from the best one so far."""
    value = cost(best)
    for size in sizes:
        for signs in ((1, 1, 1), (-1, 1, -1)):
            corners = np.vstack((best, best + size * np.diag(signs)))
            found = minimize(
                cost, best, method="Nelder-Mead", options={"initial_simplex": corners, "xatol": 1e-6, "fatol": 1e-8}
            )
            if found.fun < value:
                best, value = found.x, found.fun
    return best


def main():
    processes = batch()
    part = len(sys.argv) > 2
    first, last = (int(a) for a in sys.argv[1:3]) if part else (0, len(processes))
    rows = [["process", "controller", "Kp", "Ti", "Td", "Tf", "Ms", "Mt", "IAE"]]
    for process in processes[first:last]:
        for name, ratio in FILTERS.items():
            gains, error = optimum(process, ratio)
            Ms, Mt, _ = sensitivities(process, gains, ultimate(process)[1])
            rows.append([process.name, name, *(f"{v:.8g}" for v in (*gains, Ms, Mt, error))])
            print(*rows[-1], flush=True)
    if not part:
        with RESULT.open("w", newline="") as file:
            csv.writer(file).writerows(rows)


if __name__ == "__main__":
    main()
