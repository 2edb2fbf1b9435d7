"""The three parts of a record, by a stated rule.

    a tuning with a tail:   fit  up to the tail,    selection  the first 70 % of the tail,   test  the rest of it
    any other record:       fit  the first 60 %,    selection  the next 20 %,                test  the last 20 %

by time. Invariants:

1. What is named, how large it is, the verdict and the gains follow from fit and selection alone. The search never sees
   the test part: it works on a recording that ends before it.
2. The test part gives the error that is reported, before and after, by simulation without any further fit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.record.dataset import input_of
from autotuner.core.estimation.data import Data

if TYPE_CHECKING:
    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.recording import Recording

TESTED = 0.2
"""Share of a record without a tail that is kept for the test."""
TESTED_OF_A_TAIL = 0.3
"""The same of a tuning's tail."""
FEWEST = 5
"""Samples that each part has at least; a record too short for that has no test part."""


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """A recording up to the test part, and the whole.

    Attributes
    ----------
    before_test : Recording
        The samples for fit and selection.
    whole : Recording
        All samples.
    """

    before_test: Recording
    whole: Recording

    @property
    def tested(self) -> slice:
        """Rows of the test part in the whole."""
        return slice(len(self.before_test), len(self.whole))

    @property
    def test_from_s(self) -> float:
        """Start of the test part, s from the start; the end of the record without one."""
        last = min(len(self.before_test), len(self.whole) - 1)
        return float(self.whole.t[last] - self.whole.t[0])

    def whole_case(self, before_test: Dataset) -> Dataset:
        """Return the dataset of the whole record, in the units and about the values of the one that was searched."""
        t = self.whole.t - self.whole.t[0]
        held = input_of(self.whole, smooth=before_test.smooth, begins=before_test.begins)
        data = Data(t, self.whole.pv - before_test.pv0, held, np.ones_like(t))
        return replace(before_test, data=data, extra=dict(self.whole.extra), span_s=before_test.span_s)


def parts_of(recording: Recording) -> Parts:
    """Return the parts of a recording."""
    t = recording.t
    tail = recording.segments.get("tail")
    if isinstance(tail, int | float) and math.isfinite(tail) and t[0] < tail < t[-1]:
        until = float(t[-1]) - TESTED_OF_A_TAIL * (float(t[-1]) - tail)
    else:
        until = float(t[-1]) - TESTED * (float(t[-1]) - float(t[0]))
    count = int(np.searchsorted(t, until, side="right"))
    if len(recording) - count < FEWEST or count < 4 * FEWEST:
        return Parts(recording, recording)
    return Parts(recording.part(slice(0, count)), recording)
