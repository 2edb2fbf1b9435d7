"""Delay of each move of the output: updates of the actuator at discrete times.

    residual ~ sum_i  -l_i du_i g'(t - t_i - D)          `g` step response;  least squares for the delays l_i
    update grid   l_i = (phase - t_i) mod period  + const:   |sum_i w_i e^{2 pi j (t_i + l_i)/period}| is largest

Because the free model has absorbed the mean delay, only differences count; the grid is found by a search. Where no
grid fits, the updates are at uneven times, as on a busy bus: then every move has its own delay.

    l_i = h (p_i - m + sqrt(3) s),   m = sum w_i p_i,   s^2 = sum w_i (p_i - m)^2,   w_i = du_i^2 / sum du^2

`p_i` is searched, `h` sample interval. No record can separate a mean delay from dead time; the mean is that of a
uniform distribution from 0 with the spread `s`, whose width is the reported period.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.effect import Effect, Place, Searched, View
from autotuner.core.diagnosis.extended.extended_model import apart
from autotuner.core.estimation.linear_least_squares import solve_linear
from autotuner.core.model.arrays import SMALLEST_DIVISOR
from autotuner.core.model.zoh_input import HeldInput, unit_step

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

FEWEST = 4
"""Fewest moves for delays as an explanation of their own: two of them fit any effect with two numbers."""
MOST_MOVES = 120
"""Most moves whose delays are estimated one by one: the cost grows with their square."""
FINENESS, MOST_PERIODS = 10.0, 20_000
"""Periods tried, over the samples of the record, and the most: a wrong one runs out of phase over the record."""
NEAR_PHASES = (0.0, -0.02, 0.02, -0.05, 0.05, -0.1, 0.1)
KEPT, APART = 4, 0.003
"""Periods that are kept, and their least relative distance."""
SEEN = 2.0
"""Sample intervals of the answer to a move that the fitted part has to show, or its lateness is that of the others."""
UNIFORM = math.sqrt(3.0)
"""Half the width of a uniform distribution, in its standard deviations."""
TINY = 1e-12
"""Least variance of the latenesses, in squares of the sample interval: no slope divides by nought."""
ROUNDS = 4
"""Gauss-Newton steps for the delays: the answer of a lag has a corner, which the first step takes for a slope."""
RIDGE = 1e-3
"""Relative regularisation of the moments' normal equations (Levenberg, 1944): moves without an answer stay in place."""


def update_grids(base: Fitted, rows: np.ndarray) -> list[tuple[float, float]]:
    """Return the likeliest (period, s; phase in periods) of an actuator that is updated now and then.

    Parameters
    ----------
    base : Fitted
        The process alone.
    rows : array of int
        Samples to use.
    """
    dataset = base.problem.dataset
    held = dataset.data.held
    moments, steps = held.times[1:], held.steps[1:]
    early = moments < dataset.fitted_until_s
    moments, steps = moments[early], steps[early]
    if not 4 <= moments.size <= MOST_MOVES:
        return []
    return _grids(dataset, moments, *_latenesses(base, moments, steps, rows))


def grids_of_times(timed: Fitted) -> list[tuple[float, float]]:
    """Return the likeliest (period, s; phase in periods) from moves that were fitted with a lateness each."""
    dataset = timed.problem.dataset
    held = dataset.data.held
    p = timed.problem.split(timed.theta)[2][0]
    late = latenesses(p, held.steps[1 : len(p) + 1]) * dataset.data.interval_s
    grids = _grids(dataset, held.times[1 : late.size + 1], late, np.abs(held.steps[1 : late.size + 1]))
    # A move that just missed an update waits for a whole period, or not at all: which, only the record shows.
    return [(period, (phase + by) % 1.0) for period, phase in grids for by in NEAR_PHASES]


def _grids(dataset: Dataset, moments: FloatArray, late: FloatArray, weight: FloatArray) -> list[tuple[float, float]]:
    """Return the periods at which all moves plus their latenesses fall on one phase, the closest first."""
    interval = dataset.data.interval_s
    longest = min(float(np.median(np.diff(moments))) * 1.2, dataset.span_s / 10.0)
    if longest <= 2.0 * interval:
        return []
    count = min(int(FINENESS * dataset.span_s / interval), MOST_PERIODS)
    rates = np.linspace(1.0 / longest, 1.0 / (1.3 * interval), count)
    turns = np.exp(2j * np.pi * np.outer(rates, moments + late)) @ (weight / weight.sum())
    kept = apart(np.argsort(-np.abs(turns)).tolist(), lambda k, other: abs(rates[other] / rates[k] - 1.0), APART, KEPT)
    # The update before a move's own is the one that the least late one did not wait for.
    phases = [float(np.angle(turns[k])) / (2.0 * np.pi) - float(late.min() * rates[k]) for k in kept]
    return [(float(1.0 / rates[k]), phase % 1.0) for k, phase in zip(kept, phases, strict=True)]


