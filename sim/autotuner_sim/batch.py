"""Limit cycles of thousands of plants at once, in closed form: one switch at a time on its way (see `swings`, `quick`).

    plants   K e^{-Ds}/(m s^2 + n s + 1),   m = 0 for a single lag

The relay of each plant starts at its high level from rest, where the PV is 0; it acts in the direction of the plant's
gain. A plant for which that is not how it goes gets NaN: no dead time, a level that does not lead across its threshold,
a rest beyond the first threshold, or a PV that turns again before a switch arrives.

`K` PV/output, `D`, `n`, times s, `m` s^2, levels in output units, `reference` and `hysteresis` PV.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from autotuner_sim.swings import ARRAYS, creeping, ringing, swings

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike

    from autotuner_sim.swings import Functions, Shape

Numbers = NDArray[np.float64]
Pair = tuple[Numbers, Numbers]

_CLOSE = 1e-5
"""Relative step of the third-order iteration after which the next would be rounding."""
_MOST_STEPS = 60
_SETTLED = 1e-14
"""Relative change of a half period under which all further ones are the same."""
_AT_ONCE = 4096
"""Plants in one sweep: their arrays stay in the processor's cache."""


class RelayTests(NamedTuple):
    """Plants with their relays, one an element; see `relay_tests`."""

    K: Numbers
    m: Numbers
    n: Numbers
    D: Numbers
    low: Numbers
    high: Numbers
    reference: Numbers
    hysteresis: Numbers

    def only(self, rows: NDArray[np.intp] | slice) -> RelayTests:
        """Return some of them."""
        return RelayTests(*(column[rows] for column in self))

    @property
    def ends(self) -> Pair:
        """Where the PV is heading at the high level and at the low."""
        return self.K * self.high, self.K * self.low

    @property
    def thresholds(self) -> Pair:
        """PV at which the high level ends, and the low."""
        dead_zone = np.sign(self.K) * self.hysteresis
        return self.reference + dead_zone, self.reference - dead_zone

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Whether each level leads across its threshold, from a rest before the first of them."""
        # by the plant's sign: K (up - ahead) > 0 and so on
        K, (up, down), (ahead, back) = self.K, self.ends, self.thresholds
        leads = (K * (up - ahead) > 0.0) & (K * (down - back) < 0.0)
        usable: NDArray[np.bool_] = leads & (K * ahead >= 0.0) & (self.D > 0.0)
        return usable


def relay_tests(
    K: ArrayLike,
    m: ArrayLike,
    n: ArrayLike,
    D: ArrayLike,
    low: ArrayLike = -1.0,
    high: ArrayLike = 1.0,
    reference: ArrayLike = 0.0,
    hysteresis: ArrayLike = 0.0,
) -> RelayTests:
    """Return relay tests of numbers or arrays that broadcast together."""
    columns = np.broadcast_arrays(K, m, n, D, low, high, reference, hysteresis)
    return RelayTests(*(np.array(column, dtype=np.float64).ravel() for column in columns))


@dataclass(frozen=True, slots=True, eq=False)
class CycleBatch:
    """The last full period of each test.

    Attributes
    ----------
    tests : RelayTests
        What was tested.
    high_s, low_s : array of float, shape (N,)
        Time at each level, s.
    after_rise, after_fall : array of float, shape (N,)
        PV at its turn after the rise of the relay, and after its fall.
    """

    tests: RelayTests
    high_s: Numbers
    low_s: Numbers
    after_rise: Numbers
    after_fall: Numbers

    @property
    def period_s(self) -> Numbers:
        """Length of the period, s."""
        return self.high_s + self.low_s

    @property
    def peak(self) -> Numbers:
        """Amplitude of the PV, zero to peak."""
        peak: Numbers = np.abs(self.after_fall - self.after_rise) / 2.0
        return peak

    @property
    def fundamental(self) -> Numbers:
        """Amplitude of the PV's fundamental, zero to peak: `|G(jw)|` times that of the relay."""
        tests, w = self.tests, 2.0 * math.pi / self.period_s
        gain = np.abs(tests.K) / np.hypot(1.0 - tests.m * w * w, tests.n * w)
        fundamental: Numbers = gain * (tests.high - tests.low) * 2.0 / math.pi * np.sin(w * self.high_s / 2.0)
        return fundamental


