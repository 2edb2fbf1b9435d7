"""Jumps of the reading: every sample is tried, with the process free.

    fall_k = (r' c_k)^2 / (c_k'c_k - |Q'c_k|^2),   c_k = 1 from sample k on,   r = (I - Q Q') pv

with `Q` an orthonormal basis of the process's columns and slopes; cumulative sums from the end of the record yield all
of them.

Where the noise is small, a jump is visible without any process: by the excess of one difference of the PV over
its two neighbours, `o_k = d_k - (d_{k-1} + d_{k+1})/2`. A reversing process contributes half its change of slope.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.extended_model import apart
from autotuner.core.diagnosis.extended.fitting import tangent
from autotuner.core.diagnosis.record.sensor import comes_back
from autotuner.core.estimation.linear_least_squares import solve_linear

if TYPE_CHECKING:
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

KEPT, APART = 4, 5
"""Moments that are kept, and their least distance, samples."""
MOST_ROWS = 2000
"""Most samples in which every moment is tried; longer records are condensed before."""
UNMISTAKABLE = 2.0
"""Ratio of the excess of a jump to the next largest one."""
LEAST_OWN = 1e-6
"""Share of a step that the process cannot produce, below which the step is not the reading's."""


def jump_moments(base: Fitted) -> list[float]:
    """Return the likeliest moments of a jump of the reading, s from the start, the best first."""
    dataset = base.problem.dataset
    rows = np.flatnonzero(dataset.fitted)
    if not 2 * APART < rows.size <= MOST_ROWS:
        return []
    pv = dataset.data.pv[rows]
    columns, slopes = tangent(replace(base.problem, rows=rows), base.theta)
    q, _ = solve_linear(np.hstack((columns, slopes)), pv)
    left = pv - q @ (q.T @ pv)
    after = np.arange(rows.size, 0, -1, dtype=np.float64)
    own = after - np.sum(_from_the_end(q) ** 2, axis=1)
    fall = np.where(own > LEAST_OWN * after, _from_the_end(left) ** 2 / np.maximum(own, LEAST_OWN), 0.0)
    fall[:APART] = 0.0
    found = apart(np.argsort(-fall).tolist(), lambda k, other: abs(k - other), APART, KEPT)
    t = dataset.data.t[rows]
    return [float(t[k] + t[k - 1]) / 2.0 for k in found]


def plain_jump(dataset: Dataset) -> float | None:
    """Return the time of an isolated jump of the reading, s from the start; None without any."""
    rows = np.flatnonzero(dataset.fitted)
    if rows.size < 2 * APART:
        return None
    d = np.diff(dataset.data.pv[rows])
    odd = np.abs(d[1:-1] - (d[:-2] + d[2:]) / 2.0)
    k = int(np.argmax(odd))
    others = np.delete(odd, slice(max(k - 1, 0), k + 2))
    if odd[k] < UNMISTAKABLE * others.max() or comes_back(d)[k + 1]:
        return None
    t = dataset.data.t[rows]
    return float(t[k + 1] + t[k + 2]) / 2.0


def _from_the_end(values: FloatArray) -> FloatArray:
    result: FloatArray = np.cumsum(values[::-1], axis=0)[::-1]
    return result
