"""A model fitted to readings that only say between which values the PV was.

    pv_k <- min(max(simulated_k, reading_k - half), reading_k + half),   then fit again

(expectation and maximisation for interval data; Dempster, Laird, Rubin, J. R. Stat. Soc. B 39, 1977). What is left is
how far the simulated PV lies outside of what the reading allows.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended import Fitted, fit

if TYPE_CHECKING:
    from autotuner.core.arrays import FloatArray
    from autotuner.core.diagnosis.bench import Bench
    from autotuner.core.diagnosis.sensor import Grid

ROUNDS = 8
STEPS = 6


def fitted_to_intervals(bench: Bench, candidate: Fitted, grid: Grid) -> Fitted:
    """Return the candidate fitted to what the readings allow."""
    case = bench.case
    rows = np.arange(case.data.t.size)
    for _ in range(ROUNDS):
        allowed = case.data.pv + outside_free(candidate.simulated(rows) - case.data.pv, grid)
        moved = replace(case, data=replace(case.data, pv=allowed))
        candidate = fit(replace(candidate.problem, case=moved), candidate.theta, STEPS)
    return candidate


def outside_free(off: FloatArray, grid: Grid) -> FloatArray:
    """Return how far a reading may be moved towards a simulated PV that is `off` from it."""
    result: FloatArray = np.clip(off, -grid.half, grid.half)
    return result


def outside(bench: Bench, candidate: Fitted, grid: Grid, rows: np.ndarray) -> FloatArray:
    """Return how far readings lie outside of what a simulated PV allows, PV."""
    off = bench.case.data.pv[rows] - candidate.simulated(rows)
    result: FloatArray = off - np.clip(off, -grid.half, grid.half)
    return result
