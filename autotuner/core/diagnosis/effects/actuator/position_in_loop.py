"""What an actuator does to a command that moves at every sample: by the answer of the process to its position.

    updates   v(t) = u(P (floor(t/P - phi) + phi))
    stages    v = sum_j h_j [u > theta_j],   equal steps: theta_j = o + (k + j + 1/2) s
    y = sum_j h_{i-j} v_j,   fall = (r'y)^2 / |(I - Q Q') y|^2

`h` answer of the process alone to a pulse of one sample, `r = (I - Q Q') pv`, `Q` an orthonormal basis of its
background and slopes. A controller moves the output at every sample, so that no move and no level has an answer of its
own; the whole position has one, and thousands are tried.

The process alone has taken up half of an update period as dead time, which is added again. A period is known the better
the longer the record: over `W` samples, one that is off by `1/(4 W)` updates a sample loses a quarter of its phase. So
all periods are tried on the part of the record with most motion, and the best of them, ever finer, on all of it.

Stages are the least squares over all heights that are not negative, of a threshold at each of many outputs. That is a
convex problem, however far the process alone lies from the right one, and most heights are 0 (Lawson and Hanson,
Solving Least Squares Problems, 1974, ch. 23; Slawski and Hein, Electron. J. Statist. 7, 2013). What a wrong process
makes of one stage, several at neighbouring outputs, is merged to one, pair by pair.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy

from autotuner.core.diagnosis.effects.actuator.levels import origin_of, zeros_of
from autotuner.core.diagnosis.effects.actuator.stages import FEWEST, outputs_around, passed
from autotuner.core.diagnosis.extended.extended_model import apart
from autotuner.core.diagnosis.extended.fitting import tangent
from autotuner.core.estimation.linear_least_squares import solve_linear
from autotuner.core.model.arrays import SMALLEST_DIVISOR
from autotuner.core.model.zoh_input import HeldInput

if TYPE_CHECKING:
    from collections.abc import Iterator

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
HIGHEST = 30
"""Stages that may be merged, the highest ones: a wrong process makes more of them than an actuator has."""
ROUNDING = 1e-12
"""Share of the squares that counts as rounding: two thresholds without an output between them are one."""
EVEN = 0.01
"""Deviation of a sampling interval, over it, up to which samples are even."""
MOST_SAMPLES = 1500
"""Most samples of a record that is searched: the answers are a matrix of the square of that."""
APART = 0.004
"""Least relative distance of two periods, or steps."""
THRESHOLDS, FINER = 150, 0.1 * np.arange(-20, 21)
"""Thresholds that are tried over the range of the output, and around each known one, in distances of those."""


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


def stages_in_loop(
    base: Fitted, known: FloatArray, looseness: float, nearest: float
) -> tuple[FloatArray, FloatArray] | None:
    """Return thresholds, in swings from the first output, and heights of the likeliest stages; None of fewer than two.

    Parameters
    ----------
    base : Fitted
        The process alone.
    known : array of float, shape (J,)
        Thresholds that were found before, in swings: around them, others are tried closer together.
    looseness : float
        Error over that of all stages up to which neighbours are merged; in any case where they are not significant.
    nearest : float
        Distance of two thresholds, in the largest one of neighbours, below which they are merged whatever it costs.
    """
    loop, swing = _Loop.of(base), base.problem.dataset.swing
    if loop is None:
        return None
    every = np.linspace(loop.output.min(), loop.output.max(), THRESHOLDS + 2)[1:-1]
    near = swing * known[:, None] + (every[1] - every[0]) * FINER
    thresholds, part = np.union1d(every, near), _Part(loop, loop.rows)
    answers = math.copysign(1.0, float(base.linear[0])) * part.own(passed(loop.output, thresholds))
    heights, _ = scipy.optimize.nnls(answers.T, part.left)
    found = np.sort(np.argsort(-heights, kind="stable")[: min(np.count_nonzero(heights), HIGHEST)])
    if found.size < FEWEST:
        return None
    kept, heights = _Merging(thresholds, answers, part.left).merged(found, looseness, nearest)
    if kept.size < FEWEST:
        return None
    middles = np.mean(outputs_around(loop.output, thresholds[kept]), axis=0) / swing
    return (middles, heights) if np.all(np.diff(middles) > 0.0) else None


def equal_steps(dataset: Dataset, thresholds: FloatArray) -> dict[str, list[tuple[float, float]]]:
    """Return the (step, swings; origin, steps) of equal steps that pass some thresholds, by where they count from.

    Parameters
    ----------
    dataset : Dataset
        The recording.
    thresholds : array of float, shape (J,)
        Outputs at which stages in a row begin, in swings from the first output, the lowest first.
    """
    mean, found = float(thresholds[-1] - thresholds[0]) / (thresholds.size - 1), {}
    for form, zero in zeros_of(dataset).items():
        lowest = round((thresholds[0] - zero) / mean - 0.5) + np.array([-1, 0, 1])
        numbers = lowest[:, None] + np.arange(thresholds.size) + 0.5
        steps = numbers @ (thresholds - zero) / np.einsum("ij,ij->i", numbers, numbers)
        steps = steps[steps > 0.0]
        found[form] = list(zip(steps.tolist(), origin_of(steps, zero).tolist(), strict=True))
    return found


def shows_positions(dataset: Dataset) -> bool:
    """Return whether a record is a loop's, evenly sampled, and neither short nor very long."""
    rows = np.flatnonzero(dataset.fitted)
    is_even = bool(np.ptp(np.diff(dataset.data.t)) <= EVEN * dataset.data.interval_s)
    return dataset.in_loop and is_even and FIRST_PART < rows.size <= int(rows[-1]) + 1 <= MOST_SAMPLES


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
        """Return it; None where positions are not searched."""
        dataset = base.problem.dataset
        if not shows_positions(dataset):
            return None
        t, interval, held = dataset.data.t, dataset.data.interval_s, dataset.data.held
        rows = np.flatnonzero(dataset.fitted)
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
        own = self.own(positions)
        squares = np.einsum("ij,ij->i", own, own)
        falls: FloatArray = (own @ self.left) ** 2 / np.maximum(squares, SMALLEST_DIVISOR)
        return falls

    def own(self, positions: FloatArray) -> FloatArray:
        """Return what only each position, shape (count, N), brings to the PV."""
        answer = positions @ self.answers.T
        own: FloatArray = answer - (answer @ self.basis) @ self.basis.T
        return own


