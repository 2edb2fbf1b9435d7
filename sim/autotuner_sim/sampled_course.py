"""Tests of a kind whose relays see noisy samples, all together, each as far as it can go in one go.

    a single lag         z = z0 e^{-t/T} gives the time
    second order         z + v t + (1 + 2 zeta) r t^2/2 is never passed, r^2 = z^2 + v^2 (time in units of 1/w0)

since `|z''| = |2 zeta v + z| <= (1 + 2 zeta) r` and `r` never grows. A test goes from one arrival of the relay's output
to the next, within that to a sample before which the PV cannot be beyond the threshold less the largest noise, and from
there by reading. `noisy_batch` says what `z` is and where the noise comes from.

Rule of this file: what is passed over is certain not to switch, so the switches are those of a loop over all samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from autotuner_sim.sampled_motion import KNOT

if TYPE_CHECKING:
    from autotuner_sim.batch import RelayTests
    from autotuner_sim.sampled_motion import Motion

Numbers = NDArray[np.float64]
Counts = NDArray[np.int64]
Rows = NDArray[np.intp]
Truths = NDArray[np.bool_]

_READ = 32
"""Samples read at once."""
_WORTH = 6.0
"""Samples that a bound must pass over to be better than reading."""
_KEPT = 0.8
"""Share of the tests that still go on below which the others are left behind."""


class Source:
    """The noise, with the largest and the smallest of each `_READ` samples in a row."""

    def __init__(self, row: Numbers) -> None:
        self.size = row.size
        around = np.resize(row, row.size + _READ - 1)
        self._windows = np.lib.stride_tricks.sliding_window_view(around, _READ)
        extremes, span = np.array([around, -around]), 1
        while span < _READ:
            extremes = np.maximum(extremes[:, :-span], extremes[:, span:])
            span *= 2
        self._extremes, self._most = extremes, extremes.max(axis=1)

    def largest(self, scale: Numbers) -> Numbers:
        """Return the largest of all noise, scaled."""
        largest: Numbers = np.where(scale > 0.0, *self._most) * np.abs(scale)
        return largest

    def largest_of_next(self, at: Counts, scale: Numbers) -> Numbers:
        """Return the largest of the samples that would be read, scaled."""
        largest: Numbers = self._extremes[(scale <= 0.0).astype(np.intp), at] * np.abs(scale)
        return largest

    def read(self, at: Counts) -> Numbers:
        """Return the next samples, shape (n, _READ)."""
        return self._windows[at]


@dataclass(slots=True, eq=False)
class Each:
    """What is known of each test that goes on, its PV counted so that the first position ends above; times in samples.

    `z`, `v` is the state at `begun`, the last of `arrived` arrivals, counted from `level`; `until` is the next.
    `sample` is the next to be read; `count` switches were, and the PV has to go `way` to the next, at `aim`.
    """

    row: Rows
    D: Numbers
    scale: Numbers
    starts: Counts
    both: Numbers
    first: Numbers
    second: Numbers
    aim: Numbers
    way: Numbers
    sample: Numbers
    until: Numbers
    begun: Numbers
    level: Numbers
    z: Numbers
    v: Numbers
    arrived: Rows
    count: Rows

    def only(self, rows: Rows) -> Each:
        """Return some of them."""
        return Each(*(getattr(self, field.name)[rows] for field in fields(self)))


def from_rest(tests: RelayTests, high: Truths, sample_time_s: float, scale: Numbers, starts: Counts) -> Each:
    """Return what is known of tests at their beginning."""
    size, sign = tests.K.size, np.sign(tests.K) * np.where(high, 1.0, -1.0)
    (up, down), thresholds, D = tests.ends, tests.thresholds, tests.D / sample_time_s
    return Each(
        row=np.arange(size),
        D=D,
        scale=sign * scale,
        starts=starts,
        both=sign * (thresholds[0] + thresholds[1]),
        first=sign * np.where(high, up, down),
        second=sign * np.where(high, down, up),
        aim=sign * np.where(high, *thresholds),
        way=np.ones(size),
        sample=np.ones(size),
        until=D.copy(),
        begun=np.zeros(size),
        level=np.zeros(size),
        z=np.zeros(size),
        v=np.zeros(size),
        arrived=np.zeros(size, dtype=np.intp),
        count=np.zeros(size, dtype=np.intp),
    )


class Course:
    """Tests as far as they are known: all their switches, from sample 0 on, and arrivals (`KNOT`)."""

    def __init__(self, motion: Motion, each: Each, source: Source, switches: int) -> None:
        self.motion, self.each, self.source, self.switches = motion, each, source, switches
        size = each.row.size
        self.taken, self.knots = np.full((size, switches + 1), -1), np.full((len(KNOT), size, switches + 2), math.nan)
        self.taken[:, 0], self.knots[:, :, 0] = 0, 0.0
        self._ahead = motion.ahead(_READ)

    def go_on(self) -> None:
        """Go on, each test as far as it can in one go."""
        each, last = self.each, self.source.size - 1.0
        arrives = np.flatnonzero((each.sample >= each.until) & (each.until <= last))
        if arrives.size:
            self._arrive(arrives)
        end = np.ceil(np.minimum(each.until, last + 1.0))
        waits = each.sample >= end  # for the next arrival
        z, v = self.motion.move(each.z, each.v, each.sample - each.begun)
        gap = each.way * (each.aim - each.level - z)
        ahead = self.motion.before(z, v, each.way, gap - self.source.largest(each.way * each.scale))
        reads = np.flatnonzero((ahead < _WORTH) > waits)
        sample = np.minimum(each.sample + np.floor(ahead), end)
        np.copyto(each.sample, sample, where=(ahead >= _WORTH) > waits)
        if reads.size:
            self._read(reads, z[reads], v[reads], gap[reads], end[reads])
        goes_on = each.sample <= last
        if np.count_nonzero(goes_on) < _KEPT * goes_on.size:
            self._leave_behind(np.flatnonzero(goes_on))

    def _arrive(self, rows: Rows) -> None:
        """Take the relay's next output to the plants of some tests."""
        each, some = self.each, self.each.only(rows)
        z, v = self.motion.only(rows).move(some.z, some.v, some.until - some.begun)
        level = np.where(some.arrived % 2, some.second, some.first)
        z += some.level - level
        arrived = some.arrived + 1
        self.knots[:, some.row, arrived] = some.until, level, z, v
        each.z[rows], each.v[rows], each.level[rows], each.begun[rows] = z, v, level, some.until
        taken = self.taken[some.row, np.minimum(arrived, self.switches)]
        each.until[rows] = np.where(arrived <= some.count, taken + some.D, math.inf)
        each.arrived[rows] = arrived

    def _read(self, rows: Rows, z: Numbers, v: Numbers, gap: Numbers, end: Numbers) -> None:
        """Go on by the noise of the next samples."""
        each = self.each
        sample, way, scale = each.sample[rows], each.way[rows], each.scale[rows]
        at = (each.starts[rows] + sample.astype(np.int64)) % self.source.size
        short = gap - self.source.largest_of_next(at, way * scale)
        ahead = np.minimum(self.motion.only(rows).before(z, v, way, short), _READ)
        read = np.flatnonzero(ahead < _WORTH)
        readings = z[read, None] * self._ahead[0][rows[read]]
        readings += v[read, None] * self._ahead[1][rows[read]]
        readings += scale[read, None] * self.source.read(at[read])
        beyond = readings * way[read, None] > (gap + way * z)[read, None]
        first = beyond.argmax(axis=1)
        ahead[read] = np.where(beyond[np.arange(first.size), first], first, _READ)
        switched = read[(ahead[read] < _READ) & (sample[read] + ahead[read] < end[read])]
        each.sample[rows] = np.minimum(sample + np.floor(ahead), end)
        self._switch(rows[switched])

    def _switch(self, rows: Rows) -> None:
        """Switch some relays at the sample just read."""
        each = self.each
        sample, count = each.sample[rows], each.count[rows] + 1
        self.taken[each.row[rows], count] = sample
        each.count[rows], each.sample[rows] = count, sample + 1.0
        each.way[rows] = -each.way[rows]
        each.aim[rows] = each.both[rows] - each.aim[rows]
        waited, done = each.arrived[rows] == count, rows[count == self.switches]
        each.until[rows] = np.where(waited, sample + each.D[rows], each.until[rows])
        each.sample[done], each.until[done] = self.source.size, math.inf

    def _leave_behind(self, rows: Rows) -> None:
        """Go on with some only."""
        self.motion, self.each = self.motion.only(rows), self.each.only(rows)
        self._ahead = self._ahead[0][rows], self._ahead[1][rows]