def uneven_updates(base: Fitted, rows: np.ndarray, fewest: int = FEWEST) -> Effect | None:
    """Return an actuator that takes over its commands at uneven times; None where the moves are too few or too many.

    Moves of the held-out part have the mean delay of the others.

    Parameters
    ----------
    base : Fitted
        The process alone.
    rows : array of int
        Samples to use.
    fewest : int
        Fewest moves.
    """
    dataset = base.problem.dataset
    held, interval = dataset.data.held, dataset.data.interval_s
    _, delay_s, _ = base.problem.split(base.theta)
    fitted = held.times[1:] < dataset.fitted_until_s - delay_s - SEEN * interval
    count = int(np.count_nonzero(fitted))
    if not fewest <= count <= MOST_MOVES:
        return None
    late, _ = _latenesses(base, held.times[1:][fitted], held.steps[1:][fitted], rows)
    longest = float(np.median(np.diff(held.times[1:][fitted])))
    start = np.clip(late, -longest / 2.0, longest / 2.0) / interval

    steps = held.steps[1 : count + 1]

    def position(held: HeldInput, p: Sequence[float], _: Dataset) -> HeldInput:
        by = np.full(held.times.size - 1, UNIFORM * spread_of(p, steps) * interval)
        by[:count] = latenesses(p, steps) * interval
        times = np.concatenate((held.times[:1], held.times[1:] + by))
        return HeldInput(np.maximum.accumulate(times), held.levels)

    def slopes(view: View, p: Sequence[float]) -> FloatArray:
        moments_s = position(held, p, dataset).times[1 : count + 1]
        with_lateness = view.slopes_with_times(moments_s, interval * steps)
        result: FloatArray = with_lateness @ _slopes_of_latenesses(p, steps)
        return result

    def sizes(p: Sequence[float], _c: Sequence[float], _g: float) -> dict[str, float]:
        return {"period_s": 2.0 * UNIFORM * spread_of(p, steps) * interval}

    return Effect(
        "actuator_hold",
        Place.ACTUATOR,
        tuple(Searched(f"late_{k}", -longest / interval, longest / interval, 5e-4) for k in range(count)),
        [tuple(start.tolist())],
        sizes,
        form="uneven",
        position=position,
        slopes=slopes,
        group="timing",
        unseen_after=True,
        lateness_s=lambda p: spread_of(p, steps) * interval,
    )


def latenesses(p: Sequence[float], steps: FloatArray) -> FloatArray:
    """Return the delay of each move, in sample intervals, from the searched values and the moves' sizes."""
    values = np.array(p)
    late: FloatArray = values - _weights(steps) @ values + UNIFORM * spread_of(p, steps)
    return late


def one_later(theta: FloatArray, k: int, value: float, first: int, steps: FloatArray, unit: float) -> FloatArray:
    """Return `theta` with another lateness of one move, the others arriving as before.

    Parameters
    ----------
    theta : array of float
        What is searched for: the dead time at `first - 1`, then the numbers of the latenesses.
    k, value : int and float
        Which number, and its value.
    first : int
        Place of the first number.
    steps : array of float, shape (M,)
        Sizes of the moves.
    unit : float
        Sample interval in units of the dead time.
    """
    moved = theta.copy()
    moved[first + k] = value
    before, after = (latenesses(list(x[first:]), steps) - x[first:] for x in (theta, moved))
    moved[first - 1] += float(before[0] - after[0]) * unit
    return moved


def spread_of(p: Sequence[float], steps: FloatArray) -> float:
    """Return the standard deviation of the delays, in sample intervals, weighted by the size of the moves."""
    weights, values = _weights(steps), np.array(p)
    return math.sqrt(float(weights @ (values - weights @ values) ** 2) + TINY)


def _weights(steps: FloatArray) -> FloatArray:
    squares: FloatArray = steps**2 / float(steps @ steps)
    return squares


def _slopes_of_latenesses(p: Sequence[float], steps: FloatArray) -> FloatArray:
    """Return the slope of each lateness with each number that is searched for."""
    weights, values = _weights(steps), np.array(p)
    about = (values - weights @ values) / spread_of(p, steps)
    slopes: FloatArray = np.eye(values.size) - weights + UNIFORM * weights * about
    slopes[:, np.argmax(weights)] = 0.0  # the largest move stays: all of them together change nothing
    return slopes


def _latenesses(
    base: Fitted, moments: FloatArray, steps: FloatArray, rows: np.ndarray
) -> tuple[FloatArray, FloatArray]:
    """Return the lateness of each move, s, and its weight."""
    problem = base.problem
    view = problem.view(base.theta, rows)
    when = view.t - view.delay_s
    sizes = float(base.linear[0]) * steps

    def answers(late: FloatArray) -> tuple[FloatArray, FloatArray]:
        since = when[:, None] - (moments + late)
        answer, slope = (values[0] for values in view.motion.forced(unit_step(0.0), np.maximum(since, 0.0)))
        return np.where(since > 0.0, sizes * answer, 0.0), np.where(since > 0.0, -sizes * slope, 0.0)

    late = np.zeros(moments.size)
    longest = float(np.median(np.diff(moments))) / 2.0
    residual = problem.dataset.data.pv[rows] - base.simulated(rows)
    in_time, _ = answers(late)
    # Gain and offset of the free model have taken up some of the delays: they are solved for beside them.
    q, _ = solve_linear(problem.columns(base.theta, rows)[0], residual)
    for _ in range(ROUNDS):
        answer, J = answers(late)
        J = J - q @ (q.T @ J)
        normal = J.T @ J
        normal[np.diag_indices_from(normal)] *= 1.0 + RIDGE
        normal[np.diag_indices_from(normal)] += SMALLEST_DIVISOR
        left = residual - (answer - in_time).sum(axis=1)
        late = np.clip(late + np.linalg.solve(normal, J.T @ left), -longest, longest)
    return late, np.diag(normal) / np.diag(normal).max()