class _Merging:
    """Stages whose neighbours are merged where that costs little, by the normal equations of all of them."""

    def __init__(self, thresholds: FloatArray, answers: FloatArray, left: FloatArray) -> None:
        self.thresholds, self.samples = thresholds, left.size
        self.normal, self.right, self.total = answers @ answers.T, answers @ left, float(left @ left)

    def merged(self, found: IntArray, looseness: float, nearest: float) -> tuple[IntArray, FloatArray]:
        """Return which thresholds stay of those found, and their heights."""
        squares, found, heights = self._solved(found)
        most, insignificant = looseness**2 * squares, 2.0 * math.log(self.samples)
        while found.size > FEWEST:
            gaps = np.diff(self.thresholds[found])
            near = np.flatnonzero(gaps < nearest * gaps.max())
            pairs = (near if near.size else np.arange(gaps.size)).tolist()
            rivals = (self._solved(fewer) for k in pairs for fewer in self._in_one(found, heights, k))
            rival = min(rivals, key=lambda solved: solved[0])
            cost = self.samples * math.log(rival[0] / squares)
            if rival[1].size < FEWEST or (not near.size and rival[0] > most and cost > insignificant):
                break
            squares, found, heights = rival
        return found, heights

    def _in_one(self, found: IntArray, heights: FloatArray, k: int) -> Iterator[IntArray]:
        """Yield the thresholds with the k-th and the next in one place: that of either, or of their mean by height."""
        pair = slice(k, k + 2)
        mean = np.average(self.thresholds[found[pair]], weights=heights[pair])
        middle = int(np.abs(self.thresholds - mean).argmin())
        for place in {*found[pair].tolist(), middle}:
            yield np.concatenate((found[:k], [place], found[k + 2 :]))

    def _solved(self, places: IntArray) -> tuple[float, IntArray, FloatArray]:
        """Return the squares that some thresholds leave, those of them with a height, and the heights."""
        normal, right = self.normal[np.ix_(places, places)], self.right[places]
        heights: FloatArray = scipy.linalg.lstsq(normal, right, cond=ROUNDING, check_finite=False)[0]
        if places.size and heights.min() <= 0.0:
            return self._solved(places[heights > 0.0])
        left = self.total - 2.0 * float(heights @ right) + float(heights @ normal @ heights)
        return max(left, ROUNDING * self.total), places, heights
