"""Errors before and after, by part of the record: one figure for every effect.

    error = sqrt(mean (pv - simulated)^2),   expected^2 = noise^2 + spread^2 mean (d simulated/dt)^2 + open^2

`spread` the standard deviation of uneven sampling times, `open` the error by what is left open: delays of moves, steps
of an actuator. On the selection
part, both models are as fitted to the fitted part, and on the test part, as fitted to both (`to_both_parts`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.both_parts import to_both_parts
from autotuner.core.diagnosis.extended.left_open_later import error_left_open
from autotuner.core.diagnosis.findings.result import Misfit, Traces
from autotuner.core.diagnosis.record.sensor import spikes_of
from autotuner.core.signals.noise import rms

if TYPE_CHECKING:
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext
    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.diagnosis.record.parts import Parts
    from autotuner.core.model.arrays import FloatArray, IntArray

BLOCKS, LONG = 5, 500
"""Number of equal parts of a long record with their own errors, and samples from which a record is long."""


@dataclass(frozen=True)
class Errors:
    """The errors of a model without effects and of that with them.

    Attributes
    ----------
    context : FitContext
        The record up to its test part.
    parts : Parts
        That, and the whole.
    before, after : Fitted
        The two models.
    noise : float
        Standard deviation of the noise, PV.
    spread_s : float
        Standard deviation of the sampling times, s.
    """

    context: FitContext
    parts: Parts
    before: Fitted
    after: Fitted
    noise: float
    spread_s: float = 0.0

    def by_part(self) -> dict[str, Misfit]:
        """Return the errors on the fitted, the selection and the test part."""
        selected = self._on_the_selection_part(self.context.held_out)
        return {
            "fitted": self._misfit(self.context.dataset, *self._as_fitted, self.context.fine),
            "selection": selected,
            "held_out": self._on_the_test_part() if self._tested.size else selected,
        }

    def of_the_later_selection(self) -> Misfit:
        """Return the errors on the later half of the selection part: a model that predicts does so there, too."""
        rows = self.context.held_out
        return self._on_the_selection_part(rows[rows.size // 2 :])

    @cached_property
    def _as_fitted(self) -> tuple[FloatArray, FloatArray]:
        """Return the PV of both models, as fitted to the fitted part, up to the test part."""
        rows = np.arange(self.context.dataset.data.t.size)
        return self.before.simulated(rows), self.after.simulated(rows)

    def _on_the_selection_part(self, rows: IntArray) -> Misfit:
        dataset = self.context.dataset
        left_open = error_left_open(self.after, dataset, rows, dataset.fitted_until_s)
        return self._misfit(dataset, *self._as_fitted, rows, left_open)

    def _on_the_test_part(self) -> Misfit:
        final = to_both_parts(self.context, self.after)
        left_open = error_left_open(final, self._whole, self._tested, self.parts.test_from_s, tested=True)
        return self._misfit(self._whole, *self._simulated, self._tested, left_open)

    def of_blocks(self) -> tuple[Misfit, ...]:
        """Return the errors of equal parts of a long record."""
        if self._rows.size < LONG:
            return ()
        blocks = np.array_split(self._rows, BLOCKS)
        return tuple(self._misfit(self._whole, *self._simulated, block) for block in blocks)

    def traces(self) -> Traces:
        """Return the data of the pictures."""
        dataset = self._whole
        held, t = dataset.data.held, dataset.data.t
        until_next = np.searchsorted(held.times, np.append(t[1:], np.inf), side="left") - 1
        output = held.levels[np.maximum(until_next, 0)] + dataset.output0
        before, after = (simulated + dataset.pv0 for simulated in self._simulated)
        return Traces(t, output, dataset.data.pv + dataset.pv0, before, after, self.parts.test_from_s)

    def _misfit(
        self, dataset: Dataset, before: FloatArray, after: FloatArray, rows: IntArray, left_open: float = 0.0
    ) -> Misfit:
        pv = dataset.data.pv[rows]
        expected = math.hypot(self.noise, left_open)
        if self.spread_s:
            expected = math.hypot(expected, self.spread_s * rms(np.gradient(after, dataset.data.t)[rows]))
        return Misfit(rms(pv - before[rows]), rms(pv - after[rows]), self.noise, expected)

    @cached_property
    def _whole(self) -> Dataset:
        return self.parts.whole_case(self.context.dataset)

    @cached_property
    def _simulated(self) -> tuple[FloatArray, FloatArray]:
        """Return the PV of both models over the whole record."""
        rows = np.arange(self._whole.data.t.size)
        fits = [to_both_parts(self.context, f) for f in (self.before, self.after)]
        before, after = (f.on(self._whole).simulated(rows) for f in fits)
        return before, after

    @cached_property
    def _rows(self) -> IntArray:
        """Return the samples that are measurements."""
        dataset = self.context.dataset
        good = np.ones(self._whole.data.t.size, dtype=np.bool_)
        good[: dataset.spikes.size] = ~dataset.spikes
        if dataset.spikes.any():
            left = self._whole.data.pv - self._simulated[1]
            good[dataset.spikes.size :] = ~spikes_of(left, self.noise)[dataset.spikes.size :]
        return np.flatnonzero(good)

    @cached_property
    def _tested(self) -> IntArray:
        rows: IntArray = self._rows[self._rows >= self.parts.tested.start]
        return rows
