"""Closed form: the first-order process from a relay's limit cycle, without describing-function bias.

    T = sqrt((K U1/A1)^2 - 1)/w,   D = (lag - atan(w T))/w,   w = 2 pi/Pu

In a steady oscillation the ratio of the fundamentals of PV and output, `A1` and `U1`, is the response at their
frequency, whatever bias and dead zone of the relay. Every sample counts for them, while a peak rests on those about the
extremes. `K` PV/output, `lag` rad, times s.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from autotuner.core.model.process import Fopdt
from autotuner.errors import InputError

if TYPE_CHECKING:
    from autotuner.core.signals.limit_cycle import LimitCycle


def fopdt_of_response(K: float, cycle: LimitCycle) -> Fopdt:
    """Return the first-order process of static gain `K` whose response at the period is that of the cycle.

    Raises
    ------
    InputError
        The fundamental reaches `|K| U1`, or the cycle has no dead time in it.
    """
    ratio, w = abs(K) * cycle.relay_fundamental / cycle.A1, 2.0 * math.pi / cycle.Pu
    if not ratio > 1.0:
        raise too_large(K, cycle.A1, cycle.relay_fundamental)
    turn = math.sqrt((ratio - 1.0) * (ratio + 1.0))
    lag = (cycle.lag_rad - (math.pi if K < 0.0 else 0.0)) % (2.0 * math.pi)
    return with_dead_time(K, turn / w, (lag - math.atan(turn)) / w)


def with_dead_time(K: float, T: float, D: float) -> Fopdt:
    """Return the process; raises `InputError` for a negative dead time."""
    if D < 0.0:
        raise InputError(
            f"turns {-D:g} s before the relay switches",
            field="limit_cycle",
            value=D,
            remedy="Sample faster, or use least squares.",
        )
    return Fopdt(K, T, D)


def too_large(K: float, A: float, h: float) -> InputError:
    """Return the error for an amplitude `A` that no first-order process of gain `K` reaches with a swing `h`."""
    return InputError(
        f"times h = {h:g} does not exceed the amplitude {A:g}: a first-order process of this gain stays below it",
        field="K",
        value=K,
        remedy="Check the static gain; an underdamped process needs another structure.",
    )
