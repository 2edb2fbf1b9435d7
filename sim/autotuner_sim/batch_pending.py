"""Relay tests of many ringing plants at once, however many switches are on their way: `quick_pending` on arrays.

All tests go from arrival to arrival together: between two of them the PV rings around one level, and what differs from
test to test is only in how many pieces between two turns it does so, and which of them hold switches. Time in units of
`1/w0`.

Rule of this file: these tests are few beside those of `batch_swings`, and a call of NumPy takes longer than its work:
an operation is on all tests, or for some of them in few calls.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from autotuner_sim.batch_motion import Ringing

if TYPE_CHECKING:
    from autotuner_sim.batch import RelayTests

Numbers = NDArray[np.float64]
Rows = NDArray[np.intp]
Truths = NDArray[np.bool_]
Place = tuple[Numbers, Numbers, Numbers]

_SHORT = 2e-4
"""Step, relative to the time in which the slope changes, whose fourth power is rounding."""
_MEDIUM = 0.2
"""Step from which on the series is better than Halley's method."""
_QUICK_STEPS = 5
_MOST_STEPS = 80


def pending_batch(tests: RelayTests, switches: int) -> Numbers:
    """Return the rows of `CycleBatch`, shape (4, N), of plants with complex poles; NaN where the PV comes to rest."""
    courses = _Courses(tests, switches // 2 * 2)
    for arrival in range(courses.switches):
        courses.arrive(arrival)
    return courses.last_period()


class _Courses:
    """Tests as far as they are known.

    `z`, `v` is the state after the arrival at `begun`; the next turn of the PV is `turn`, at `turned`. To pass the next
    threshold, `aim`, the PV has to go `way`; `nearest` is the furthest PV since the switch before, times `way`. `count`
    switches are known by those four as they were in the piece of the switch (`log`, with `z` at the threshold for
    `aim`); `times` follow from that.
    """

    def __init__(self, tests: RelayTests, switches: int) -> None:
        self.w0 = 1.0 / np.sqrt(tests.m)
        self.zeta = 0.5 * tests.n * self.w0
        self.twice, self.free = 2.0 * self.zeta, Ringing(self.zeta)
        self.d = np.sqrt(1.0 - self.zeta**2)
        self.again = math.pi / self.d
        self.earliest = 1e-3 * self.again
        self.shrinks = np.exp(-self.zeta * self.again)
        self.D, self.ends, thresholds = tests.D * self.w0, np.array(tests.ends), np.array(tests.thresholds)
        size = self.D.size
        self.switches, self.count, self.way = switches, np.zeros(size, dtype=np.intp), np.sign(tests.K)
        self.aim, self.both = thresholds[0].copy(), thresholds[0] + thresholds[1]
        self.log, self.times = np.full((4, switches, size), math.nan), np.full((switches, size), math.nan)
        self.piece = np.zeros((4, size))
        self.turned, self.turn, self.to, self.nearest = self.piece
        self.z, self.v, self.begun = -self.ends[0], np.zeros(size), self.D
        steepest = np.arctan2(self.d, self.zeta) / self.d
        self.known = [self._at(steepest)] * 2

    def arrive(self, arrival: int) -> None:
        """Go on from an arrival to the next, which is that of the switch of the same number."""
        going = self.count < self.switches
        if going.any():
            self._find_turn()
            waits = np.flatnonzero(going & (self.count == arrival))
            if waits.size:
                self._await(waits, arrival)
        turned, turn, to, _ = self.log[:, arrival]
        self.times[arrival] = turned - self.again + self._after_turn(-to * self.shrinks / turn, arrival % 2)
        if going.any():
            until, end = self.times[arrival] + self.D, self.ends[arrival % 2]
            z, self.v = self._move(until - self.begun)
            self._pass(end, until, z)
            z += end
            z -= self.ends[1 - arrival % 2]
            self.z, self.begun = z, until

    def _await(self, rows: Rows, arrival: int) -> None:
        """Go on to the next switch, with none on its way; it is in the next piece that goes the right way, or never."""
        end = self.ends[arrival % 2]
        wrong = np.zeros(self.D.size, dtype=np.bool_)
        wrong[rows] = self.turn[rows] * self.way[rows] <= 0.0
        self._go_past(wrong, end)
        np.subtract(self.aim, end, out=self.to)
        crosses = (self.turn[rows] - self.to[rows]) * self.way[rows] > 0.0
        self._switch(rows[crosses])
        self.count[rows[~crosses]] = self.switches

    def _pass(self, end: Numbers, until: Numbers, at_end: Numbers) -> None:
        """Go through the pieces between turns to the end of the span."""
        going = self.count < self.switches
        while True:
            whole = self.turned <= until
            reach = np.where(whole, self.turn, at_end)
            np.subtract(self.aim, end, out=self.to)
            reach -= self.to
            reach *= self.way
            crosses = reach > 0.0
            crosses &= self.turn * self.way > 0.0
            crosses &= going
            rows = crosses.nonzero()[0]
            if rows.size:
                self._switch(rows)
                going &= self.count < self.switches
            going &= whole
            if not going.any():
                return
            self._go_past(going, end)

    def _switch(self, rows: Rows) -> None:
        """Take down a switch in the piece that ends with the next turn."""
        count, way = self.count[rows], -self.way[rows]
        self.log[:, count, rows] = self.piece[:, rows]
        self.count[rows] = count + 1
        self.way[rows] = way
        self.aim[rows] = self.both[rows] - self.aim[rows]
        self.nearest[rows] = math.inf

    def _go_past(self, rows: Truths, end: Numbers) -> None:
        """Go past a turn."""
        np.minimum(self.nearest, (self.turn + end) * self.way, out=self.nearest, where=rows)
        np.add(self.turned, self.again, out=self.turned, where=rows)
        np.multiply(self.turn, -self.shrinks, out=self.turn, where=rows)

    def _find_turn(self) -> None:
        """Find the next turn after an arrival."""
        zeta, z, v = self.zeta, self.z, self.v
        inertia = zeta * v
        inertia += z
        wait = np.arctan2(self.d * v, inertia)
        wait += math.pi * (v <= 0.0)
        wait /= self.d
        inertia += zeta * v
        inertia *= z
        inertia += v * v
        np.sqrt(inertia, out=inertia)
        inertia *= np.exp(-zeta * wait)
        still = v == 0.0  # from rest
        np.add(self.begun, wait, out=self.turned)
        np.copysign(inertia, v, out=self.turn)
        np.copyto(self.turned, self.begun, where=still)
        np.copyto(self.turn, z, where=still)

    def _move(self, t: Numbers) -> tuple[Numbers, Numbers]:
        """Return the state after `t`."""
        c, o = self.free.motion(t)
        o_zeta = o * self.zeta
        return (c + o_zeta) * self.z + o * self.v, (c - o_zeta) * self.v - o * self.z

    def _at(self, t: Numbers) -> Place:
        """Return `t`, and `g` and `o` there."""
        c, o = self.free.motion(t)
        c += self.zeta * o
        return t, c, o

    def _after_turn(self, share: Numbers, position: int) -> Numbers:
        """Return the inverse of `g`; it begins where it was for the same position before."""
        within = share < 1.0
        found, near = self._nearer(self.known[position], share)
        for _ in range(_QUICK_STEPS):
            place = self._at(np.minimum(np.maximum(found, self.earliest), self.again))
            found, near = self._nearer(place, share)
            if not (within > near).any():
                break
        else:
            place, found = self._between(share, found, near)
        self.known[position] = place
        return np.where(within, found, np.where(share >= 1.0, 0.0, math.nan))

    def _between(self, share: Numbers, found: Numbers, near: Truths) -> tuple[Place, Numbers]:
        """Go on to the inverse of `g` between bounds, which converges from anywhere."""
        low, high = np.zeros(share.size), self.again
        for _ in range(_MOST_STEPS):
            t = np.where(near | ((low < found) & (found < high)), found, 0.5 * (low + high))
            place = self._at(t)
            found, near = self._nearer(place, share)
            if not ((share < 1.0) > near).any():
                break
            late = place[1] < share
            low, high = np.where(late, low, t), np.where(late, t, high)
        return place, found

    def _nearer(self, place: Place, share: Numbers) -> tuple[Numbers, Truths]:
        """Return about where `g` is `share`, and whether that is as exact as can be."""
        t, at, o = place
        u, twice = (share - at) / o, self.twice
        a = twice - at / o
        h = u * (u * (0.5 * a - u * (0.5 * a * a - (twice * a - 1.0) / 6.0)) - 1.0)
        bend = (np.abs(a) + 1.0) * np.abs(h)
        far = bend > _MEDIUM
        if far.any():
            h = np.where(far, -u / np.maximum(1.0 + 0.5 * a * u, 0.5), h)
        return t + h, bend < _SHORT

    def last_period(self) -> Numbers:
        """Return the rows of `CycleBatch`."""
        times, w0, way = self.times, self.w0, np.sign(self.way)
        turns = self.log[3] * way
        return np.array([(times[-2] - times[-3]) / w0, (times[-1] - times[-2]) / w0, turns[-2], -turns[-1]])
