"""Relay tests of many ringing plants at once, however many switches are on their way: `quick_pending` on arrays.

All tests go from arrival to arrival together: between two of them the PV rings around one level, and what differs from
test to test is only in how many pieces between two turns it does so, and which of them hold switches. Time in units of
`1/w0`.

Rule of this file: an operation on all tests where all need it, and on the rows that need it elsewhere.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from autotuner_sim.batch import RelayTests

Numbers = NDArray[np.float64]
Rows = NDArray[np.intp]

_SHORT = 2e-4
"""Step, relative to the time in which the slope changes, whose fourth power is rounding."""
_MEDIUM = 0.2
"""Step from which on the series is better than Halley's method."""
_MOST_STEPS = 80


def pending_batch(tests: RelayTests, switches: int) -> Numbers:
    """Return the rows of `CycleBatch`, shape (4, N), of plants with complex poles; NaN where the PV comes to rest."""
    courses = _Courses(tests, switches // 2 * 2)
    for arrival in range(courses.switches):
        courses.arrive(arrival)
    return courses.last_period()


class _Courses:
    """Tests as far as they are known.

    `z`, `v` is the state after the arrival at `begun`; the next turn of the PV is `turn`, at `turned`; `way` is where
    the PV has to go next to pass a threshold. `count` switches are known by the turns before them, `since`, the share
    of these that is left at them, and `turns`, the furthest PV since the switch before; `times` follow from that.
    """

    def __init__(self, tests: RelayTests, switches: int) -> None:
        self.w0 = 1.0 / np.sqrt(tests.m)
        self.zeta = 0.5 * tests.n * self.w0
        self.d = np.sqrt(1.0 - self.zeta**2)
        self.again = math.pi / self.d
        self.shrinks = np.exp(-self.zeta * self.again)
        self.D, self.ends, self.thresholds = tests.D * self.w0, np.array(tests.ends), np.array(tests.thresholds)
        size = self.D.size
        self.switches, self.count, self.way = switches, np.zeros(size, dtype=np.intp), np.sign(tests.K)
        self.since, self.shares, self.turns, self.times = np.full((4, switches, size), math.nan)
        self.z, self.v, self.begun, self.furthest = -self.ends[0], np.zeros(size), self.D, np.zeros(size)
        steepest = np.arctan2(self.d, self.zeta) / self.d
        self.known = [(steepest, np.zeros(size), np.full(size, math.inf))] * 2

    def arrive(self, arrival: int) -> None:
        """Go on from an arrival to the next, which is that of the switch of the same number."""
        unfinished = self.count < self.switches
        if unfinished.any():
            self._find_turn()
            self._await(np.flatnonzero(unfinished & (self.count == arrival)), arrival)
        self.times[arrival] = self.since[arrival] + self._after_turn(self.shares[arrival], arrival % 2)
        if unfinished.any():
            until = self.times[arrival] + self.D
            z, self.v = self._move(until - self.begun)
            self._pass(np.flatnonzero(self.count < self.switches), arrival, until, z)
            self.z, self.begun = z + self.ends[arrival % 2] - self.ends[1 - arrival % 2], until

    def _await(self, rows: Rows, arrival: int) -> None:
        """Go on to the next switch, with none on its way; it is in the next piece that goes the right way, or never."""
        wrong = rows[self.turn[rows] * self.way[rows] <= 0.0]
        self._go_past(wrong, arrival)
        to, turn, way = self._to(rows, arrival), self.turn[rows], self.way[rows]
        crosses = (turn - to) * way > 0.0
        self._switch(rows[crosses], to[crosses])
        self.count[rows[~crosses]] = self.switches

    def _pass(self, rows: Rows, arrival: int, until: Numbers, at_end: Numbers) -> None:
        """Go through the pieces between turns to the end of the span."""
        while rows.size:
            turn, way, to = self.turn[rows], self.way[rows], self._to(rows, arrival)
            whole = self.turned[rows] <= until[rows]
            crosses = (turn * way > 0.0) & (way * (np.where(whole, turn, at_end[rows]) - to) > 0.0)
            self._switch(rows[crosses], to[crosses])
            rows = rows[whole]
            rows = rows[self.count[rows] < self.switches]
            self._go_past(rows, arrival)

    def _to(self, rows: Rows, arrival: int) -> Numbers:
        """Return where the next threshold is."""
        to: Numbers = self.thresholds[self.count[rows] % 2, rows] - self.ends[arrival % 2, rows]
        return to

    def _switch(self, rows: Rows, to: Numbers) -> None:
        """Take down a switch in the piece that ends with the next turn."""
        count = self.count[rows]
        self.since[count, rows] = self.turned[rows] - self.again[rows]
        self.shares[count, rows] = -to * self.shrinks[rows] / self.turn[rows]
        self.turns[count, rows] = self.furthest[rows]
        self.count[rows] += 1
        way = -self.way[rows]
        self.way[rows], self.furthest[rows] = way, way * math.inf

    def _go_past(self, rows: Rows, arrival: int) -> None:
        """Go past a turn."""
        way, turn = self.way[rows], self.turn[rows]
        at = self.ends[arrival % 2, rows] + turn
        self.furthest[rows] = np.minimum(way * self.furthest[rows], way * at) * way
        self.turned[rows] += self.again[rows]
        self.turn[rows] = -turn * self.shrinks[rows]

    def _find_turn(self) -> None:
        """Find the next turn after an arrival."""
        zeta, z, v = self.zeta, self.z, self.v
        angle = np.arctan2(self.d * v, zeta * v + z)
        wait = np.where(v > 0.0, angle, angle + math.pi) / self.d
        turn = np.copysign(np.sqrt(z * (z + 2.0 * zeta * v) + v * v), v) * np.exp(-zeta * wait)
        still = v == 0.0
        self.turned, self.turn = self.begun + np.where(still, 0.0, wait), np.where(still, z, turn)

    def _move(self, t: Numbers) -> tuple[Numbers, Numbers]:
        """Return the state after `t`."""
        c, o = _motion(self.zeta, self.d, t)
        o_zeta = o * self.zeta
        return (c + o_zeta) * self.z + o * self.v, (c - o_zeta) * self.v - o * self.z

    def _after_turn(self, share: Numbers, position: int) -> Numbers:
        """Return the inverse of `g`; it begins where it was for the same position before."""
        known, before, slope = self.known[position]
        t = known + (before - share) / slope
        found, o, left = np.where(share >= 1.0, 0.0, math.nan), slope.copy(), np.flatnonzero(share < 1.0)
        columns = tuple(column[left] for column in (share, self.zeta, self.d, np.zeros(t.size), self.again, t))
        for _ in range(_MOST_STEPS):
            if not left.size:
                break
            to, zeta, d, low, high, t = columns
            t = np.where((low < t) & (t < high), t, 0.5 * (low + high))
            past, o[left], h, bend = _step(zeta, d, to, t)
            found[left] = t + h
            again = bend >= _SHORT
            left, high, low = left[again], np.where(past > 0.0, high, t), np.where(past > 0.0, t, low)
            columns = tuple(column[again] for column in (to, zeta, d, low, high, t + h))
        self.known[position] = found, share, o
        return found

    def last_period(self) -> Numbers:
        """Return the rows of `CycleBatch`."""
        times, turns, w0 = self.times, self.turns, self.w0
        return np.array([(times[-2] - times[-3]) / w0, (times[-1] - times[-2]) / w0, turns[-2], turns[-1]])


def _motion(zeta: Numbers, d: Numbers, t: Numbers) -> tuple[Numbers, Numbers]:
    """Return `c` and `o`."""
    decay, angle = np.exp(-zeta * t), d * t
    return decay * np.cos(angle), decay * np.sin(angle) / d


def _step(zeta: Numbers, d: Numbers, to: Numbers, t: Numbers) -> tuple[Numbers, Numbers, Numbers, Numbers]:
    """Return, at `t`, `g - to`, `o`, the step to where `g` is `to`, and how much the slope changes on it."""
    c, o = _motion(zeta, d, t)
    twice = 2.0 * zeta
    at = c + zeta * o
    past = at - to
    u, a = -past / o, twice - at / o
    h = u * (u * (0.5 * a - u * (0.5 * a * a - (twice * a - 1.0) / 6.0)) - 1.0)
    bend = (np.abs(a) + 1.0) * np.abs(h)
    far = bend > _MEDIUM
    if far.any():
        h = np.where(far, -u / np.maximum(1.0 + 0.5 * a * u, 0.5), h)
    return past, o, h, bend
