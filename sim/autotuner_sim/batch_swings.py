"""The last period of thousands of second-order relay tests at once, as long as one switch at a time is on its way.

The slopes `x_k` at the switches that begin a turn (two swings, or one where the relay is symmetric) follow a smooth map
`x_{k+1} = F(x_k)`. Near its fixed point, `r = F'`,

    x_k = x + b r^k + c r^{2k} + ...,   d_k = x_k - x_{k-1}
    d_k - (r + r^2) d_{k-1} + r^3 d_{k-2} = 0   gives r
    x_{k+n} = x_k + B r (1 - r^n)/(1 - r) + C r^2 (1 - r^{2n})/(1 - r^2)
    B = (d_k - r^2 d_{k-1})/(1 - r),   C = -r (d_k - r d_{k-1})/(1 - r)

Tests whose changes have become so small that the next term is rounding skip what is left of them; the last two swings
are solved for by all (`batch_course`).

The times and the first passages are those of all swings: both `v^2 + 2 zeta z v + z^2` and how soon the PV comes back
before an arrival grow with the slope at which it passed, so that the steepest passage decides for all of a test.
What leaves its branch is said to be in doubt, and somebody slower has to look.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from autotuner_sim.batch_course import Course, Rows, new_side, turn
from autotuner_sim.batch_motion import Creeping, Ringing

if TYPE_CHECKING:
    from autotuner_sim.batch import RelayTests

Numbers = NDArray[np.float64]
Truths = NDArray[np.bool_]

_SETTLING = 1e-5
"""Change of a slope from turn to turn, relative to it, whose third power is rounding."""
_FIRST_LOOK = 6
"""Turns after which to look whether tests have settled; then after twice as many."""
_COPIES = 12
"""How many turns copies of what is known of the tests take."""
_ROOTS = 3
"""Steps to `r`: each leaves of its error about the relative change."""
_STEEPEST = 0.85
"""Quotient of two changes from which on a test does not settle."""
_TINY = 1e-60


class Sweep:
    """Tests that go on together.

    Attributes
    ----------
    simple : array of bool
        The PV did not pass the next threshold before a switch arrived, as far as that is known at a glance.
    once : array of bool
        The PV did not turn before a switch arrived.
    doubtful : array of bool
        A swing was not found, or one on another branch.
    """

    def __init__(self, tests: RelayTests, kind: type[Creeping | Ringing]) -> None:
        self._w0 = 1.0 / np.sqrt(tests.m)
        self._D = tests.D * self._w0
        self._free = kind(0.5 * tests.n * self._w0)
        (self._up, self._down), (ahead, back) = tests.ends, tests.thresholds
        self._gap = self._up - self._down
        self._rest = self._up / self._gap
        zeta = self._free.zeta
        c, o = self._free.motion(self._D)
        left, kept = c + zeta * o, c - zeta * o
        to, passed = (back - self._down) / self._gap, (self._up - ahead) / self._gap
        sides = [new_side(to, passed, left, o), new_side(passed, to, left, o)]
        self._course = Course(self._free, o, kept, sides[: 1 if np.array_equal(to, passed) else 2])
        self._again, self._shrinks = (np.broadcast_to(x, self._D.shape) for x in (self._free.again, self._free.shrinks))
        self._lively = self._may_come_back()
        self.simple: Truths = np.ones(self._D.size, dtype=np.bool_)
        self.once, self.doubtful = self.simple.copy(), ~self.simple

    def run(self, switches: int) -> Numbers:
        """Return the last period, as the rows of `CycleBatch`, shape (4, N); NaN where the test is not simple."""
        last = self._last_swings(switches // 2 * 2 - 4)
        for k in range(len(self._course.sides)):
            self._judge(k, *last[4 + 4 * k : 8 + 4 * k])
        high, low, rises, falls = last[:4]
        bottom = self._up - self._gap * self._furthest(-1, rises)
        top = self._down + self._gap * self._furthest(0, falls)
        period = np.array([(high + self._D) / self._w0, (low + self._D) / self._w0, bottom, top])
        period[:, ~self.simple] = math.nan
        return period

    def _last_swings(self, before: int) -> Numbers:
        """Return what `_three_swings` says of each test, so many swings after the first switch."""
        course, rows, turns = self._course, np.arange(self._D.size), before // len(self._course.sides)
        last, looks = np.empty((4 + 4 * len(course.sides), rows.size)), _FIRST_LOOK
        xs = [course.rise_from(self._rest)]
        for k in range(1, turns):
            xs = [*xs[-3:], course.turn_over(xs[-1])]
            if k < looks:
                continue
            looks *= 2
            done, left = self._parted(rows, course, xs, turns - k)
            if done.size:
                last[:, rows[done]] = _three_swings(course.only(done), _skip([x[done] for x in xs], turns - k))
                course, rows, xs = course.only(left), rows[left], [x[left] for x in xs]
            if not left.size:
                return last
        if turns:
            xs.append(course.turn_over(xs[-1]))
        last[:, rows] = _three_swings(course, xs[-1])
        return last

    def _parted(self, rows: Rows, course: Course, xs: list[Numbers], turns: int) -> tuple[Rows, Rows]:
        """Return which tests need not go on and which must; none and all where copies of them would take longer."""
        leave = _have_settled(xs)
        if turns > _COPIES:
            leave |= self._come_back(rows, course)
        done = np.flatnonzero(leave)
        if done.size == rows.size or done.size * turns > _COPIES * rows.size:
            return done, np.flatnonzero(~leave)
        return done[:0], np.arange(rows.size)

    def _judge(self, k: int, least: Numbers, most: Numbers, early: Numbers, late: Numbers) -> None:
        """Take down what the flattest and the steepest passage say of all swings after switch `k`, 0 a fall."""
        self.doubtful |= ~(least >= 0.0)
        if not isinstance(self._free, Ringing):
            return
        side = self._course.sides[k]
        away = (self._course.arrive(side, least)[1] > 0.0) & (self._course.arrive(side, most)[1] > 0.0)
        self.once &= away & (self._again > self._D)
        self.doubtful |= ~((early > 0.0) & (late < self._again * (1.0 + away)))
        rows = np.flatnonzero(self._lively)
        self.simple[rows] &= self._stay(rows, side.passed[rows], side.to[rows], most[rows])

    def _may_come_back(self) -> Truths:
        """Return the tests whose PV may come back to a threshold in time: overshoots sum up to a geometric series."""
        farthest = np.maximum(1.0, np.abs(self._rest)) * self._shrinks / (1.0 - self._shrinks)
        nearest = np.min([np.abs(1.0 - side.to) for side in self._course.sides], axis=0)
        lively: Truths = nearest / self._shrinks <= farthest
        return lively

    def _come_back(self, rows: Rows, course: Course) -> Truths:
        """Return which of the tests of a course have come back to a threshold before a switch arrived."""
        come = np.zeros(rows.size, dtype=np.bool_)
        some = np.flatnonzero(self._lively[rows])
        for side in course.sides if some.size else ():
            come[some] |= ~self._stay(rows[some], side.passed[some], side.to[some], side.most[some])
        return come

    def _stay(self, rows: Rows, passed: Numbers, to: Numbers, v: Numbers) -> Truths:
        """Return whether the next threshold is out of reach before a switch passed with slope `v` arrives."""
        reach = ((1.0 - to) / self._shrinks[rows]) ** 2
        zeta = self._free.zeta[rows]
        stay: Truths = v * v - passed * (2.0 * zeta * v - passed) < reach
        some = np.flatnonzero(~stay)
        if some.size and isinstance(self._free, Ringing):
            rows = rows[some]
            free = self._free.only(rows)
            wait, turn = free.first_turn(-passed[some], v[some])
            back = wait + free.again - free.turn(1.0 / free.zeta)  # at the level, which is before the threshold
            stay[some] = (turn * turn < reach[some]) | (back > self._D[rows])
        return stay

    def _furthest(self, k: int, v: Numbers) -> Numbers:
        """Return the furthest `z` after switch `k`, passed with slope `v`."""
        course = self._course
        side = course.sides[k]
        furthest = turn(self._free, *course.arrive(side, v))[1]
        if isinstance(self._free, Ringing):
            rows = np.flatnonzero(~self.once)
            wait, z = self._free.only(rows).first_turn(-side.passed[rows], v[rows])
            before = wait <= self._D[rows]
            furthest[rows[before]] = 1.0 + z[before]
        return furthest


def _three_swings(course: Course, x: Numbers) -> Numbers:
    """Go three swings.

    Return the times of the last two, the slopes that these begin with, and for each side the least and the greatest
    slope and time of all swings, shape (8 or 12, N).
    """
    fall, rise = course.sides[0], course.sides[-1]
    at_rise = course.go_on(fall, x)
    at_fall, high = course.exactly(rise, at_rise)
    end, low = course.exactly(fall, at_fall)
    np.minimum(rise.least, end, out=rise.least)
    hulls = [row for side in course.sides for row in (side.least, side.most, side.early, side.late)]
    return np.array([high, low, at_rise, at_fall, *hulls])


def _have_settled(xs: list[Numbers]) -> Truths:
    """Return the tests that change so little that two terms of what is left are all; also those that are lost."""
    room = _STEEPEST - np.abs(_ratio(xs))
    room *= room
    room *= xs[-1]
    room *= _SETTLING
    settled: Truths = ~(np.abs(xs[-1] - xs[-2]) > room)
    return settled


def _ratio(xs: list[Numbers]) -> Numbers:
    """Return the quotient of the last two changes."""
    change, before = xs[-1] - xs[-2], xs[-2] - xs[-3]
    change *= before
    before *= before
    before += _TINY
    change /= before
    return np.clip(change, -_STEEPEST, _STEEPEST, out=change)


def _skip(xs: list[Numbers], turns: int) -> Numbers:
    """Return the slopes so many turns later."""
    r = _ratio(xs)
    last, before, first = xs[-1] - xs[-2], xs[-2] - xs[-3], xs[-3] - xs[-4]
    for _ in range(_ROOTS):
        missing = last - r * ((1.0 + r) * before - r * r * first)
        r += np.divide(missing, (1.0 - r) * before, out=np.zeros_like(r), where=before != 0.0)
        np.clip(r, -_STEEPEST, _STEEPEST, out=r)
    rest, square = r**turns, r * r
    slow = (last - square * before) * r * (1.0 - rest)
    fast = (r * before - last) * r * square * (1.0 - rest * rest) / (1.0 - square)
    slow /= 1.0 - r
    slow += fast
    slow /= 1.0 - r
    slow += xs[-1]
    return slow
