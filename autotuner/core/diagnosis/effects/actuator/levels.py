"""The true position of the actuator at each level of the output: the static curve of an actuator with steps.

    residual ~ sum_l  g d_l G[output is at level l],   orthogonal to all that the process alone may do
    grid       d_l = step round((u_l - origin)/step) + origin - u_l
    alike      |u_l|/(n_l + 1/2) <= step <= |u_l|/(n_l - 1/2),   n_l = |round(u_l/step)|,   u_l from the origin

A grid is scored by the fall of the squares that its shifts `d` bring, `2 g b'd - g^2 d'N d`, so thousands are tried.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.effect import between
from autotuner.core.diagnosis.extended.extended_model import SAME_MISFIT, apart, without_rounding
from autotuner.core.diagnosis.extended.fitting import tangent
from autotuner.core.diagnosis.record.waiting import waiting_of
from autotuner.core.estimation.linear_least_squares import solve_linear
from autotuner.core.model.zoh_input import HeldInput

if TYPE_CHECKING:
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

MOST_LEVELS = 60
"""Most different outputs that are levels of an actuator; a continuous output has more."""
SAME = 1e-3
"""Difference of output levels, in swings, that counts as none."""
SMALLEST, LARGEST, STEPS = 0.01, 0.6, 1500
"""Steps tried, in swings; from the resting output and from zero of the scale, the two grids that devices have."""
KEPT, APART = 3, 0.02


def step_grids(base: Fitted, rows: np.ndarray) -> dict[str, list[tuple[float, float]]]:
    """Return the likeliest (step, swings; origin, steps) of an actuator, by where its steps count from.

    Parameters
    ----------
    base : Fitted
        The process alone.
    rows : array of int
        Samples to use.
    """
    dataset = base.problem.dataset
    steps = np.geomspace(SMALLEST, LARGEST, STEPS)
    steps = steps[steps * dataset.swing <= waiting_of(dataset).largest_step]
    which = np.round(dataset.data.held.levels / (SAME * dataset.swing)).astype(int)
    known, index = np.unique(which, return_inverse=True)
    if not 3 <= known.size <= MOST_LEVELS or not steps.size:
        return {}
    levels = known * SAME  # in swings
    N, b = _normal(base, rows, index, known.size)
    zeros = zeros_of(dataset)
    origins = np.column_stack([origin_of(steps, zero) for zero in zeros.values()])
    s, o = steps[:, None, None], (steps[:, None] * origins)[:, :, None]
    shifts = dataset.swing * (o + s * np.round((levels - o) / s) - levels)
    shifts = shifts - shifts[:, :, [index[0]]]
    fall = 2.0 * shifts @ b - np.einsum("sol,lm,som->so", shifts, N, shifts)
    return {form: _likeliest(fall[:, k], steps, origins[:, k]) for k, form in enumerate(zeros)}


def zeros_of(dataset: Dataset) -> dict[str, float]:
    """Return, for each of what the steps of an actuator count from, one of their levels, swings from the first."""
    return {"from the rest": 0.0, "from zero": -dataset.output0 / dataset.swing}


def origin_of(steps: FloatArray, zero: float) -> FloatArray:
    """Return where steps count from, in steps, if `zero` is one of their levels, in the unit of the steps."""
    origins: FloatArray = (zero / steps + 0.5) % 1.0 - 0.5
    return origins


def steps_alike(dataset: Dataset, form: str, step: float, until_s: float) -> list[tuple[float, float]]:
    """Return steps, in swings, that round every output until a time as a step does, and their origins, in steps."""
    held, zero = dataset.data.held, zeros_of(dataset)[form]
    size = np.abs(held.levels[held.times < until_s] / dataset.swing - zero)
    count = np.round(size / step)
    lowest = float(np.max(size / (count + 0.5)))
    highest = float(np.min(size[count > 0] / (count[count > 0] - 0.5), initial=LARGEST))
    steps = between(lowest, highest)
    return list(zip(steps.tolist(), origin_of(steps, zero).tolist(), strict=True))


def _likeliest(fall: FloatArray, steps: FloatArray, origins: FloatArray) -> list[tuple[float, float]]:
    """Return the grids that explain most, each from the middle of its plateau; of plateaus as high the widest first."""
    plateaus = without_rounding(_plateaus(fall), lambda of: -float(fall[of].max()), lambda of: (of.start - of.stop,))
    middles = [(of.start + of.stop - 1) // 2 for of in plateaus]
    kept = apart(middles, lambda k, other: abs(steps[k] / steps[other] - 1.0), APART, KEPT)
    return [(float(steps[k]), float(origins[k])) for k in kept]


def _plateaus(fall: FloatArray) -> list[slice]:
    """Return the runs of neighbours that explain as much."""
    edges = np.flatnonzero(~np.isclose(fall[1:], fall[:-1], rtol=SAME_MISFIT, atol=0.0)) + 1
    return [slice(start, stop) for start, stop in pairwise([0, *edges.tolist(), fall.size])]


def _normal(base: Fitted, rows: np.ndarray, index: np.ndarray, count: int) -> tuple[FloatArray, FloatArray]:
    """Return the normal matrix of the shifts of all levels, and its right side, process parameters projected out."""
    problem = base.problem
    view = problem.view(base.theta, rows)
    held = problem.dataset.data.held
    on = (index == np.arange(count)[:, None]).astype(float)
    J = float(base.linear[0]) * view.forced(HeldInput(held.times, on - on[:, :1])).T
    q, _ = solve_linear(np.hstack(tangent(replace(problem, rows=rows), base.theta)), problem.dataset.data.pv[rows])
    J = J - q @ (q.T @ J)
    left = problem.dataset.data.pv[rows] - q @ (q.T @ problem.dataset.data.pv[rows])
    return J.T @ J, J.T @ left
