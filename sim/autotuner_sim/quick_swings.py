"""The swings of one second-order relay test, each from the same swing one period before: `batch_swings` for one plant.

Rule of this file: it is written for CPython, where a function call costs as much as ten operations: what a swing needs
stands in one loop, and what nobody may ask for, the PV at the turns, waits until somebody does.
"""

from __future__ import annotations

import math
from math import exp, expm1
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable

Pair = tuple[float, float]
End = tuple[float, float, float]

_SHORT = 2e-4
"""Step, in the faster of `1/w0` and the fast time constant, whose fourth power is rounding."""
_ROUGH = 0.02
"""Relative step after which a guess is good enough."""
_MOST_STEPS = 60
_SETTLING = 1e-8
"""Relative change of a slope from one period to the next whose square is rounding."""
_LEAST = 1e-100
_VANISHES = 40.0
"""Exponent of a decay below rounding: what is left of a swing when the PV would turn again."""


class Free(NamedTuple):
    """The free motion of a second-order plant, in units of `1/w0`; see `batch_motion.Free`."""

    zeta: float
    square: float
    again: float
    motion: Callable[[float], Pair]
    turn: Callable[[float], float]


def free_motion(zeta: float) -> Free:
    """Return the motion of `z'' + 2 zeta z' + z = 0`."""
    return _creeping(zeta) if zeta >= 1.0 else _ringing(zeta)


def _creeping(zeta: float) -> Free:
    square = zeta * zeta - 1.0
    d = math.sqrt(square) + _LEAST
    slow, apart, scale = -1.0 / (zeta + d), -2.0 * d, -0.5 / d

    def motion(t: float) -> Pair:
        decay = exp(slow * t)
        o = decay * expm1(apart * t) * scale
        return decay - d * o, o

    def turn(q: float) -> float:
        return -scale * math.log1p(2.0 * d * q / (1.0 - d * q))

    return Free(zeta, square, math.inf, motion, turn)


def _ringing(zeta: float) -> Free:
    square = zeta * zeta - 1.0
    d = math.sqrt(-square)
    cos, sin = math.cos, math.sin

    def motion(t: float) -> Pair:
        decay, angle = exp(-zeta * t), d * t
        return decay * cos(angle), decay * sin(angle) / d

    def turn(q: float) -> float:
        return math.atan(d * q) / d

    again = math.pi / d
    return Free(zeta, square, again if zeta * again < _VANISHES else math.inf, motion, turn)


class Course(NamedTuple):
    """What is the same in every swing, by the position that the relay leaves: 0 high, 1 low.

    `to` is the next threshold, `back` the same counted from the level that is left; `after` and `pushed` are `z` and
    `v` at the arrival of a switch that was passed with slope 0, `o` and `kept` what a slope adds to them. `z` counts
    from the level that has arrived.
    """

    free: Free
    w0: float
    D: float
    ends: Pair
    to: Pair
    back: Pair
    after: Pair
    pushed: Pair
    o: float
    kept: float
    end_of: Callable[[float, float, float, float], End | None]

    def turn(self, k: int, v: float) -> Pair:
        """Return when the PV turns after the arrival of a switch passed with slope `v`, and `z` there."""
        zeta, square, _, _, turn = self.free
        z, v = self.after[k] + self.o * v, self.pushed[k] + self.kept * v
        q = v / (zeta * v + z)
        wait = turn(q)
        return wait, exp(-zeta * wait) * (z + (v + zeta * z) * q) / math.sqrt(1.0 - square * q * q)

    def comes_first(self, k: int, v: float, v0: float, t: float) -> bool:
        """Return whether the next threshold, passed at `t`, was not passed before; slopes at the switch and arrival."""
        again = self.free.again
        return again == math.inf or ((t < again or v0 * v > 0.0) and self._stays(k, v))

    def _stays(self, k: int, v: float) -> bool:
        """Return whether the PV, which passed with slope `v`, does not pass the next threshold before the arrival."""
        wait, turn = first_turn(self.free.zeta, self.to[1 - k], v)
        again, steepest = self.free.again, self.free.turn(1.0 / self.free.zeta)
        # it is at the level, which lies before the threshold, that long after the turn
        return abs(turn) * exp(-self.free.zeta * again) < abs(self.back[k]) or wait + again - steepest > self.D

    def furthest(self, k: int, v: float) -> float:
        """Return the furthest PV after a switch passed with slope `v`."""
        again = self.free.again
        if again < math.inf and ((self.pushed[k] + self.kept * v) * v <= 0.0 or again <= self.D):
            wait, turn = first_turn(self.free.zeta, self.to[1 - k], v)
            if wait <= self.D:
                return self.ends[k] + turn
        return self.ends[1 - k] + self.turn(k, v)[1]


