"""The swings of thousands of second-order relay tests at once, each from the same swing one period before.

Time in units of `1/w0`, `w0^2 = 1/m`, so that `z'' + 2 zeta z' + z = 0` for the distance `z` of the PV from where it is
heading, and with `d^2 = zeta^2 - 1`

    z(t) = (c + zeta o) z0 + o v0,   c = e^{-zeta t} cosh dt
    v(t) = (c - zeta o) v0 - o z0,   o = e^{-zeta t} sinh(dt)/d

A switch finds the PV at its threshold: its slope `v` there is the whole state, and time and slope of the next switch
are functions of it. Their derivatives at the swing one period before tell about when it comes. There `z` and `v` are
taken exactly, and what is left of the way, `u = (threshold - z)/v`, gives the time `h` by three terms of its series:

    h = u + a/2 u^2 + (a^2/2 - J/6) u^3,   a = 2 zeta + z/v,   J = 2 zeta a - 1     (-a = z''/v, J = z'''/v)

Where `h` is not short, that is done again for those tests alone. Tests in which the changes from period to period have
become small and shrink by the same ratio for ever end there.

Rules of this file: a sweep holds tests of like dead time in units of `1/w0`, which settle about equally fast; what
leaves its branch is said to be in doubt, and somebody slower has to look.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from autotuner_sim.batch_motion import Creeping, Free, Ringing

if TYPE_CHECKING:
    from autotuner_sim.batch import RelayTests

Numbers = NDArray[np.float64]
Truths = NDArray[np.bool_]

_SHORT = 2e-4
"""Step, in the faster of `1/w0` and the fast time constant, whose fourth power is rounding."""
_STEPS = 30
_GUESSES = 2
_MANY = 0.35
"""Share of the tests from which a second step is taken by all of them."""
_SETTLING = 1e-8
"""Relative change of a slope from one period to the next whose square is rounding."""


class Swing(NamedTuple):
    """From a switch to the next: its `time` since the arrival, and the slopes at both; `leads` is -d time/d start."""

    start: Numbers
    time: Numbers
    end: Numbers
    leads: Numbers


class Sweep:
    """Tests that go on together.

    Attributes
    ----------
    simple : array of bool
        So far the PV did not pass the next threshold before a switch arrived, as far as that is known at a glance.
    once : array of bool
        So far the PV did not turn before a switch arrived.
    doubtful : array of bool
        A swing was not found, or one on another branch.
    """

    def __init__(self, tests: RelayTests, kind: type[Creeping | Ringing]) -> None:
        self._w0 = 1.0 / np.sqrt(tests.m)
        self._zeta = 0.5 * tests.n * self._w0
        self._D = tests.D * self._w0
        self._short = _SHORT / (1.0 + 2.0 * self._zeta)
        self._free: Free = kind(self._zeta)
        self._ends, (ahead, back) = tests.ends, tests.thresholds
        self._to = back - self._ends[1], ahead - self._ends[0]
        c, o = self._free.motion(self._D)
        self._o, self._kept, left = o, c - self._zeta * o, c + self._zeta * o
        gap = self._ends[0] - self._ends[1]
        self._after = left * self._to[1] + gap, left * self._to[0] - gap
        self._pushed = -o * self._to[1], -o * self._to[0]
        self._again: Numbers = np.asarray(self._free.again)
        self._soon: Truths = self._again > self._D
        shrinks = self._free.shrinks
        self._reach = ((back - self._ends[0]) / shrinks) ** 2, ((ahead - self._ends[1]) / shrinks) ** 2
        self._lively = self._may_reach()
        self.once: Truths = np.ones(self._D.size, dtype=np.bool_)
        self.simple: Truths = np.ones(self._D.size, dtype=np.bool_)
        self.doubtful: Truths = np.zeros(self._D.size, dtype=np.bool_)

    def run(self, switches: int) -> Numbers:
        """Return the last period, as the rows of `CycleBatch`, shape (4, N); NaN where the test is not simple."""
        v = self._first()
        fall: Swing | None = None
        rise: Swing | None = None
        change: Numbers | None = None
        for left in range(switches // 2 - 3, -1, -1):
            fall = self._swing(0, v, fall)
            rise = self._swing(1, fall.end, rise)
            before, change, v = change, rise.end - v, rise.end
            if before is not None and self._settling(before, v) and self._settling(change, v):
                v = v + _still_to_come(before, change, left)
                break
        fall = self._swing(0, v, fall)
        rise = self._swing(1, fall.end, rise)
        high_s, low_s = rise.time, self._swing(0, rise.end, fall).time
        bottom, top = self._furthest(1, fall.end), self._furthest(0, rise.end)
        last = np.array([(high_s + self._D) / self._w0, (low_s + self._D) / self._w0, bottom, top])
        last[:, ~self.simple] = math.nan
        return last

    def _first(self) -> Numbers:
        """Return the slope at the first switch; from rest, the first arrival counts as a turn."""
        start, rest = -self._ends[0], np.zeros(self._D.size)
        t = self._back_after(self._to[1] / start)
        found = self._end_of(start, rest, self._to[1], t)
        well = (found.end * self._to[1] < 0.0) & (found.time < self._again)
        self.doubtful |= (t > 0.0) & ~well
        return np.where(t > 0.0, found.end, 0.0)

    def _arrive(self, k: int, v: Numbers) -> tuple[Numbers, Numbers]:
        """Return `z` and `v` when switch `k` (0 a fall, 1 a rise), which the PV passed with slope `v`, has arrived."""
        z = self._o * v
        z += self._after[k]
        v = self._kept * v
        v += self._pushed[k]
        return z, v

    def _turn(self, z: Numbers, v: Numbers) -> tuple[Numbers, Numbers]:
        """Return when the PV turns, and `z` there."""
        q = v / (self._zeta * v + z)
        wait = self._free.turn(q)
        excess: Numbers = np.exp(-self._zeta * wait)
        excess *= z + (v + self._zeta * z) * q
        excess /= np.sqrt(1.0 - self._free.square * q * q)
        return wait, excess

    def _back_after(self, share: Numbers) -> Numbers:
        """Return about how long after a turn `z` is down to a share of what it was; 0 for more than all of it."""
        free, zeta = self._free, self._zeta
        steepest = free.turn(1.0 / zeta)
        c, o = free.motion(steepest)
        late = share <= c + zeta * o
        earliest, latest = np.where(late, steepest, 0.0), np.where(late, math.inf, steepest)
        t = np.where(late, steepest, np.minimum(np.sqrt(np.maximum(2.0 - 2.0 * share, 0.0)), steepest))
        for _ in range(_GUESSES):
            c, o = free.motion(t)
            step = (c + zeta * o - share) / o
            step /= np.maximum(1.0 + step * (c / o - zeta) / 2.0, 0.5)
            t += step
            t = np.minimum(np.maximum(t, earliest), latest)
        return np.where(share < 1.0, t, 0.0)

    def _swing(self, k: int, v: Numbers, before: Swing | None) -> Swing:
        """Go from switch `k`, passed with slope `v`, to the next one."""
        z0, v0 = self._arrive(k, v)
        if before is None:
            wait, excess = self._turn(z0, v0)
            t = self._back_after(self._to[k] / excess)
            t += wait
        else:
            t = before.start - v
            t *= before.leads
            t += before.time
        found = self._end_of(z0, v0, self._to[k], t)
        well = found.end * self._to[k] < 0.0
        if isinstance(self._free, Ringing):
            well &= (found.time > 0.0) & (found.time < self._latest(k, v, v0))
        self.doubtful |= ~well
        return Swing(v, *found[1:])

    def _latest(self, k: int, v: Numbers, v0: Numbers) -> Numbers:
        """Return until when the passage of the next threshold is the first; see to it that none was before."""
        away = v0 * self._to[1 - k] < 0.0
        once = away & self._soon
        self.once &= once
        rows = self._lively[(~once & self.simple)[self._lively]]
        if rows.size:
            self.simple[rows] &= self._stays(rows, self._to[1 - k][rows], v[rows], self._reach[k][rows])
        latest: Numbers = self._again * (1.0 + away)
        return latest

    def _may_reach(self) -> NDArray[np.intp]:
        """Return the tests whose PV may come back to a threshold in time: overshoots sum up to a geometric series."""
        shrinks, (up, down) = self._free.shrinks, self._ends
        farthest = np.maximum(np.abs(up - down), np.abs(up)) * shrinks / (1.0 - shrinks)
        return np.flatnonzero(np.minimum(*self._reach) <= farthest**2)

    def _stays(self, rows: NDArray[np.intp], z: Numbers, v: Numbers, reach: Numbers) -> Truths:
        """Return whether the next threshold is out of reach before the switch passed at `z`, `v` arrives."""
        stays: Truths = v * v + z * (2.0 * self._zeta[rows] * v + z) < reach
        some = np.flatnonzero(~stays)
        if some.size and isinstance(self._free, Ringing):
            rows = rows[some]
            free = self._free.only(rows)
            wait, turn = free.first_turn(z[some], v[some])
            back = wait + free.again - free.turn(1.0 / self._zeta[rows])  # at the level, which is before the threshold
            stays[some] = (turn * turn < reach[some]) | (back > self._D[rows])
        return stays

    def _furthest(self, k: int, v: Numbers) -> Numbers:
        """Return the furthest PV after switch `k`, passed with slope `v`."""
        z0, v0 = self._arrive(k, v)
        furthest = self._ends[1 - k] + self._turn(z0, v0)[1]
        if isinstance(self._free, Ringing):
            rows = np.flatnonzero(~self.once)
            wait, z = self._free.only(rows).first_turn(self._to[1 - k][rows], v[rows])
            before = wait <= self._D[rows]
            furthest[rows[before]] = self._ends[k][rows[before]] + z[before]
        return furthest

    def _end_of(self, z0: Numbers, v0: Numbers, z: Numbers, t: Numbers) -> Swing:
        """Return the swing that passes `z` near `t`, from an arrival at `z0` with slope `v0`."""
        found = _one_step(self._free, self._zeta, z0, v0, z, t)
        rows = self._far(found[0])
        if rows.size > _MANY * t.size:
            t += found[0]
            found = _one_step(self._free, self._zeta, z0, v0, z, t)
            rows = self._far(found[0])
        t += found[0]
        for _ in range(_STEPS):
            if not rows.size:
                break
            again = _one_step(self._free.only(rows), self._zeta[rows], z0[rows], v0[rows], z[rows], t[rows])
            for column, part in zip(found, again, strict=True):
                column[rows] = part
            t[rows] += again[0]
            rows = rows[np.abs(again[0]) > self._short[rows]]
        _, v, by_z, by_v, slope = found
        by_z *= self._o
        by_v *= self._kept
        by_z += by_v
        by_z /= slope
        return Swing(v0, t, v, by_z)

    def _far(self, h: Numbers) -> NDArray[np.intp]:
        """Return the tests whose step was not short."""
        far = np.abs(h) > self._short
        far &= self.simple
        far &= ~self.doubtful
        return np.flatnonzero(far)

    def _settling(self, change: Numbers, v: Numbers) -> bool:
        small = np.abs(change) <= _SETTLING * np.abs(v)
        return bool(np.all(small | ~self.simple | self.doubtful))


def _one_step(
    free: Free, zeta: Numbers, z0: Numbers, v0: Numbers, z: Numbers, t: Numbers
) -> tuple[Numbers, Numbers, Numbers, Numbers, Numbers]:
    """Return `h`, the slope when `z` is passed, and at `t`: `dz/dz0`, `dz/dv0` and the slope.

    A hot path: every line is one pass over the arrays, most of them in place.
    """
    c, by_v = free.motion(t)
    twice = 2.0 * zeta
    by_z = zeta * by_v
    by_z += c
    slope = c
    slope -= zeta * by_v
    slope *= v0
    slope -= z0 * by_v
    u = z - z0 * by_z
    u -= v0 * by_v
    a = z - u  # -A
    u /= slope
    a /= slope
    a += twice
    J = twice * a
    J -= 1.0
    h = a * a
    h -= J * (1.0 / 3.0)
    h *= u
    h += a
    h *= u
    h *= 0.5
    h += 1.0
    h *= u
    v = twice * J
    v -= a
    v *= h
    v *= -1.0 / 3.0
    v += J
    v *= h
    v *= 0.5
    v -= a
    v *= h
    v += 1.0
    v *= slope
    return h, v, by_z, by_v, slope


def _still_to_come(before: Numbers, change: Numbers, periods: int) -> Numbers:
    """Return the sum of the further changes: each is the same share of the one before."""
    shrinks = np.abs(change) < 0.99 * np.abs(before)
    ratio = np.divide(change, before, out=np.zeros_like(change), where=shrinks)
    return change * ratio * (1.0 - ratio**periods) / (1.0 - ratio)
