"""A sawtooth on the PV: filling and a siphon, ice and its defrosting.

    + a (2 (t - t_0)/T - 2 n - 1),   n = floor((t - t_0)/T), jumps from t_0 on
    t_k < t_0 + n_k T <= t_k+1                                 each jump lies between two samples
    (t_j - t_k+1)/(n_j - n_k) <= T <= (t_j+1 - t_k)/(n_j - n_k)   for all pairs j > k, with which there is such a t_0

Ramps and jumps show the period `T`. The time `t_0` moves the ramps as an offset does: the jumps alone show it, and it
is the middle of the times that a period leaves to it. Where the jumps are known, so is the `n` of every sample: a jump
that crossed a sample would stop a search.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effects.waves import price_of_a_period
from autotuner.core.diagnosis.extended.effect import Effect, Place, Searched, Seen, View, between

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

OUTSTANDING, FEWEST_JUMPS = 8.0, 4
"""Least ratio of a jump to the median difference of samples, 5.4 sigmas of white noise; fewest jumps of a sawtooth."""
SLOPE_STEP = 1e-3
"""Step of the derivative by the period, in the periods that the jumps leave open."""


@dataclass(frozen=True, slots=True, eq=False)
class RegularJumps:
    """Jumps at equal distances, each between two samples.

    Attributes
    ----------
    before_s, after_s : array of float, shape (J,)
        The samples about each jump, s.
    turns : array of float, shape (J,)
        Periods from a jump in the middle to each.
    shortest_s, longest_s : float
        Periods with which all jumps lie between their samples, s.
    """

    before_s: FloatArray
    after_s: FloatArray
    turns: FloatArray
    shortest_s: float
    longest_s: float

    @classmethod
    def of(cls, t: FloatArray, residual: FloatArray) -> RegularJumps | None:
        """Return the jumps of a residual; None where they are few, of both signs, or at unequal distances."""
        difference = np.diff(residual)
        difference = difference - np.median(difference)
        jumps = np.flatnonzero(np.abs(difference) > OUTSTANDING * np.median(np.abs(difference)))
        if jumps.size < FEWEST_JUMPS or abs(np.sum(np.sign(difference[jumps]))) < jumps.size:
            return None
        before, after = t[jumps], t[jumps + 1]
        distances = np.diff(before + after) / 2.0
        turns = np.append(0.0, np.cumsum(np.round(distances / np.median(distances))))
        turns -= turns[jumps.size // 2]
        first, later = np.triu_indices(jumps.size, 1)
        apart = turns[later] - turns[first]
        if not apart.all():
            return None
        shortest = float(np.max((before[later] - after[first]) / apart))
        longest = float(np.min((after[later] - before[first]) / apart))
        return cls(before, after, turns, shortest, longest) if shortest < longest else None

    def periods_s(self) -> FloatArray:
        """Return some of the periods with which all jumps lie between their samples, s."""
        return between(self.shortest_s, self.longest_s)

    def first_s(self, period_s: float) -> float:
        """Return the middle of the times that a period leaves to the jump from which `turns` count, s."""
        earliest = np.max(self.before_s - self.turns * period_s)
        latest = np.min(self.after_s - self.turns * period_s)
        return float(earliest + latest) / 2.0


def sawtooth(dataset: Dataset, residuals: Sequence[FloatArray]) -> tuple[Effect, ...]:
    """Return a sawtooth where a residual has jumps at equal distances on the fitted part; empty without any."""
    rows = np.flatnonzero(dataset.fitted)
    found = (RegularJumps.of(dataset.data.t[rows], residual[rows]) for residual in residuals)
    jumps = next((jumps for jumps in found if jumps is not None), None)
    return () if jumps is None else (_with(jumps, dataset, dataset.fitted_until_s),)


def _with(jumps: RegularJumps, dataset: Dataset, known_until_s: float) -> Effect:
    """Return a sawtooth whose jumps are known until some time."""
    middle_s, open_s = (jumps.shortest_s + jumps.longest_s) / 2.0, jumps.longest_s - jumps.shortest_s
    start_s = jumps.first_s(middle_s)

    def columns(view: View, p: Sequence[float]) -> list[FloatArray]:
        turns = (view.t - jumps.first_s(p[0])) / p[0]
        known = np.floor((view.t - start_s) / middle_s)
        return [2.0 * (turns - np.where(view.t <= known_until_s, known, np.floor(turns))) - 1.0]

    def seen_again(seen: Seen) -> Effect | None:
        t = dataset.data.t[seen.rows]
        again = RegularJumps.of(t, seen.left)
        return None if again is None else _with(again, dataset, float(t[-1]))

    return Effect(
        "periodic_disturbance",
        Place.DISTURBANCE,
        (Searched("period_s", jumps.shortest_s, jumps.longest_s, SLOPE_STEP * open_s),),
        [(middle_s,)],
        lambda p, c, _g: {"period_s": p[0], "amplitude": abs(c[0])},
        form="sawtooth",
        columns=columns,
        price=price_of_a_period(dataset),
        alike=lambda _p, _until_s: [(period_s,) for period_s in jumps.periods_s()],
        seen_again=seen_again,
    )
