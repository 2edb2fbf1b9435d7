"""One relay test from rest in closed form: first and second order.

A single lag turns at the arrival itself and comes back as `e^{-tau/T}`, so every half period after the first arrival is
one of two:

    top = L_h + (y_f - L_h) e^{-D/T},   fall = D + T ln((top - L_l)/(y_r - L_l)),   and likewise the rise

`L_h`, `L_l` where the PV is heading at the two levels, `y_f`, `y_r` the thresholds at which the relay falls and rises.
A test of second order goes from swing to swing as the equations of `batch_swings` say, and where the PV passes the next
threshold before a switch arrives, from turn to turn (`quick_pending`).

Rule of this file: where there is no such answer it says None, and `run_relay` has one.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from autotuner_sim.plants import Fopdt, SopdtOverdamped, SopdtUnderdamped
from autotuner_sim.quick_pending import PendingRun, pending_run
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
) -> QuickRun | PeriodicRun | PendingRun | None:
    """Run a relay test from rest.

    Parameters
    ----------
    plant : Fopdt, SopdtOverdamped or SopdtUnderdamped
        The plant, at rest until the relay takes its first level at `t = 0`: the high one, where the PV at rest allows
        it.
    relay : Relay
        The relay.
    switches : int
        How many switches to run, 3 at least.

    Returns
    -------
    QuickRun, PeriodicRun, PendingRun or None
        The second of a single lag, the third where several switches are on their way. None without dead time, and where
        the PV does not oscillate.
    """
    D, reference = plant.D, relay.reference
    way = 1.0 if relay.direct else -1.0
    beyond = way * relay.hysteresis
    thresholds = reference + beyond, reference - beyond
    ends = plant.K * relay.high, plant.K * relay.low
    if D <= 0.0:
        return None
    if way * thresholds[0] < 0.0:
        ends, thresholds, way = ends[::-1], thresholds[::-1], -way
    m, n = coefficients(plant)
    across = way * (ends[0] - thresholds[0]) > 0.0 and way * (ends[1] - thresholds[1]) < 0.0
    if not m:
        return _first_order(n, D, ends, thresholds, switches) if across else None
    found = second_order(m, n, D, ends, thresholds, switches) if across else None
    return pending_run(m, n, D, ends, thresholds, way, switches) if found is None and n * n < 4.0 * m else found


def coefficients(plant: Fopdt | SopdtOverdamped | SopdtUnderdamped) -> Pair:
    """Return `m` and `n` of `m y'' + n y' + y`."""
    if isinstance(plant, SopdtUnderdamped):
        return plant.m, plant.n
    if isinstance(plant, Fopdt):
        return 0.0, plant.T
    return plant.T1 * plant.T2, plant.T1 + plant.T2


def _first_order(T: float, D: float, ends: Pair, thresholds: Pair, switches: int) -> PeriodicRun:
    (up, down), (y_f, y_r) = ends, thresholds
    left = math.exp(-D / T)
    top, bottom = up + (y_f - up) * left, down + (y_r - down) * left
    fall = D + T * math.log((top - down) / (y_r - down))
    period = fall + D + T * math.log((bottom - up) / (y_f - up))
    first = D + T * math.log(up / (up - y_f))
    return PeriodicRun(first, fall, period, top, bottom, switches)