def first_turn(zeta: float, z: float, v: float) -> Pair:
    """Return when a PV that rings turns first, and `z` there; `v` is not 0."""
    d = math.sqrt(1.0 - zeta * zeta)
    angle = math.atan2(d * v, zeta * v + z)
    wait = (angle if v > 0.0 else angle + math.pi) / d
    return wait, math.copysign(math.sqrt(z * (z + 2.0 * zeta * v) + v * v), v) * exp(-zeta * wait)


class QuickRun:
    """A run: the time from each arrival to the next switch, and the slopes at the switches, in units of `1/w0`.

    What comes again after `every` swings is compared: after two, or after one where rises are falls upside down, whose
    slopes then are those of falls. Beyond the last of them, their changes shrink by `ratio` for ever.
    """

    def __init__(
        self, course: Course, times: list[float], slopes: list[float], ratio: float, every: int, switches: int
    ) -> None:
        self._course = course
        self._times, self._slopes, self._ratio = times, slopes, ratio
        self._every, self._switches = every, switches

    @property
    def switches_s(self) -> list[float]:
        """Times of the switches, s from the start."""
        t, times = 0.0, []
        for k in range(self._switches):
            t += (self._entry(self._times, k) + self._course.D) / self._course.w0
            times.append(t)
        return times

    @property
    def turns(self) -> list[float]:
        """PV at the turns between the switches."""
        return [self._turn(k) for k in range(self._switches - 1)]

    @property
    def period_s(self) -> float:
        """Length of the last full period, s."""
        last = self._entry(self._times, self._switches - 1) + self._entry(self._times, self._switches - 2)
        return (last + 2.0 * self._course.D) / self._course.w0

    @property
    def peak(self) -> float:
        """Amplitude of the last full period, zero to peak."""
        return abs(self._turn(self._switches - 2) - self._turn(self._switches - 3)) / 2.0

    def _turn(self, k: int) -> float:
        side = k % self._every
        furthest = self._course.furthest(side, self._entry(self._slopes, k))
        return furthest if side == k % 2 else -furthest

    def _entry(self, values: list[float], k: int) -> float:
        if k < len(values):
            return values[k]
        every, ratio = self._every, self._ratio
        like = len(values) - 1 - (len(values) - 1 - k) % every
        change = values[like] - values[like - every]
        return values[like] + change * ratio * (1.0 - ratio ** ((k - like) // every)) / (1.0 - ratio)


def second_order(m: float, n: float, D: float, ends: Pair, thresholds: Pair, switches: int) -> QuickRun | None:
    """Run a test of `m y'' + n y' + y`; None where the PV passes a threshold again before a switch arrives.

    `D`, `n` s, `m` s^2; `ends` is where the PV is heading at the high level and at the low, `thresholds` where these
    end.
    """
    w0 = 1.0 / math.sqrt(m)
    free = free_motion(0.5 * n * w0)
    zeta, gap = free.zeta, ends[0] - ends[1]
    D *= w0
    c, o = free.motion(D)
    to = thresholds[1] - ends[1], thresholds[0] - ends[0]
    back = thresholds[1] - ends[0], thresholds[0] - ends[1]
    after = (c + zeta * o) * to[1] + gap, (c + zeta * o) * to[0] - gap
    kept = c - zeta * o
    course = Course(free, w0, D, ends, to, back, after, (-o * to[1], -o * to[0]), o, kept, finder(free, o, kept))
    tau = _back_after(free, to[1] / -ends[0])
    first = course.end_of(-ends[0], 0.0, to[1], tau) if tau > 0.0 else (0.0, -_LEAST * to[1], 0.0)
    every = 1 if ends[0] == -ends[1] and thresholds[0] == -thresholds[1] else 2
    if first is None or first[1] * to[1] > 0.0 or first[0] >= free.again:
        return None
    return _swings(course, [first[0]], [first[1]], every, switches)


def _swings(course: Course, times: list[float], slopes: list[float], every: int, switches: int) -> QuickRun | None:
    """Go on from the first switch, until what is left is known."""
    after, pushed, to = course.after, course.pushed, course.to
    o, kept, end_of, soon = course.o, course.kept, course.end_of, course.free.again <= course.D
    leads, v, change, settled, ratio, k = [0.0, 0.0], slopes[0], 0.0, 0, 0.0, 0
    for count in range(1, switches):
        z0, v0 = after[k] + o * v, pushed[k] + kept * v
        end = None
        if count > every:
            last = slopes[-1 - every]
            change = v - last
            settled = settled + 1 if -_SETTLING < change / v < _SETTLING else 0
            if settled >= every and count > 2 * every:
                before = last - slopes[-1 - 2 * every]
                ratio = change / before if abs(change) < abs(before) else 0.0
                break
            end = end_of(z0, v0, to[k], times[-every] - change * leads[k])
        elif count == 2:
            end = end_of(z0, v0, to[k], times[-1])
        if end is None or end[1] * to[k] >= 0.0:
            end = _from_the_turn(course, k, v, z0, v0)
        if end is None or ((v0 * v <= 0.0 or soon) and not course.comes_first(k, v, v0, end[0])):
            return None
        times.append(end[0])
        leads[k], v = end[2], end[1]
        if every == 1:
            v = -v
        else:
            k = 1 - k
        slopes.append(v)
    return QuickRun(course, times, slopes, ratio, every, switches)


def _from_the_turn(course: Course, k: int, v: float, z0: float, v0: float) -> End | None:
    """Return the end of a swing of which nothing is known; None where it is not found."""
    wait, excess = course.turn(k, v)
    end = course.end_of(z0, v0, course.to[k], wait + _back_after(course.free, course.to[k] / excess))
    return end if end is not None and end[1] * course.to[k] < 0.0 else None


def _back_after(free: Free, share: float) -> float:
    """Return about how long after a turn `z` is down to a share of what it was; 0 for more than all of it.

    By Halley's method, on its side of the steepest point.
    """
    if share >= 1.0:
        return 0.0
    zeta, motion, steepest = free.zeta, free.motion, free.turn(1.0 / free.zeta)
    c, o = motion(steepest)
    late = share <= c + zeta * o
    t = steepest if late else min(math.sqrt(2.0 - 2.0 * share), steepest)
    for _ in range(_MOST_STEPS):
        c, o = motion(t)
        step = (c + zeta * o - share) / o
        step /= max(1.0 + step * (c / o - zeta) / 2.0, 0.5)
        t = max(t + step, steepest) if late else min(t + step, steepest)
        if abs(step) <= _ROUGH * t:
            break
    return t


def finder(free: Free, o_D: float, kept: float) -> Callable[[float, float, float, float], End | None]:
    """Return what finds the end of a swing from an arrival at `z0` with slope `v0`: when the PV passes `z` near `t`.

    It returns that time, the slope there, and by how much earlier it comes for a larger slope at the switch before.
    """
    zeta, _, again, motion, _ = free
    twice, short, latest = 2.0 * zeta, _SHORT / (1.0 + 2.0 * zeta), 2.0 * again

    def end_of(z0: float, v0: float, z: float, t: float) -> End | None:
        for _ in range(_MOST_STEPS):
            if not 0.0 <= t < latest:
                return None
            c, o = motion(t)
            zeta_o = zeta * o
            by_z = c + zeta_o
            slope = v0 * (c - zeta_o) - z0 * o
            if slope == 0.0:
                return None
            past = z0 * by_z + v0 * o - z
            u, a = past / slope, twice + (z + past) / slope
            j = twice * a - 1.0
            h = u * (u * (0.5 * a - u * (0.5 * a * a - j / 6.0)) - 1.0)
            t += h
            if -short < h < short:
                v = slope * (1.0 + h * (h * (j + h * (a - twice * j) / 3.0) / 2.0 - a))
                return t, v, (by_z * o_D + o * kept) / slope
        return None

    return end_of
