"""One relay test from rest in closed form: first and second order, one switch at a time on its way.

A single lag turns at the arrival itself and comes back as `e^{-tau/T}`, so every half period after the first arrival is
one of two:

    top = L_h + (y_f - L_h) e^{-D/T},   fall = D + T ln((top - L_l)/(y_r - L_l)),   and likewise the rise

`L_h`, `L_l` where the PV is heading at the two levels, `y_f`, `y_r` the thresholds at which the relay falls and rises.
A test of second order goes from swing to swing as the equations of `batch_swings` say.

Rule of this file: where there is no such answer it says None, and `run_relay` has one.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from autotuner_sim.plants import Fopdt, SopdtOverdamped, SopdtUnderdamped
from autotuner_sim.quick_swings import QuickRun, second_order

if TYPE_CHECKING:
    from autotuner_sim.relay import Relay

Pair = tuple[float, float]


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
        return second_order(plant.m, plant.n, D, ends, thresholds, switches)
    if plant.T2 == 0.0:
        return _first_order(plant.T1, D, ends, thresholds, switches)
    return second_order(plant.T1 * plant.T2, plant.T1 + plant.T2, D, ends, thresholds, switches)


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
