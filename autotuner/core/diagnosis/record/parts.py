"""The three parts of a record, by a stated rule.

    a tuning with a tail:   fit  up to the tail,    selection  the first 70 % of the tail,   test  the rest of it
    any other record:       fit  the first 60 %,    selection  the next 20 %,                test  the last 20 %

by time. Where the output goes in its last 20 % where it never was, what happens there is known from there alone: the
test part is the last 15 % if that is not so of them, else the last 10 %, and fit and selection share the rest as 3 : 1.
A part of fewer than 20 samples is not made smaller. The output is where it stays: its course through a lag, of 1, 3 or
10 % of the record, goes there. Invariants:

1. What is named, how large it is, the verdict and the gains follow from fit and selection alone. The search never sees
   the test part: it works on a recording that ends before it.
2. The division follows from the output alone, which no effect on the PV changes.
3. The test part gives the error that is reported, before and after, by simulation without any further fit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.record.dataset import input_of
from autotuner.core.estimation.data import Data
from autotuner.core.model.step_responses import Lag

if TYPE_CHECKING:
    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import BoolArray, FloatArray
    from autotuner.core.recording import Recording

TESTED = (0.2, 0.15, 0.1)
"""Shares of a record without a tail that are kept for the test: the first in which the output goes nowhere new."""
TESTED_OF_A_TAIL = 0.3
"""The same of a tuning's tail."""
LAGS = (0.01, 0.03, 0.1)
"""Lags through which the output is seen, in lengths of the record: from a short stay to a long one."""
ENOUGH = 20
"""Samples from which a smaller part than the largest is a test: their error is known to a sixth."""
BEYOND = 0.1
"""How far beyond its range of before it goes where it goes somewhere new, over that range."""
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
        until = float(t[-1]) - _tested(recording) * (float(t[-1]) - float(t[0]))
    count = int(np.searchsorted(t, until, side="right"))
    if len(recording) - count < FEWEST or count < 4 * FEWEST:
        return Parts(recording, recording)
    return Parts(recording.part(slice(0, count)), recording)


def _tested(recording: Recording) -> float:
    """Return the share of a record without a tail that is kept for the test."""
    t = recording.t - recording.t[0]
    held = input_of(recording, smooth=False, begins="")
    courses = [Lag(share * float(t[-1])).forced(held, t)[0][0] for share in LAGS]
    enough = [share for share in TESTED if np.count_nonzero(_late(t, share)) >= ENOUGH] or TESTED[:1]
    return next((share for share in enough if not any(_goes_beyond(c, _late(t, share)) for c in courses)), enough[-1])


def _late(t: FloatArray, share: float) -> BoolArray:
    """Return which samples lie in the last share of the time."""
    late: BoolArray = t > (1.0 - share) * t[-1]
    return late


def _goes_beyond(course: FloatArray, late: BoolArray) -> bool:
    """Return whether a course leaves its range of before in the later samples."""
    before, after = course[~late], course[late]
    beyond = max(float(after.max() - before.max()), float(before.min() - after.min()))
    return beyond > BEYOND * float(np.ptp(before))
