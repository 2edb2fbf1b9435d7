"""One relay test of a ringing plant, however many switches are on their way and however often the PV turns meanwhile.

Between two arrivals the PV rings around the level it is heading for. Time in units of `1/w0`, `z` the distance from
that level, `d^2 = 1 - zeta^2`: its turns are `pi/d` apart, each `-r = -e^{-zeta pi/d}` times the one before, and from a
turn at `E` on

    z(t) = E g(t),   g = c + zeta o,   g' = -o,   c = e^{-zeta t} cos dt,   o = e^{-zeta t} sin(dt)/d

The first turn after `z0`, `v0` comes at `tan dt = d v0/(zeta v0 + z0)`, with `E^2 = (z0^2 + 2 zeta z0 v0 + v0^2)
e^{-2 zeta t}`. So which piece between two turns holds the next switch is told by products alone, and when it comes by
the inverse of `g`, which falls from 1 to `-r`.

Rule of this file: pieces are taken in their order, and none is left out: what it finds is the first passage.
"""

from __future__ import annotations

import math
from math import cos, exp, sin, sqrt
from typing import TYPE_CHECKING, NamedTuple

from autotuner_sim.quick_swings import first_turn

if TYPE_CHECKING:
    from collections.abc import Callable

Pair = tuple[float, float]

_SHORT = 2e-4
"""Step, relative to the time in which the slope changes, whose fourth power is rounding."""
_MEDIUM = 0.2
"""Step from which on the series is better than Halley's method."""
_MOST_STEPS = 80


class PendingRun(NamedTuple):
    """A run as the list of its switches, s from the start, and the furthest PV between each two of them."""

    switches_s: list[float]
    turns: list[float]

    @property
    def period_s(self) -> float:
        """Length of the last full period, s."""
        return self.switches_s[-1] - self.switches_s[-3]

    @property
    def peak(self) -> float:
        """Amplitude of the last full period, zero to peak."""
        return abs(self.turns[-1] - self.turns[-2]) / 2.0


def pending_run(
    m: float, n: float, D: float, ends: Pair, thresholds: Pair, way: float, switches: int
) -> PendingRun | None:
    """Run a test of `m y'' + n y' + y`, `n^2 < 4 m`; None where the PV comes to rest before a threshold.

    `D`, `n` s, `m` s^2; `ends` is where the PV is heading at the first level and at the other, `thresholds` where these
    end, the first of them in the direction `way`: 1 upwards, -1 downwards.
    """
    w0 = 1.0 / sqrt(m)
    course = _Course(0.5 * n * w0, D * w0, ends, thresholds, way)
    z, v, arrived, begun = -ends[0], 0.0, 0, course.D
    while True:
        state = course.until_the_next(z, v, arrived, begun, switches)
        if state is None:
            break
        begun, arrived = course.times[arrived] + course.D, arrived + 1
        z, v = state[0] + ends[1 - arrived % 2] - ends[arrived % 2], state[1]
    return PendingRun([t / w0 for t in course.times], course.turns[1:]) if len(course.times) == switches else None


class _Course:
    """A run as far as it is known, in units of `1/w0`; `way` is where the PV has to go next to pass a threshold."""

    def __init__(self, zeta: float, D: float, ends: Pair, thresholds: Pair, way: float) -> None:
        self.zeta, self.d = zeta, sqrt(1.0 - zeta * zeta)
        self.again = math.pi / self.d
        self.shrinks = exp(-zeta * self.again)
        self.D, self.ends, self.thresholds, self.way = D, ends, thresholds, way
        self.times: list[float] = []
        self.turns: list[float] = []
        self.furthest = 0.0
        self._since_turn = self._inverse()

    def until_the_next(self, z: float, v: float, arrived: int, begun: float, switches: int) -> Pair | None:
        """Return the state at the arrival after the one at `begun`, which left `z`, `v`; None at the end of the run."""
        times, level, again, way = self.times, self.ends[arrived % 2], self.again, self.way
        wait, turn = first_turn(self.zeta, z, v) if v else (0.0, z)
        turned, until, state = begun + wait, math.inf, (0.0, 0.0)
        while True:
            if until == math.inf and arrived < len(times):
                until = times[arrived] + self.D
                state = self._move(z, v, until - begun)
            to = self.thresholds[len(times) % 2] - level
            if turn * way > 0.0 and way * ((turn if turned <= until else state[0]) - to) > 0.0:
                since = self._since_turn(-to * self.shrinks / turn, len(times) % 2)
                times.append(max(turned - again + since, begun))
                self.turns.append(self.furthest)
                if len(times) == switches:
                    return None
                self.way = way = -way
                self.furthest = way * math.inf
            elif turned > until:
                return state
            elif until == math.inf and turn * way >= 0.0 and to * way >= 0.0:
                return None
            else:
                self.furthest = min(way * self.furthest, way * (level + turn)) * way
                turned, turn = turned + again, -turn * self.shrinks

    def _move(self, z: float, v: float, t: float) -> Pair:
        """Return the state after `t`."""
        zeta, decay, angle = self.zeta, exp(-self.zeta * t), self.d * t
        c, o = decay * cos(angle), decay * sin(angle) / self.d
        return (c + zeta * o) * z + o * v, (c - zeta * o) * v - o * z

    def _inverse(self) -> Callable[[float, int], float]:
        """Return the inverse of `g`, which begins where it was for the same position before."""
        zeta, d, again = self.zeta, self.d, self.again
        twice, steepest = 2.0 * zeta, math.atan2(d, zeta) / d
        last = [(steepest, 0.0, math.inf)] * 2

        def since_turn(share: float, position: int) -> float:
            if share >= 1.0:
                return 0.0
            low, high, (t, before, o) = 0.0, again, last[position]
            t += (before - share) / o
            for _ in range(_MOST_STEPS):
                if not low < t < high:
                    t = 0.5 * (low + high)
                decay, angle = exp(-zeta * t), d * t
                c, o = decay * cos(angle), decay * sin(angle) / d
                past = c + zeta * o - share
                low, high = (t, high) if past > 0.0 else (low, t)
                u, a = -past / o, twice - (share + past) / o
                h = u * (u * (0.5 * a - u * (0.5 * a * a - (twice * a - 1.0) / 6.0)) - 1.0)
                bend = (abs(a) + 1.0) * abs(h)
                if bend > _MEDIUM:
                    h = -u / max(1.0 + 0.5 * a * u, 0.5)
                t += h
                if bend < _SHORT:
                    last[position] = t, share, o
                    break
            return t

        return since_turn
