"""Relay tests of thousands of plants at once, in closed form.

    plants   K e^{-Ds}/(m s^2 + n s + 1),   m = 0 for a single lag

The relay of each plant starts from rest, where the PV is 0, at its high level, or at the low one where rest is beyond
the first threshold; it acts in the direction of the plant's gain. A plant without dead time, or whose PV does not go to
and fro, gets NaN. Most plants go from swing to swing (`batch_swings`), those whose PV passes the next threshold before
a switch has arrived from turn to turn (`batch_pending`).

`K` PV/output, `D`, `n`, times s, `m` s^2, levels in output units, `reference` and `hysteresis` PV.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from autotuner_sim.batch_motion import Creeping, Ringing
from autotuner_sim.batch_pending import pending_batch
from autotuner_sim.batch_swings import Sweep
from autotuner_sim.swings import ARRAYS, creeping, ringing, swings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import ArrayLike

    from autotuner_sim.swings import Functions, Shape

Numbers = NDArray[np.float64]
Pair = tuple[Numbers, Numbers]
Rows = NDArray[np.intp]

_CLOSE = 1e-5
"""Relative step of the third-order iteration after which the next would be rounding."""
_MOST_STEPS = 60
_AT_ONCE, _AT_ONCE_OF_FIRST_ORDER = 20_000, 5_000
"""Most plants in one sweep: with more of them, their arrays leave the processor's cache. A sweep of second order makes
many calls of NumPy, whose own cost more plants share; one of first order makes few."""
_KEPT = 500_000
"""Size of an array, in numbers, that stands for what a sweep takes of memory again and again."""


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

    def only(self, rows: Rows | slice) -> RelayTests:
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
    def even(self) -> NDArray[np.bool_]:
        """Whether a rise is a fall upside down."""
        (up, down), (ahead, back) = self.ends, self.thresholds
        even: NDArray[np.bool_] = back - down == up - ahead
        return even

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Whether each level leads across its threshold."""
        # by the plant's sign: K (up - ahead) > 0 and so on
        K, (up, down), (ahead, back) = self.K, self.ends, self.thresholds
        leads = (K * (up - ahead) > 0.0) & (K * (down - back) < 0.0)
        usable: NDArray[np.bool_] = leads & (self.D > 0.0)
        return usable

    @property
    def rest_is_beyond(self) -> NDArray[np.bool_]:
        """Whether the PV at rest is beyond the threshold at which the high level ends."""
        return self.K * self.thresholds[0] < 0.0

    @property
    def mirrored(self) -> RelayTests:
        """The same tests with the output counted downwards: the low level is the high one."""
        return self._replace(K=-self.K, low=-self.high, high=-self.low)


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
        Furthest PV after the rise of the relay, and after its fall.
    turns_once : array of bool, shape (N,)
        Whether no turn of the PV came before the arrival of the switch before.
    """

    tests: RelayTests
    high_s: Numbers
    low_s: Numbers
    after_rise: Numbers
    after_fall: Numbers
    turns_once: NDArray[np.bool_]

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
    """Return the last period of each test of `switches` switches, 4 at least."""
    beyond = np.flatnonzero(tests.rest_is_beyond)
    if not beyond.size:
        return _batch(tests, _from_the_high_level(tests, switches))
    columns = [column.copy() for column in tests]
    for column, values in zip(columns, tests.only(beyond).mirrored, strict=True):
        column[beyond] = values
    found = _from_the_high_level(RelayTests(*columns), switches)
    found[:4, beyond] = found[:4, beyond][[1, 0, 3, 2]]
    return _batch(tests, found)


def _batch(tests: RelayTests, found: Numbers) -> CycleBatch:
    high_s, low_s, after_rise, after_fall, once = found
    return CycleBatch(tests, high_s, low_s, after_rise, after_fall, once > 0.0)


def _from_the_high_level(tests: RelayTests, switches: int) -> Numbers:
    """Return the rows of `CycleBatch`, shape (5, N)."""
    np.empty(_KEPT)  # the C library gives memory back, and gets it anew, up to the largest piece it has had back
    found = np.full((5, tests.K.size), math.nan)
    usable, single = np.empty(tests.K.size, dtype=np.bool_), tests.m == 0.0
    for part in _parts(np.arange(tests.K.size), _AT_ONCE_OF_FIRST_ORDER):
        usable[part] = tests.only(part).usable
    with np.errstate(all="ignore"):  # a plant that is not simple may end in anything, which is not used
        _sweep(_first_order, tests, np.flatnonzero(usable & single), found, _AT_ONCE_OF_FIRST_ORDER)
        if single.all():
            return found
        rings = tests.n**2 < 4.0 * tests.m
        for kind, of_kind in ((Ringing, rings), (Creeping, ~rings)):
            rows = usable & ~single & of_kind
            for even in (True, False):
                some = np.flatnonzero(rows & (tests.even == even))
                _sweep(partial(_second_order, kind, switches), tests, some, found)
        left = np.flatnonzero(rings & np.isnan(found[0]) & (tests.D > 0.0))
        _sweep(partial(_several, switches), tests, left, found)
    return found


def _sweep(
    of: Callable[[RelayTests], Numbers | tuple[Numbers, ...]],
    tests: RelayTests,
    rows: Rows,
    found: Numbers,
    most: int = _AT_ONCE,
) -> None:
    """Fill in the columns of `found` that belong to some of the tests, so many of them at once at most."""
    for part in _parts(rows, most):
        for line, values in zip(found, of(tests.only(part)), strict=True):
            line[part] = values


def _parts(rows: Rows, most: int) -> Iterator[Rows | slice]:
    """Yield tests in parts of about the same size; neighbours as a slice, which copies nothing."""
    for part in np.array_split(rows, math.ceil(rows.size / most)) if rows.size else ():
        first, last = int(part[0]), int(part[-1])
        yield slice(first, last + 1) if last - first == part.size - 1 else part


def _first_order(tests: RelayTests) -> tuple[Numbers, ...]:
    """Return the rows of `CycleBatch`: every period is the last."""
    (up, down), (y_f, y_r), D, T = tests.ends, tests.thresholds, tests.D, tests.n
    left = np.exp(-D / T)
    to_up, to_down = y_f - up, y_r - down
    top, bottom = to_up * left, to_down * left
    top += up
    bottom += down
    low_s = (top - down) / to_down
    high_s = (bottom - up) / to_up
    return _lasts(high_s, T, D), _lasts(low_s, T, D), bottom, top, np.ones(T.size)


def _lasts(ratio: Numbers, T: Numbers, D: Numbers) -> Numbers:
    """Return `D + T ln(ratio)`, s, in place of the ratio."""
    np.log(ratio, out=ratio)
    ratio *= T
    ratio += D
    return ratio


def _second_order(kind: type[Creeping | Ringing], switches: int, tests: RelayTests) -> Numbers:
    """Return the rows of `CycleBatch`, shape (5, N); NaN where the PV may pass a threshold before a switch arrives."""
    sweep = Sweep(tests, kind)
    period = sweep.run(switches)
    rows = np.flatnonzero(sweep.doubtful & sweep.simple)
    if rows.size:
        period[:, rows] = _swing_by_swing(_SHAPES[kind], switches, tests.only(rows))
        sweep.once[rows] = True
    return np.vstack((period, sweep.once & np.isfinite(period[0])))


def _several(switches: int, tests: RelayTests) -> Numbers:
    """Return the rows of `CycleBatch`, shape (5, N), of plants whose PV turns more than once."""
    return np.vstack((pending_batch(tests, switches), np.zeros(tests.K.size)))


def _swing_by_swing(
    shape_of: Callable[[Functions[Numbers], Numbers, Numbers], Shape[Numbers]], switches: int, tests: RelayTests
) -> Numbers:
    """Return the same from nothing but the swings themselves, each solved from anywhere."""
    shape = shape_of(ARRAYS, tests.m, tests.n)
    simple = np.ones(tests.K.size, dtype=np.bool_)
    period, rose_s, bottom = np.zeros((4, tests.K.size)), np.zeros(tests.K.size), np.zeros(tests.K.size)
    course = swings(ARRAYS, shape, tests.D, tests.ends, tests.thresholds, _back_at)
    for _ in range(switches // 2):
        began_s, lowest = rose_s, bottom
        fell_s, high_tau_s, top = next(course)
        rose_s, low_tau_s, bottom = next(course)
        simple &= np.maximum(high_tau_s, low_tau_s) + tests.D < shape.turns_again_s
        period = np.array([fell_s - began_s, rose_s - fell_s, lowest, top])
    period[:, ~simple] = math.nan
    return period


_SHAPES = {Creeping: creeping, Ringing: ringing}


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