def cycle_batch(tests: RelayTests, switches: int = 20) -> CycleBatch:
    """Return the last period of each test.

    Second-order tests that are swept together end when all have settled, after `switches` switches at the latest.
    """
    found = np.full((4, tests.K.size), math.nan)
    usable = tests.usable
    single, rings = tests.m == 0.0, tests.n**2 < 4.0 * tests.m
    for kind, sweep in (
        (single, _first_order),
        (rings, partial(_second_order, ringing, switches)),
        (~single & ~rings, partial(_second_order, creeping, switches)),
    ):
        rows = np.flatnonzero(kind & usable)
        for begin in range(0, rows.size, _AT_ONCE):
            part = _together(rows[begin : begin + _AT_ONCE])
            found[:, part] = sweep(tests.only(part))
    return CycleBatch(tests, *found)


def _together(rows: NDArray[np.intp]) -> NDArray[np.intp] | slice:
    """Return neighbours as a slice, which copies nothing."""
    first, last = int(rows[0]), int(rows[-1])
    return slice(first, last + 1) if last - first == rows.size - 1 else rows


def _first_order(tests: RelayTests) -> Numbers:
    """Return the rows of `CycleBatch`, shape (4, N): every period is the last."""
    (up, down), (y_f, y_r), D, T = tests.ends, tests.thresholds, tests.D, tests.n
    left = np.exp(-D / T)
    top, bottom = up + (y_f - up) * left, down + (y_r - down) * left
    low_s = D + T * np.log((top - down) / (y_r - down))
    high_s = D + T * np.log((bottom - up) / (y_f - up))
    return np.array([high_s, low_s, bottom, top])


def _second_order(
    shape_of: Callable[[Functions[Numbers], Numbers, Numbers], Shape[Numbers]], switches: int, tests: RelayTests
) -> Numbers:
    """Return the rows of `CycleBatch`, shape (4, N); NaN where the PV turns again before a switch arrives."""
    shape = shape_of(ARRAYS, tests.m, tests.n)
    simple = np.ones(tests.K.size, dtype=np.bool_)
    period, rose_s, bottom = np.zeros((4, tests.K.size)), np.zeros(tests.K.size), np.zeros(tests.K.size)
    with np.errstate(all="ignore"):  # a plant that is not simple may end in anything, which is not used
        course = swings(ARRAYS, shape, tests.D, tests.ends, tests.thresholds, _back_at)
        for _ in range(switches // 2):
            before, began_s, lowest = period, rose_s, bottom
            fell_s, high_tau_s, top = next(course)
            rose_s, low_tau_s, bottom = next(course)
            simple &= np.maximum(high_tau_s, low_tau_s) + tests.D < shape.turns_again_s
            period = np.array([fell_s - began_s, rose_s - fell_s, lowest, top])
            if np.all((np.abs(period - before)[:2] <= _SETTLED * period[:2]) | ~simple):
                break
    period[:, ~simple] = math.nan
    return period


def _back_at(shape: Shape[Numbers], share: Numbers, start_s: Numbers) -> Numbers:
    """Return `tau` with `g(tau) = share`, by Halley's method on its side of the steepest point."""
    within, late = share < 1.0, share <= shape.steepest_share
    low, high = np.where(late, shape.steepest_s, 0.0), np.where(late, math.inf, shape.steepest_s)
    tau = np.where(start_s > 0.0, start_s, shape.steepest_s)
    for _ in range(_MOST_STEPS):
        c, o = shape.motion(tau)
        step = (c + shape.s * o - share) / (shape.stiffness * o)
        step /= np.maximum(1.0 + step * (c / o - shape.s) / 2.0, 0.5)
        tau = np.clip(tau + step, low, high)
        if not np.any((np.abs(step) > _CLOSE * tau) & within):
            break
    return np.where(within, tau, 0.0)
