"""One relay test from rest in closed form: first and second order, one switch at a time on its way (see `swings`).

A single lag turns at the arrival itself and comes back as `e^{-tau/T}`, so every half period after the first arrival is
one of two:

    top = L_h + (y_f - L_h) e^{-D/T},   fall = D + T ln((top - L_l)/(y_r - L_l)),   and likewise the rise

`L_h`, `L_l` where the PV is heading at the two levels, `y_f`, `y_r` the thresholds at which the relay falls and rises.

Rule of this file: where there is no such answer it says None, and `run_relay` has one.
"""

from __future__ import annotations

import math
from itertools import islice
from typing import TYPE_CHECKING, NamedTuple

from autotuner_sim.plants import Fopdt, SopdtOverdamped, SopdtUnderdamped
from autotuner_sim.swings import NUMBERS, creeping, ringing, swings

if TYPE_CHECKING:
    from autotuner_sim.relay import Relay
    from autotuner_sim.swings import Shape

_CLOSE = 1e-5
"""Relative step of the third-order iteration after which the next would be rounding."""
_MOST_STEPS = 100
_SETTLED = 1e-14
"""Relative change of `tau` from one period to the next under which all further periods are the same."""
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


def quick_relay(plant: Fopdt | SopdtOverdamped | SopdtUnderdamped, relay: Relay, switches: int) -> QuickRun | None:
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
    QuickRun or None
        None without dead time, where the PV at rest forbids the high level, where a level does not lead across its
        threshold, and where the PV turns again before a switch arrives.
    """
    thresholds = relay.threshold(is_high=True)[0], relay.threshold(is_high=False)[0]
    ends = plant.K * relay.high, plant.K * relay.low
    if plant.D <= 0.0 or not crosses(ends, thresholds, 1.0 if relay.direct else -1.0):
        return None
    if isinstance(plant, SopdtUnderdamped):
        return _second_order(ringing(NUMBERS, plant.m, plant.n), plant.D, ends, thresholds, switches)
    if isinstance(plant, Fopdt):
        return _first_order(plant.T, plant.D, ends, thresholds, switches)
    if plant.T2 == 0.0:
        return _first_order(plant.T1, plant.D, ends, thresholds, switches)
    shape = creeping(NUMBERS, plant.T1 * plant.T2, plant.T1 + plant.T2)
    return _second_order(shape, plant.D, ends, thresholds, switches)


def crosses(ends: Pair, thresholds: Pair, direction: float) -> bool:
    """Return whether each level leads across its threshold, and rest (0) lies before the first of them."""
    return (
        direction * (ends[0] - thresholds[0]) > 0.0
        and direction * (ends[1] - thresholds[1]) < 0.0
        and direction * thresholds[0] >= 0.0
    )


def _first_order(T: float, D: float, ends: Pair, thresholds: Pair, switches: int) -> QuickRun:
    (up, down), (y_f, y_r) = ends, thresholds
    left = math.exp(-D / T)
    top, bottom = up + (y_f - up) * left, down + (y_r - down) * left
    fall = D + T * math.log((top - down) / (y_r - down))
    period = fall + D + T * math.log((bottom - up) / (y_f - up))
    first = D + T * math.log(up / (up - y_f))
    pairs = range((switches + 1) // 2)
    times = [0.0] * (2 * len(pairs))
    times[::2] = [first + k * period for k in pairs]
    times[1::2] = [first + fall + k * period for k in pairs]
    return QuickRun(times[:switches], ([top, bottom] * len(pairs))[: switches - 1])


def _second_order(shape: Shape[float], D: float, ends: Pair, thresholds: Pair, switches: int) -> QuickRun | None:
    times: list[float] = []
    turns: list[float] = []
    taus: list[float] = []
    for switch_s, tau, turn in islice(swings(NUMBERS, shape, D, ends, thresholds, _back_at), switches):
        if tau + D >= shape.turns_again_s:
            return None
        times.append(switch_s)
        taus.append(tau)
        turns.append(turn)
        if len(taus) > 3 and all(abs(taus[i] - taus[i - 2]) <= _SETTLED * tau for i in (-1, -2)):
            break
    while len(times) < switches:
        times.append(times[-2] + times[-1] - times[-3])
        turns.append(turns[-2])
    return QuickRun(times, turns[: switches - 1])


def _back_at(shape: Shape[float], share: float, start_s: float) -> float:
    """Return `tau` with `g(tau) = share`, by Halley's method on its side of the steepest point."""
    if share >= 1.0:
        return 0.0
    s, stiffness, steepest_s, motion = shape.s, shape.stiffness, shape.steepest_s, shape.motion
    late = share <= shape.steepest_share
    tau = start_s or steepest_s
    for _ in range(_MOST_STEPS):
        c, o = motion(tau)
        step = (c + s * o - share) / (stiffness * o)
        step /= max(1.0 + step * (c / o - s) / 2.0, 0.5)
        tau = max(tau + step, steepest_s) if late else min(tau + step, steepest_s)
        if abs(step) <= _CLOSE * tau:
            break
    return tau
