"""The exact equations of a limit cycle, solved for the first-order process.

A first-order process moves on two exponentials, towards `Y_h` while its input is high and towards `Y_l` while it is
low, and turns one dead time after each switch of the relay. For the ideal symmetric relay

    A = K h (1 - e^{-D/T}),   Pu = 2 T ln(2 e^{D/T} - 1)

so `D/T = -ln(1 - A/(K h))` and `T = Pu/(2 ln(2 e^{D/T} - 1))`. From a dead time of some `36 T` on, the peak is `K h` to
the last digit; the fundamental `A1` still determines the lag, because `|G(jw)| = pi A1/(4 h)` is exact at `w = 2
pi/Pu`:

    T = sqrt((4 K h/(pi A1))^2 - 1)/w,   D = Pu/2 + T ln((1 + e^{-Pu/(2 T)})/2)

With any two levels and any dead zone, from the times `t_h`, `t_l` at the two levels, the extremes `y_min`, `y_max` and
the PV `y_f` at the moment at which the output fell:

    1/(1 - e^{-t_h/T}) + 1/(1 - e^{-t_l/T}) - 1 = K h/A                (gives T; the left side rises with T)
    Y_h = y_min + 2 A/(1 - e^{-t_h/T})
    D = T ln((Y_h - y_f)/(Y_h - y_max))                                (and likewise from the other switch)

The PV at the moment of switching takes the place of the threshold, so neither hysteresis nor the sampling delay of the
relay has to be known. `K` PV/output, `h` half the swing (output), `A = (y_max - y_min)/2` PV, times s. The symmetric
case: Astrom and Hagglund, PID Controllers (1995), and Luyben, Ind. Eng. Chem. Res. 40 (2001); the general one follows
by writing down both exponentials, as Wang, Hang and Zou, Ind. Eng. Chem. Res. 36 (1997) do for the biased relay.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import scipy

from autotuner.core.identification.limit_cycle.inverse_cycle import too_large, with_dead_time
from autotuner.core.model.process import Fopdt
from autotuner.errors import InputError

if TYPE_CHECKING:
    from autotuner.core.signals.limit_cycle import LimitCycle


def fopdt_symmetric(K: float, h: float, A: float, Pu: float) -> Fopdt:
    """Return the first-order process that oscillates so under an ideal symmetric relay.

    Parameters
    ----------
    K : float
        Static gain, PV/output.
    h : float
        Half the relay's swing, output units.
    A : float
        PV amplitude, zero to peak.
    Pu : float
        Period, s.

    Raises
    ------
    InputError
        A value is not positive, or the amplitude reaches `|K| h`, which no first-order process does.
    """
    _require_positive(h=h, A=A, Pu=Pu)
    share = A / (abs(K) * h) if K else math.inf
    if not share < 1.0:
        raise too_large(K, A, h)
    d = -math.log1p(-share)
    T = Pu / (2.0 * (d + math.log1p(-math.expm1(-d))))
    return Fopdt(K, T, d * T)


def fopdt_by_fundamental(K: float, h: float, A1: float, Pu: float) -> Fopdt:
    """Return the same process from the fundamental in place of the peak, for any ratio of dead time to lag.

    Parameters
    ----------
    K, h, Pu : float
        As in `fopdt_symmetric`.
    A1 : float
        Amplitude of the PV's fundamental, zero to peak.

    Raises
    ------
    InputError
        A value is not positive, or the fundamental reaches `4 |K| h/pi`, which no first-order process does.
    """
    _require_positive(h=h, A1=A1, Pu=Pu)
    ratio = 4.0 * abs(K) * h / (math.pi * A1)
    if not ratio > 1.0:
        raise too_large(K, math.pi / 4.0 * A1, h)
    T = math.sqrt((ratio - 1.0) * (ratio + 1.0)) * Pu / (2.0 * math.pi)
    return Fopdt(K, T, Pu / 2.0 + T * (math.log1p(math.exp(-Pu / (2.0 * T))) - math.log(2.0)))


def fopdt_of_cycle(K: float, cycle: LimitCycle) -> Fopdt:
    """Return the first-order process of static gain `K` that oscillates as `cycle`, whatever the relay's bias.

    Raises
    ------
    InputError
        The amplitude reaches `|K| h`, or the cycle has no dead time in it.
    """
    T = _lag(abs(K) * cycle.h / cycle.A, cycle.high_s, cycle.low_s)
    if T is None:
        raise too_large(K, cycle.A, cycle.h)
    # For a negative gain the PV falls while the output is high: mirrored, it is the same process.
    lowest, highest, at_rise, at_fall = (
        (cycle.lowest, cycle.highest, cycle.pv_at_rise, cycle.pv_at_fall)
        if K > 0.0
        else (-cycle.highest, -cycle.lowest, -cycle.pv_at_rise, -cycle.pv_at_fall)
    )
    swing = highest - lowest
    above = swing / -math.expm1(-cycle.high_s / T)
    below = swing / -math.expm1(-cycle.low_s / T)
    after_fall = T * math.log((above + lowest - at_fall) / (above - swing))
    after_rise = T * math.log((at_rise - highest + below) / (below - swing))
    return with_dead_time(K, T, (after_fall + after_rise) / 2.0)


def _lag(ratio: float, high_s: float, low_s: float) -> float | None:
    """Return `T`, or None when no lag is short enough for an amplitude this large."""

    def excess(log_T: float) -> float:
        rate = math.exp(-log_T)
        return -1.0 / math.expm1(-high_s * rate) - 1.0 / math.expm1(-low_s * rate) - 1.0 - ratio

    shortest, longest = math.log(min(high_s, low_s) / 500.0), math.log(high_s + low_s) + 30.0
    if not math.isfinite(ratio) or excess(shortest) >= 0.0 or excess(longest) <= 0.0:
        return None
    return math.exp(scipy.optimize.brentq(excess, shortest, longest, xtol=1e-14))


def _require_positive(**values: float) -> None:
    for name, value in values.items():
        if not 0.0 < value < math.inf:
            raise InputError("must be positive", field=name, value=value, remedy=f"Give {name} as measured.")
