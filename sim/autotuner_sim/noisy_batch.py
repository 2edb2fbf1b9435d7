"""Relay tests of thousands of plants at once whose relays see samples of the PV with noise: `noisy_relay` on arrays.

    reading_i = y(i dt) + a e_{s+i},   e goes round,   a and s of each test its own

One row of noise serves all tests, so the largest of any samples of it in a row is known beforehand (`sampled_course`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from autotuner_sim.noisy_relay import checked_noise, checked_sample_time
from autotuner_sim.sampled_course import Course, Source, from_rest
from autotuner_sim.sampled_motion import motion_of, peaks

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from autotuner_sim.batch import RelayTests

Numbers = NDArray[np.float64]
Counts = NDArray[np.int64]
Rows = NDArray[np.intp]
Truths = NDArray[np.bool_]

_AT_ONCE = 4_000
"""Most tests that go on together: with more of them, their arrays leave the processor's cache."""


@dataclass(frozen=True, slots=True, eq=False)
class NoisyBatch:
    """Relay tests by samples.

    Attributes
    ----------
    tests : RelayTests
        What was tested.
    sample_time_s : float
        From one sample to the next, s.
    starts_high : array of bool, shape (N,)
        The first position, taken at sample 0.
    switches : array of int, shape (N, switches)
        Samples at which the relays switched; -1 where the noise ended before.
    peak : array of float, shape (N,)
        Amplitude of the PV, without noise, over the last full period, zero to peak; NaN where there is none.
    """

    tests: RelayTests
    sample_time_s: float
    starts_high: Truths
    switches: Counts
    peak: Numbers

    @property
    def switches_s(self) -> Numbers:
        """Times of the switches, s from the start, shape (N, switches); NaN where there is none."""
        return np.where(self.switches < 0, math.nan, self.switches * self.sample_time_s)

    @property
    def period_s(self) -> Numbers:
        """Length of the last full period, s, shape (N,)."""
        period_s: Numbers = self.switches_s[:, -1] - self.switches_s[:, -3]
        return period_s


def noisy_batch(
    tests: RelayTests,
    noise: ArrayLike,
    sample_time_s: float,
    *,
    scale: ArrayLike = 1.0,
    starts: ArrayLike = 0,
    switches: int = 20,
) -> NoisyBatch:
    """Run relay tests from rest.

    Parameters
    ----------
    tests : RelayTests
        Plants of first or second order with their relays. A relay takes its first position at sample 0: the high one
        unless the reading forbids it.
    noise : array of float, shape (M,)
        Noise, sample by sample, for all tests; each ends when it has read all of it.
    sample_time_s : float
        From one sample to the next, s.
    scale : float or array of shape (N,), optional
        What the noise of each test is multiplied with; PV, if the noise has standard deviation 1.
    starts : int or array of shape (N,), optional
        Where in the row each test begins to read; it goes on at its beginning when the row ends.
    switches : int, optional
        Switches of each test, 3 at least.

    Returns
    -------
    NoisyBatch
        Test `i` switches as `noisy_relay` with `scale[i] * np.roll(noise, -starts[i])`.

    Raises
    ------
    ValueError
        The noise is not finite, or the sample time not positive, or there are less than 3 switches.
    """
    row = checked_noise(noise)
    sample_time_s = checked_sample_time(sample_time_s)
    if switches < 3:
        raise ValueError(f"switches must be 3 or more (got {switches!r}): a period has three.")
    scale, starts = (np.broadcast_to(column, tests.K.shape) for column in (scale, starts))
    high_until = np.sign(tests.K) * (scale * row[starts % row.size] - tests.thresholds[0])
    batch = NoisyBatch(
        tests,
        sample_time_s,
        high_until <= 0.0,
        np.full((tests.K.size, switches), -1),
        np.full(tests.K.size, math.nan),
    )
    single, rings = tests.m == 0.0, tests.n**2 < 4.0 * tests.m
    source = Source(row)
    for kind in (single, rings, ~single & ~rings):
        rows = np.flatnonzero(kind)
        for part in np.array_split(rows, math.ceil(rows.size / _AT_ONCE)) if rows.size else ():
            _run(batch, part, source, scale[part], starts[part])
    return batch


def _run(batch: NoisyBatch, rows: Rows, source: Source, scale: Numbers, starts: Counts) -> None:
    """Fill in some of the tests, all of a kind."""
    tests, switches = batch.tests.only(rows), batch.switches.shape[1]
    with np.errstate(all="ignore"):  # the bounds of a plant at rest may be anything above what is left
        motion = motion_of(tests, batch.sample_time_s)
        each = from_rest(tests, batch.starts_high[rows], batch.sample_time_s, scale, starts)
        course = Course(motion, each, source, switches)
        while course.each.row.size:
            course.go_on()
        batch.switches[rows] = course.taken[:, 1:]
        batch.peak[rows] = peaks(motion, course.taken, course.knots)
