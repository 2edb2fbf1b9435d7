"""Describing function: a process model from amplitude and period of a relay's limit cycle.

    N = 4h/(pi A) e^{-j asin(eps/A)},   w = 2 pi/Pu,   N G(jw) = -1

    FOPDT   T = sqrt((|N| K)^2 - 1)/w
            D = (pi - phi - atan(w T))/w
    SOPDT   m = (1 + |N| K cos(w D + phi))/w^2
            n = |N| K sin(w D + phi)/w,        T1,2 = n/2 +- sqrt(n^2/4 - m)

`h` half the relay's swing (output), `A` PV amplitude zero to peak, `Pu` period (s), `K` static gain (PV/output), `eps`
half width of the relay's dead zone (PV), `phi = asin(eps/A)`, `D`, `T`, `T1`, `T2`, `n` s, `m` s^2. With `eps` = 0:
thesis eqs. 3.2-3.6, 3.13, 3.14, 3.22, 3.23; hysteresis: Astrom and Hagglund, Automatica 20 (1984).

Whether `A` is the peak of the wave or its fundamental is the caller's choice. The peak carries the bias of the
describing function (Ku -19 % to +27 % for FOPDT); with the fundamental `|G(jw)| = 1/|N|` holds exactly, and only the
phase is approximate. The static gain is given: an oscillation alone does not show it.

Invariants: pure formulas; inputs that no process of the structure can have produced raise `InputError`.
"""

from __future__ import annotations

import math

from autotuner.core.model.process import Fopdt, SopdtOverdamped, SopdtUnderdamped, second_order
from autotuner.errors import InputError


def ultimate_point(h: float, A: float, Pu: float, eps: float = 0.0) -> tuple[complex, float]:
    """Return the relay's describing function `N` (output/PV) and the frequency `w` (rad/s).

    Parameters
    ----------
    h : float
        Half the relay's swing, output units. For unequal half periods pass `pi/4` times the amplitude of the relay
        wave's fundamental.
    A : float
        PV amplitude, zero to peak.
    Pu : float
        Period, s.
    eps : float
        Half width of the relay's dead zone, PV.

    Raises
    ------
    InputError
        A value is not positive, or the dead zone is wider than the oscillation.
    """
    for name, value in (("h", h), ("A", A), ("Pu", Pu)):
        if not 0.0 < value < math.inf:
            raise InputError("must be positive", field=name, value=value, remedy=f"Give {name} as measured.")
    if not 0.0 <= eps < A:
        raise InputError(
            f"must lie between 0 and the amplitude {A:g}",
            field="eps",
            value=eps,
            remedy="Give half the width of the relay's dead zone.",
        )
    magnitude, phase = 4.0 * h / (math.pi * A), -math.asin(eps / A)
    return complex(magnitude * math.cos(phase), magnitude * math.sin(phase)), 2.0 * math.pi / Pu


def fopdt(K: float, h: float, A: float, Pu: float, eps: float = 0.0) -> Fopdt:
    """Return the first-order process that oscillates with `A` and `Pu`.

    Raises
    ------
    InputError
        `|N K| <= 1`: no lag, however short, leaves that amplitude.
    """
    N, w = ultimate_point(h, A, Pu, eps)
    loop_gain = abs(N * K)
    if not loop_gain > 1.0:
        raise InputError(
            f"is no more than pi A/(4 h) = {1.0 / abs(N):g}: a first-order process would not attenuate so little",
            field="K",
            value=K,
            remedy="Check the static gain, or use the fundamental amplitude or the closed form.",
        )
    T = math.sqrt(loop_gain**2 - 1.0) / w
    D = (math.pi - math.asin(eps / A) - math.atan(w * T)) / w
    return Fopdt(K, T, D)


def sopdt(K: float, D: float, h: float, A: float, Pu: float, eps: float = 0.0) -> SopdtOverdamped | SopdtUnderdamped:
    """Return the second-order process with dead time `D` that oscillates with `A` and `Pu`.

    Raises
    ------
    InputError
        The dead time is negative, or does not go with this oscillation: `m` or `n` would not be positive.
    """
    N, w = ultimate_point(h, A, Pu, eps)
    if not 0.0 <= D < math.inf:
        raise InputError("must not be negative", field="D", value=D, remedy="Give the dead time in s.")
    loop_gain, angle = abs(N * K), w * D + math.asin(eps / A)
    m = (1.0 + loop_gain * math.cos(angle)) / w**2
    n = loop_gain * math.sin(angle) / w
    if not (m > 0.0 and n > 0.0):
        raise InputError(
            f"does not go with a second-order process of period {Pu:g} s: m = {m:.4g} s^2 and n = {n:.4g} s, both must "
            "be positive",
            field="D",
            value=D,
            remedy="Check dead time and static gain, or use least squares.",
        )
    return second_order(K, m, n, D)
