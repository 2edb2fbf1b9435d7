"""Thousands of second-order relay tests on their way from swing to swing.

Time in units of `1/w0`, `w0^2 = 1/m`; the distance `z` of the PV from where it is heading in units of the way between
the two levels, so that `z'' + 2 zeta z' + z = 0`, and counted so that it falls to each threshold: a rise is a fall
upside down. With `d^2 = zeta^2 - 1`

    z(t) = (c + zeta o) z0 + o v0,   c = e^{-zeta t} cosh dt
    v(t) = (c - zeta o) v0 - o z0,   o = e^{-zeta t} sinh(dt)/d

A switch finds the PV at its threshold: its slope `v` there is the whole state; time `t` and slope of the next switch
are functions of it. The quadratic through the last three of these times tells about when it comes. There `z` and `v`
are taken exactly, and `w = (z - to)/v`, what is left of the way, gives the slope at the threshold and the time until
then by their series along the way:

    v_end = v (1 + w (a - w b (1/2 - w (a/3 + y/6)))),   h = -w (1 - w (a/2 - w (2 a^2 + b)/6))
    y = z/v,   a = 2 zeta + y = -v'/v,   b = 1 + a y

Where `w` is not short, that is done again for those tests alone.

Rules of this file: a hot path, where every line is one pass over the arrays, most of them in place; a swing that is not
found makes its test NaN from there on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from autotuner_sim.batch_motion import Free

Numbers = NDArray[np.float64]
Pair = tuple[Numbers, Numbers]
Rows = NDArray[np.intp]
Place = tuple[Numbers, Numbers, Numbers, Numbers]

_SHORT = 3e-4
"""Step, relative to the time in which the slope changes, of which the first term left out of the series is rounding."""
_STEPS = 8
"""Steps after which a guess was no good; the first swing of a side begins with a worse one."""
_FIRST_STEPS = 30
_GUESSES = 2
_MANY = 0.35
"""Share of the tests from which a further step is taken by all of them."""
_TINY = 1e-9
"""Change of a slope of which the next guess need not know: the quotient of two such differences may be anything."""


@dataclass(slots=True, eq=False)
class Side:
    """What follows when the relay has left one of its levels.

    `to` is the next threshold, `passed` how far the one before is from the level that was left; `after` and `pushed`
    are `z` and `v` at the arrival of a switch that was passed with slope 0; `short` is the step that needs no further
    one. Of the last swings `v`, `before` are the
    slopes at their start, `t` is the time of the last, `slope`, `bend` its divided differences. All slopes so far lie
    from `least` to `most`, all times from `early` to `late`.
    """

    to: Numbers
    passed: Numbers
    after: Numbers
    pushed: Numbers
    short: Numbers
    v: Numbers
    before: Numbers
    t: Numbers
    slope: Numbers
    bend: Numbers
    least: Numbers
    most: Numbers
    early: Numbers
    late: Numbers

    def only(self, rows: Rows) -> Side:
        """Return some of the tests."""
        return Side(*(getattr(self, field.name)[rows] for field in fields(self)))

    def about(self, v: Numbers) -> Numbers:
        """Return about when a swing from a slope ends."""
        t = v - self.before
        t *= self.bend
        t += self.slope
        t *= v - self.v
        t += self.t
        return t

    def note(self, v: Numbers, t: Numbers) -> None:
        """Take down a swing."""
        slope = _divided(t - self.t, v - self.v)
        self.bend = _divided(slope - self.slope, v - self.before)
        self.before, self.v, self.t, self.slope = self.v, v, t, slope
        np.minimum(self.least, v, out=self.least)
        np.fmax(self.most, v, out=self.most)  # also of a test that is not found any more
        np.minimum(self.early, t, out=self.early)
        np.maximum(self.late, t, out=self.late)


def new_side(to: Numbers, passed: Numbers, left: Numbers, o: Numbers) -> Side:
    """Return a side before its first swing; of `z` and `v` the dead time makes `z left` and `v o`."""
    nothing = np.empty(0)
    return Side(to, passed, 1.0 - left * passed, o * passed, *([nothing] * 10))


def _divided(by: Numbers, change: Numbers) -> Numbers:
    """Return the quotient of two differences; anything that is not large where they are rounding."""
    change += _TINY
    by /= change
    return by


class Course:
    """Tests that go on together; `sides` is one where the relay is symmetric, since then both are the same."""

    def __init__(self, free: Free, o: Numbers, kept: Numbers, sides: list[Side]) -> None:
        self.free, self._o, self._kept, self.sides = free, o, kept, sides
        self._twice, self._third = 2.0 * free.zeta, free.zeta * (2.0 / 3.0)
        self._short = _SHORT / (1.0 + self._twice)

    def only(self, rows: Rows) -> Course:
        """Return some of the tests."""
        return Course(self.free.only(rows), self._o[rows], self._kept[rows], [side.only(rows) for side in self.sides])

    def rise_from(self, rest: Numbers) -> Numbers:
        """Return the slope at the first switch, of a PV that comes from rest; the first arrival counts as a turn."""
        to = self.sides[0].passed
        share = to / rest
        if np.all(share == 1.0):
            return np.zeros(to.size)
        t = _back_after(self.free, share)
        (z, v, w, at), far = _place(self.free, (rest, np.zeros(to.size)), to, t, self._short, _FIRST_STEPS)
        w[far] = math.nan
        v = np.where(at < self.free.again, self._end(z, v, w)[0], math.nan)
        return np.where(t > 0.0, v, 0.0)

    def arrive(self, side: Side, v: Numbers) -> Pair:
        """Return `z` and `v` when a switch that the PV passed with slope `v` has arrived."""
        z = self._o * v
        z += side.after
        v = self._kept * v
        v += side.pushed
        return z, v

    def turn_over(self, x: Numbers) -> Numbers:
        """Go a turn; return the slope at its end."""
        for each in self.sides:
            x = self.go_on(each, x)
        return x

    def go_on(self, side: Side, v: Numbers) -> Numbers:
        """Go a swing of a side; return the slope at its end."""
        if not side.t.size:
            return self._first_swing(side, v)
        z, s, w, t = self._swing(side, v)
        t -= w
        side.note(v, t)
        return self._end(z, s, w)[0]

    def exactly(self, side: Side, v: Numbers) -> Pair:
        """Return the slope at the end of a swing, and its time."""
        if not side.t.size:
            self._first_swing(side, v)
        z, s, w, t = self._swing(side, v)
        end, a, b = self._end(z, s, w)
        a_squared = a * a
        a_squared *= 2.0
        b += a_squared
        b *= w
        b *= -1.0 / 3.0
        a += b
        a *= w
        a *= -0.5
        a += 1.0
        a *= w
        t -= a
        np.minimum(side.early, t, out=side.early)
        np.maximum(side.late, t, out=side.late)
        np.minimum(side.least, v, out=side.least)
        np.fmax(side.most, v, out=side.most)
        return end, t

    def _first_swing(self, side: Side, v: Numbers) -> Numbers:
        """Go the first swing of a side, of which nothing is known."""
        z, s, w, t = _from_the_turn(self.free, self.arrive(side, v), side.to, self._short)
        c, o = self.free.motion(t)
        side.slope = -((c + self.free.zeta * o) * self._o + o * self._kept) / s
        side.v = side.before = v
        side.t, side.bend = t - w, np.zeros(v.size)
        side.least, side.most, side.early, side.late = v.copy(), v.copy(), side.t.copy(), side.t.copy()
        end = self._end(z, s, w)[0]
        side.short = _SHORT / (1.0 + self._twice + side.to / end)
        return end

    def _swing(self, side: Side, v: Numbers) -> Place:
        """Return the place near the end of a swing."""
        start, to = self.arrive(side, v), side.to
        place, far = _place(self.free, start, to, side.about(v), side.short, _STEPS)
        wrong = place[1] > 0.0  # the PV rises to the threshold
        wrong |= place[3] <= 0.0  # or would have passed it before the arrival
        wrong[far] = True
        far = np.flatnonzero(wrong)
        if far.size:
            again = _from_the_turn(self.free.only(far), (start[0][far], start[1][far]), to[far], side.short[far])
            for column, values in zip(place, again, strict=True):
                column[far] = values
        return place

    def _end(self, z: Numbers, v: Numbers, w: Numbers) -> tuple[Numbers, Numbers, Numbers]:
        """Return the slope at the threshold, upside down, `a` and `b`."""
        y = z
        y /= v
        a = y + self._twice
        b = y * a
        b += 1.0
        y *= 0.5
        y += self._third
        y *= w
        np.subtract(0.5, y, out=y)
        y *= b
        y *= w
        y -= a
        y *= w
        y -= 1.0
        y *= v
        return y, a, b


def turn(free: Free, z: Numbers, v: Numbers) -> Pair:
    """Return when the PV turns, and `z` there."""
    zeta = free.zeta
    q = v / (zeta * v + z)
    wait = free.turn(q)
    excess: Numbers = np.exp(-zeta * wait)
    excess *= z + (v + zeta * z) * q
    excess /= np.sqrt(1.0 - free.square * q * q)
    return wait, excess


def _from_the_turn(free: Free, start: Pair, to: Numbers, short: Numbers) -> Place:
    """Return the place near a threshold of which nothing is known; NaN where it is not found."""
    wait, excess = turn(free, *start)
    wait += _back_after(free, to / excess)
    place, rows = _place(free, start, to, wait, short, _FIRST_STEPS)
    _, v, w, _ = place
    w[rows] = math.nan
    w[v > 0.0] = math.nan
    return place


def _place(free: Free, start: Pair, to: Numbers, t: Numbers, short: Numbers, steps: int) -> tuple[Place, Rows]:
    """Return `z`, `v` and `w` at a `t` that is so near to the threshold that `w` is short, and `t`; and where not."""
    (z0, v0), twice = start, 2.0 * free.zeta
    z, v, w = _at(free, z0, v0, to, t)
    for _ in range(steps):
        rows = np.flatnonzero(np.abs(w) > short)
        if not rows.size:
            break
        if rows.size > _MANY * t.size:
            t = t - _nearer(z, v, w, twice)
            z, v, w = _at(free, z0, v0, to, t)
        else:
            t[rows] -= _nearer(z[rows], v[rows], w[rows], twice[rows])
            z[rows], v[rows], w[rows] = _at(free.only(rows), z0[rows], v0[rows], to[rows], t[rows])
    else:
        rows = np.flatnonzero(~(np.abs(w) <= short))
    return (z, v, w, t), rows


def _back_after(free: Free, share: Numbers) -> Numbers:
    """Return about how long after a turn `z` is down to a share of what it was; 0 for more than all of it."""
    zeta = free.zeta
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


def _at(free: Free, z0: Numbers, v0: Numbers, to: Numbers, t: Numbers) -> tuple[Numbers, Numbers, Numbers]:
    """Return `z`, `v` and `w` at `t`."""
    v, o = free.motion(t)
    z = free.zeta * o
    v -= z
    z *= 2.0
    z += v
    v *= v0
    v -= o * z0
    z *= z0
    o *= v0
    z += o
    w = z - to
    w /= v
    return z, v, w


def _nearer(z: Numbers, v: Numbers, w: Numbers, twice: Numbers) -> Numbers:
    """Return how much too late the passage is taken to be, by two terms of the series."""
    nearer: Numbers = w * (1.0 - 0.5 * w * (z / v + twice))
    return nearer
