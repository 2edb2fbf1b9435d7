"""One relay test from rest in closed form: first and second order, one switch at a time on its way (see `swings`).

A single lag turns at the arrival itself and comes back as `e^{-tau/T}`, so every half period after the first arrival is
one of two:

    top = L_h + (y_f - L_h) e^{-D/T},   fall = D + T ln((top - L_l)/(y_r - L_l)),   and likewise the rise

`L_h`, `L_l` where the PV is heading at the two levels, `y_f`, `y_r` the thresholds at which the relay falls and rises.

Rule of this file: where there is no such answer it says None, and `run_relay` has one.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from autotuner_sim.plants import Fopdt, SopdtOverdamped, SopdtUnderdamped
from autotuner_sim.swings import NUMBERS, creeping, ringing

if TYPE_CHECKING:
    from autotuner_sim.relay import Relay
    from autotuner_sim.swings import Shape

_CLOSE = 1e-5
"""Relative step of the third-order iteration after which the next would be rounding."""
_MOST_STEPS = 100
_SETTLING = 1e-7
"""Relative change of `tau` from one period to the next whose square is rounding."""
Pair = tuple[float, float]


class QuickRun(NamedTuple):
    """Times of the switches, s from the start, and the PV at the turns between them."""

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


class PeriodicRun(NamedTuple):
    """A run that is periodic from its first switch on, as that of every single lag; the same in fewer numbers.

    `first_s` is the first switch, s, `other_s` the time from there to the second, `top` and `bottom` the PV after the
    odd switches and after the even ones.
    """

    first_s: float
    other_s: float
    period_s: float
    top: float
    bottom: float
    switches: int

    @property
    def switches_s(self) -> list[float]:
        """Times of the switches, s from the start."""
        firsts = [self.first_s + k * self.period_s for k in range((self.switches + 1) // 2)]
        return [t for first in firsts for t in (first, first + self.other_s)][: self.switches]

    @property
    def turns(self) -> list[float]:
        """PV at the turns between the switches."""
        return [self.bottom if k % 2 else self.top for k in range(self.switches - 1)]

    @property
    def peak(self) -> float:
        """Amplitude, zero to peak."""
        return abs(self.top - self.bottom) / 2.0


def quick_relay(
    plant: Fopdt | SopdtOverdamped | SopdtUnderdamped, relay: Relay, switches: int
) -> QuickRun | PeriodicRun | None:
    """Run a relay test from rest.

    Parameters
    ----------
    plant : Fopdt, SopdtOverdamped or SopdtUnderdamped
        The plant, at rest until the relay takes its high level at `t = 0`.
    relay : Relay
        The relay.
    switches : int
        How many switches to run, 3 at least.

    Returns
    -------
    QuickRun, PeriodicRun or None
        The second of a single lag. None without dead time, where the PV at rest forbids the high level, where a level
        does not lead across its threshold, and where the PV turns again before a switch arrives.
    """
    K, D, reference = plant.K, plant.D, relay.reference
    direction = 1.0 if relay.direct else -1.0
    beyond = direction * relay.hysteresis
    thresholds = reference + beyond, reference - beyond
    ends = K * relay.high, K * relay.low
    if D <= 0.0 or not crosses(ends, thresholds, direction):
        return None
    if isinstance(plant, Fopdt):
        return _first_order(plant.T, D, ends, thresholds, switches)
    if isinstance(plant, SopdtUnderdamped):
        return _second_order(ringing(NUMBERS, plant.m, plant.n), D, ends, thresholds, switches)
    if plant.T2 == 0.0:
        return _first_order(plant.T1, D, ends, thresholds, switches)
    shape = creeping(NUMBERS, plant.T1 * plant.T2, plant.T1 + plant.T2)
    return _second_order(shape, D, ends, thresholds, switches)


def crosses(ends: Pair, thresholds: Pair, direction: float) -> bool:
    """Return whether each level leads across its threshold, and rest (0) lies before the first of them."""
    return (
        direction * (ends[0] - thresholds[0]) > 0.0
        and direction * (ends[1] - thresholds[1]) < 0.0
        and direction * thresholds[0] >= 0.0
    )


def _first_order(T: float, D: float, ends: Pair, thresholds: Pair, switches: int) -> PeriodicRun:
    (up, down), (y_f, y_r) = ends, thresholds
    left = math.exp(-D / T)
    top, bottom = up + (y_f - up) * left, down + (y_r - down) * left
    fall = D + T * math.log((top - down) / (y_r - down))
    period = fall + D + T * math.log((bottom - up) / (y_f - up))
    first = D + T * math.log(up / (up - y_f))
    return PeriodicRun(first, fall, period, top, bottom, switches)


def _second_order(shape: Shape[float], D: float, ends: Pair, thresholds: Pair, switches: int) -> QuickRun | None:
    """Run swing by swing, as `swings` does, with what stays the same from swing to swing taken out of the loop.

    At a switch `z` is the same every time, so that `D` later `z = A + o v`, `v = B + (c - s o) v`.
    """
    s, stiffness, square = shape.s, shape.stiffness, shape.square
    c, o = shape.motion(D)
    from_s = thresholds[0] - ends[0], thresholds[1] - ends[1]
    gap = ends[0] - ends[1]
    after = (c + s * o) * from_s[0] + gap, (c + s * o) * from_s[1] - gap
    pushed, kept = (-o * stiffness * from_s[0], -o * stiffness * from_s[1]), c - s * o
    times, turns, taus, ratio = [], [], [0.0, 0.0, 0.0, 0.0], 0.0
    turned_s, excess, latest = D, -ends[0], shape.turns_again_s - D
    for count in range(switches):
        k = count % 2
        tau, slope = _back_at(shape, from_s[k] / excess, taus[-2] + ratio * (taus[-2] - taus[-4]))
        if tau >= latest:
            return None
        v = -excess * stiffness * slope
        z, v = after[k] + o * v, pushed[k] + kept * v
        q = v / (s * v + stiffness * z)
        wait_s = shape.turn_s(q)
        excess = math.exp(-s * wait_s) * (z + (v + s * z) * q) / math.sqrt(1.0 - square * q * q)
        times.append(turned_s + tau)
        turns.append(ends[1 - k] + excess)
        turned_s += tau + D + wait_s
        taus.append(tau)
        if count > 3:
            change, before = tau - taus[-3], taus[-3] - taus[-5]
            ratio = change / before if abs(change) < abs(before) else 0.0
            if abs(change) <= _SETTLING * tau and abs(taus[-2] - taus[-4]) <= _SETTLING * tau:
                _go_on(times, turns, ratio, switches)
                break
    return QuickRun(times, turns[: switches - 1])


def _go_on(times: list[float], turns: list[float], ratio: float, switches: int) -> None:
    """Add the further switches and turns: their changes from period to period shrink by the same ratio for ever.

    A switch finds the PV at its threshold, so that the slope there is the whole state, and near the end the map from
    one slope to the next is its derivative.
    """
    spans = [times[i] - times[i - 1] for i in (-4, -3, -2, -1)]
    last = turns[-4:]
    for i in range(switches - len(times)):
        spans.append(spans[i + 2] + ratio * (spans[i + 2] - spans[i]))
        last.append(last[i + 2] + ratio * (last[i + 2] - last[i]))
        times.append(times[-1] + spans[-1])
    turns += last[4:]


def _back_at(shape: Shape[float], share: float, start_s: float) -> Pair:
    """Return `tau` with `g(tau) = share`, and `o(tau)`, by Halley's method on its side of the steepest point.

    The last step `h` is so small that `o` follows it by two terms of its series, `o'' = -2 s o' - w0^2 o`.
    """
    s, stiffness, steepest_s, motion = shape.s, shape.stiffness, shape.steepest_s, shape.motion
    if share >= 1.0:
        return 0.0, 0.0
    late = share <= shape.steepest_share
    tau = start_s or steepest_s
    for _ in range(_MOST_STEPS):
        c, o = motion(tau)
        step = (c + s * o - share) / (stiffness * o)
        step /= max(1.0 + step * (c / o - s) / 2.0, 0.5)
        if -_CLOSE * tau <= step <= _CLOSE * tau:
            pace = c - s * o
            return tau + step, o + step * (pace - step * (s * pace + stiffness * o / 2.0))
        tau = max(tau + step, steepest_s) if late else min(tau + step, steepest_s)
    return tau, motion(tau)[1]
