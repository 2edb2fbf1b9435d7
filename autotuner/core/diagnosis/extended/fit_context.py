"""Fit context: the common basis of all explanations, with one dataset, decimated in three ways, and one criterion.

    criterion   n ln(S/N + floor^2) + p (ln n + c) + price,   n = N / inflation of the best residual

(Schwarz, Ann. Statist. 6, 1978; `c` the penalty for the number of tried forms, Chen and Chen, Biometrika 95, 2008),
with as many independent samples as the autocorrelation of the residual leaves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.extended_model import closest_first, plainness, without_rounding
from autotuner.core.diagnosis.extended.left_open_later import error_left_open
from autotuner.core.diagnosis.extended.seen_again import with_own_events
from autotuner.core.estimation.candidate import MANY_STRUCTURES
from autotuner.core.signals.noise import inflation, rms

if TYPE_CHECKING:
    from collections.abc import Iterable

    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray, IntArray

SCREEN_SAMPLES, COARSE_SAMPLES, MOST_SAMPLES = 250, 450, 2000
"""Samples on which starts are scored, candidates are compared, and explanations are fitted."""

LONG, AFTER = 6, 15
"""Ratio of rows to the most from which a record is long, and the number of rows after each move that are included."""


@dataclass(frozen=True, slots=True, eq=False)
class FitContext:
    """A dataset and its samples.

    Attributes
    ----------
    dataset : Dataset
        The recording.
    screen, coarse, fine : array of int
        Samples of the fitted part, ever more of them.
    held_out : array of int
        Samples of the other part.
    """

    dataset: Dataset
    screen: IntArray
    coarse: IntArray
    fine: IntArray
    held_out: IntArray

    def criterion(self, candidate: Fitted, inflated: float) -> float:
        """Return the criterion, given the number of samples of the best residual per independent one."""
        independent = max(candidate.residual.size / inflated, 4.0)
        misfit = independent * math.log(candidate.mean_square + self.dataset.floor**2)
        return misfit + self.price_of(candidate, independent)

    def price_of(self, candidate: Fitted, independent: float) -> float:
        """Return what the numbers of a candidate cost, given the number of independent samples."""
        return candidate.size * (math.log(independent) + MANY_STRUCTURES / 2.0) + 2.0 * candidate.price

    def colour(self, candidate: Fitted) -> float:
        """Return the number of samples of a candidate's residual per independent one."""
        return self.inflation(candidate.residual)

    def inflation(self, residual: FloatArray) -> float:
        """Return the number of samples of a residual per independent one; 1 for one of rounding."""
        return 1.0 if rms(residual) <= self.dataset.floor else inflation(residual)

    def held_out_residual(self, candidate: Fitted) -> FloatArray:
        """Return measured minus simulated on the part not fitted, PV; single events are as that part shows them."""
        seen = with_own_events(candidate, self.dataset, self.dataset.data.t.size)
        residual: FloatArray = self.dataset.data.pv[self.held_out] - seen.simulated(self.held_out)
        return residual

    def held_out_error(self, candidate: Fitted) -> float:
        """Return the root mean square of that, PV."""
        return rms(self.held_out_residual(candidate))

    def on_both_parts(self, candidate: Fitted) -> float:
        """Return the misfits on the fitted and on the other part together, PV squared."""
        held = self.held_out_residual(candidate)
        return candidate.misfit + float(held @ held) / held.size

    def expected(self, candidate: Fitted, noise: float) -> float:
        """Return the expected residual of a correct candidate: noise, and what the fitted part leaves open."""
        dataset = self.dataset
        return math.hypot(noise, error_left_open(candidate, dataset, self.held_out, dataset.fitted_until_s))

    def best(self, candidates: list[Fitted]) -> Fitted:
        """Return the candidate with the lowest criterion."""
        inflated = min(self.colour(c) for c in closest_first(candidates)[:3])
        return self.by_criterion(candidates, inflated)[0]

    def by_criterion(self, candidates: Iterable[Fitted], inflated: float) -> list[Fitted]:
        """Return candidates by the criterion, the best first, the plainer one where that is the same."""
        return without_rounding(candidates, lambda c: self.criterion(c, inflated), plainness)


def bench_of(dataset: Dataset) -> FitContext:
    """Return the context of a dataset, with its samples decimated."""
    rows = np.flatnonzero(dataset.fitted)
    return FitContext(
        dataset,
        spread(dataset, rows, SCREEN_SAMPLES),
        spread(dataset, rows, COARSE_SAMPLES),
        thinned(rows, MOST_SAMPLES),
        thinned(np.flatnonzero(dataset.held_out), MOST_SAMPLES),
    )


def spread(dataset: Dataset, rows: IntArray, most: int) -> IntArray:
    """Return `most` of the rows at most: evenly, and of a long record half of them right after moves of the output.

    Evenly spaced rows alone would be too far apart to show the response of the process.
    """
    if rows.size <= LONG * most:
        return thinned(rows, most)
    moves = np.searchsorted(dataset.data.t[rows], dataset.data.held.times[1:])
    some = thinned(moves[moves < rows.size], max(most // (2 * AFTER), 1))
    after = np.unique(np.minimum(some[:, None] + np.arange(AFTER), rows.size - 1))
    picked: IntArray = np.union1d(thinned(rows, most // 2), rows[after])
    return picked


def thinned(rows: IntArray, most: int) -> IntArray:
    """Return `most` of the rows at most, evenly."""
    if rows.size <= most:
        return rows
    picked: IntArray = rows[np.unique(np.linspace(0, rows.size - 1, most).astype(int))]
    return picked
