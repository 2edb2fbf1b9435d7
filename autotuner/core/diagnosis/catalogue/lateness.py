"""How late each move of the output reaches the process: what an actuator that is updated now and then shows.

    residual ~ sum_i  -l_i du_i g'(t - t_i - D)          `g` step response;  least squares for the latenesses l_i
    update grid   l_i = (phase - t_i) mod period  + const

Because the free model has taken up the mean lateness, only differences count; the grid is found by trying. Where no
grid fits, the updates come at uneven times, as on a busy bus: then every move has a lateness of its own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effect import Effect, Place, Searched, View
from autotuner.core.identification.held_input import HeldInput, unit_step

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.arrays import FloatArray
    from autotuner.core.diagnosis.case import Case
    from autotuner.core.diagnosis.extended import Fitted

MOST_MOVES = 120
PERIODS, PHASES = 1500, 24
KEPT = 4
RIDGE = 1e-3


def update_grids(base: Fitted, rows: np.ndarray) -> list[tuple[float, float]]:
    """Return the likeliest (period, s; phase in periods) of an actuator that is updated now and then.

    Parameters
    ----------
    base : Fitted
        The process alone.
    rows : array of int
        Samples to look at.
    """
    case = base.problem.case
    held = case.data.held
    moments, steps = held.times[1:], held.steps[1:]
    early = moments < case.fitted_until_s
    moments, steps = moments[early], steps[early]
    if not 4 <= moments.size <= MOST_MOVES:
        return []
    late, weight = _latenesses(base, moments, steps, rows)
    interval = case.data.interval_s
    longest = min(float(np.median(np.diff(moments))) * 1.2, case.span_s / 10.0)
    if longest <= 2.0 * interval:
        return []
    periods = 1.0 / np.linspace(1.0 / longest, 1.0 / (1.3 * interval), PERIODS)
    phases = np.arange(PHASES) / PHASES
    grid = periods[:, None, None] * np.mod(phases[None, :, None] - moments / periods[:, None, None], 1.0)
    off = late - grid
    off = off - (off @ weight)[..., None] / weight.sum()
    score = (off**2) @ weight
    best = np.argsort(score.min(axis=1))
    found: list[tuple[float, float]] = []
    for k in best:
        if all(abs(periods[k] / p - 1.0) > 0.01 for p, _ in found):
            found.append((float(periods[k]), float(phases[int(np.argmin(score[k]))])))
        if len(found) == KEPT:
            break
    return found


def uneven_updates(base: Fitted, rows: np.ndarray) -> Effect | None:
    """Return an actuator that takes over its commands at uneven times; None where the moves are too few or too many.

    Moves of the part that is not fitted come as late as the others do on average.

    Parameters
    ----------
    base : Fitted
        The process alone.
    rows : array of int
        Samples to look at.
    """
    case = base.problem.case
    held, interval = case.data.held, case.data.interval_s
    fitted = held.times[1:] < case.fitted_until_s
    count = int(np.count_nonzero(fitted))
    if not 4 <= count <= MOST_MOVES:
        return None
    late, _ = _latenesses(base, held.times[1:][fitted], held.steps[1:][fitted], rows)
    longest = float(np.median(np.diff(held.times[1:][fitted])))
    start = np.clip(late, -longest / 2.0, longest / 2.0) / interval

    def position(held: HeldInput, p: Sequence[float], _: Case) -> HeldInput:
        by = np.full(held.times.size - 1, float(np.mean(p)) * interval)
        by[:count] = np.array(p) * interval
        times = np.concatenate((held.times[:1], held.times[1:] + by))
        return HeldInput(np.maximum.accumulate(times), held.levels)

    def slopes(view: View, p: Sequence[float]) -> FloatArray:
        moments = position(held, p, case).times[1 : count + 1]
        since = (view.t - view.delay_s)[:, None] - moments
        answer = view.motion.forced(unit_step(0.0), np.maximum(since, 0.0))[1][0]
        result: FloatArray = np.where(since > 0.0, -interval * held.steps[1 : count + 1] * answer, 0.0)
        return result

    def sizes(p: Sequence[float], _c: Sequence[float], _g: float) -> dict[str, float]:
        return {"period_s": float(np.ptp(p)) * interval}

    return Effect(
        "actuator_hold",
        Place.ACTUATOR,
        tuple(Searched(f"late_{k}", -longest / interval, longest / interval, 5e-4) for k in range(count)),
        [tuple(start.tolist())],
        sizes,
        form="uneven",
        position=position,
        slopes=slopes,
        order=0,
        group="timing",
        unseen_after=True,
    )


def _latenesses(
    base: Fitted, moments: FloatArray, steps: FloatArray, rows: np.ndarray
) -> tuple[FloatArray, FloatArray]:
    """Return the lateness of each move, s, and its weight."""
    problem = base.problem
    view = problem.view(base.theta, rows)
    when = view.t - view.delay_s
    gain = float(base.linear[0])
    columns = []
    for moment, step in zip(moments.tolist(), steps.tolist(), strict=True):
        one = HeldInput(np.array([0.0, moment]), np.array([0.0, step]))
        columns.append(np.where(when > moment, -gain * view.motion.forced(one, when)[1][0], 0.0))
    J = np.column_stack(columns)
    residual = problem.case.data.pv[rows] - base.simulated(rows)
    normal = J.T @ J
    normal[np.diag_indices_from(normal)] *= 1.0 + RIDGE
    normal[np.diag_indices_from(normal)] += 1e-300
    return np.linalg.solve(normal, J.T @ residual), np.diag(normal) / np.diag(normal).max()
