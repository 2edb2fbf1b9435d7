"""What an actuator does to a command that moves at every sample: by the answer of the process to its position.

    updates   v(t) = u(P (floor(t/P - phi) + phi))
    steps     v = o + s round((u - o)/s)
    y = sum_j h_{i-j} v_j,   fall = (r'y)^2 / |(I - Q Q') y|^2

`h` answer of the process alone to a pulse of one sample, `r = (I - Q Q') pv`, `Q` an orthonormal basis of its
background and slopes. A controller moves the output at every sample, so that no move and no level has an answer of its
own; the whole position has one, and thousands are tried.

The process alone has taken up half of an update period as dead time, which is added again. A period is known the better
the longer the record: over `W` samples, one that is off by `1/(4 W)` updates a sample loses a quarter of its phase. So
all periods are tried on the part of the record with most motion, and the best of them, ever finer, on all of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy

from autotuner.core.diagnosis.effects.actuator.levels import origin_of, zeros_of
from autotuner.core.diagnosis.extended.extended_model import apart
from autotuner.core.diagnosis.extended.fitting import tangent
from autotuner.core.diagnosis.record.waiting import waiting_of
from autotuner.core.estimation.linear_least_squares import solve_linear
from autotuner.core.model.arrays import SMALLEST_DIVISOR
from autotuner.core.model.zoh_input import HeldInput

if TYPE_CHECKING:
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray, IntArray

FIRST_PART = 240
"""Samples on which all periods are tried."""
SHORTEST, LONGEST = 2.5, 40.0
"""Periods that are tried, in samples."""
PHASES, PARTS = 8, 4
"""Phases of a period that are tried, and parts of a sample in which the position is written."""
CARRIED, KEPT = 40, 6
"""Periods that are tried on the whole record, and how many are returned."""
NEAR = np.arange(-6, 7) / 12.0
"""Around a period, in steps of the first part, and around a phase, in periods."""
EVEN = 0.01
"""Deviation of a sampling interval, over it, up to which samples are even."""
MOST_SAMPLES = 1500
"""Most samples of a record that is searched: the answers are a matrix of the square of that."""
APART = 0.004
"""Least relative distance of two periods, or steps."""
LEAST_STEP, MOST_STEP, STEPS, KEPT_STEPS = 0.03, 0.6, 500, 3
"""Steps that are tried, in swings, and how many are returned."""


def update_grids_in_loop(base: Fitted) -> list[tuple[float, float]]:
    """Return the likeliest (period, s; phase in periods) of an actuator that is updated now and then, the best first.

    Parameters
    ----------
    base : Fitted
        The process alone.
    """
    loop = _Loop.of(base)
    if loop is None:
        return []
    rates = np.arange(1.0 / LONGEST, 1.0 / SHORTEST, 0.25 / FIRST_PART)
    first = _Part(loop, _liveliest(base.problem.dataset, loop.rows))
    periods, phases = (grid.ravel() for grid in np.meshgrid(1.0 / rates, np.arange(PHASES) / PHASES))
    # A phase counts from the middle of the part: a period that is off by little leaves it as it is.
    moments = float(np.mean(first.rows)) + phases * periods
    best = _best(first.fall(loop.updated(periods, moments)), periods, CARRIED)
    around = [(k, by, later) for k in best for by in NEAR for later in NEAR[3:-3:2]]
    finer = np.array([1.0 / (1.0 / periods[k] + by * 0.5 / FIRST_PART) for k, by, _ in around])
    moments = np.array([moments[k] + later * finer[i] for i, (k, _, later) in enumerate(around)])
    best = _best(_Part(loop, loop.rows).fall(loop.updated(finer, moments)), finer, KEPT)
    interval = base.problem.dataset.data.interval_s
    return [(float(finer[k]) * interval, float(moments[k] / finer[k] % 1.0)) for k in best]


def step_grids_in_loop(base: Fitted) -> dict[str, list[tuple[float, float]]]:
    """Return the likeliest (step, swings; origin, steps) of an actuator, by where its steps count from.

    Parameters
    ----------
    base : Fitted
        The process alone.
    """
    loop, dataset = _Loop.of(base), base.problem.dataset
    most = min(MOST_STEP, waiting_of(dataset).largest_step / dataset.swing)
    if loop is None or most <= LEAST_STEP:
        return {}
    steps, part = np.geomspace(LEAST_STEP, most, STEPS), _Part(loop, loop.rows)
    found = {}
    for form, zero in zeros_of(dataset).items():
        origins = origin_of(steps, zero)
        best = _best(part.fall(loop.stepped(steps * dataset.swing, origins)), steps, KEPT_STEPS)
        found[form] = [(float(steps[k]), float(origins[k])) for k in best]
    return found


def _liveliest(dataset: Dataset, rows: IntArray) -> IntArray:
    """Return the part of the samples over which the PV moves most."""
    moved = np.cumsum(np.abs(np.diff(dataset.data.pv[rows], prepend=dataset.data.pv[rows[0]])))
    begins = int(np.argmax(moved[FIRST_PART - 1 :] - moved[: moved.size - FIRST_PART + 1]))
    part: IntArray = rows[begins : begins + FIRST_PART]
    return part


def _best(falls: FloatArray, values: FloatArray, most: int) -> list[int]:
    """Return where the squares fall most, at values that lie apart."""
    order = np.argsort(-falls, kind="stable").tolist()
    return apart(order, lambda k, other: abs(values[k] / values[other] - 1.0), APART, most)


@dataclass(frozen=True, slots=True, eq=False)
class _Loop:
    """A process alone on a loop's record.

    Attributes
    ----------
    base : Fitted
        The process alone.
    rows : array of int
        Samples of the fitted part.
    output : array of float, shape (N,)
        Output at every sample up to the last of them.
    answers : array of float, shape (N, N)
        Answer, by column, to a pulse at each sample.
    """

    base: Fitted
    rows: IntArray
    output: FloatArray
    answers: FloatArray

    @classmethod
    def of(cls, base: Fitted) -> _Loop | None:
        """Return it; None for a record that is short, very long or unevenly sampled, or no loop's."""
        dataset = base.problem.dataset
        t, interval, held = dataset.data.t, dataset.data.interval_s, dataset.data.held
        rows = np.flatnonzero(dataset.fitted)
        is_even = np.ptp(np.diff(t)) <= EVEN * interval
        if not dataset.in_loop or not is_even or not FIRST_PART < rows.size <= rows[-1] + 1 <= MOST_SAMPLES:
            return None
        count = int(rows[-1]) + 1
        pulse = HeldInput(np.array([0.0, interval]), np.array([1.0, 0.0]))
        answer = base.problem.view(base.theta, np.arange(count)).forced(pulse)
        output = held.at(t[:count])
        return cls(base, rows, output, scipy.linalg.toeplitz(answer, np.zeros(count)))

    def updated(self, periods: FloatArray, moments: FloatArray) -> FloatArray:
        """Return positions that are updated at some periods, samples, one of the updates at a moment each."""
        _, delay_s, _ = self.base.problem.split(self.base.theta)
        delay = delay_s / self.base.problem.dataset.data.interval_s
        P, at = periods[:, None], moments[:, None]
        position = np.zeros((periods.size, self.output.size))
        for k in range(PARTS):
            when = np.arange(self.output.size) + (k + 0.5) / PARTS + np.minimum(P / 2.0, delay)
            updates = at + P * np.floor((when - at) / P)
            position += self.output[np.clip(updates, 0, self.output.size - 1).astype(int)] / PARTS
        return position

    def stepped(self, steps: FloatArray, origins: FloatArray) -> FloatArray:
        """Return positions in steps, output units, that count from an origin each, in steps."""
        position: FloatArray = steps[:, None] * np.round(self.output / steps[:, None] - origins[:, None])
        return position


class _Part:
    """Some samples of a loop's record, and what the process alone leaves of them."""

    def __init__(self, loop: _Loop, rows: IntArray) -> None:
        base = loop.base
        columns, slopes = tangent(replace(base.problem, rows=rows), base.theta)
        pv = base.problem.dataset.data.pv[rows]
        self.rows, self.answers = rows, loop.answers[rows]
        self.basis, _ = solve_linear(np.hstack((columns[:, 1:], slopes)), pv)
        self.left = pv - self.basis @ (self.basis.T @ pv)

    def fall(self, positions: FloatArray) -> FloatArray:
        """Return by how much the squares fall with each position, shape (count, N)."""
        answer = positions @ self.answers.T
        own = answer - (answer @ self.basis) @ self.basis.T
        squares = np.einsum("ij,ij->i", own, own)
        falls: FloatArray = (own @ self.left) ** 2 / np.maximum(squares, SMALLEST_DIVISOR)
        return falls
