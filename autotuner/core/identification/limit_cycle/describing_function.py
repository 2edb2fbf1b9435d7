"""Describing function: a process model from amplitude and period of a relay's limit cycle.

    N = 4h/(pi A) e^{-j asin(eps/A)},   w = 2 pi/Pu,   M G(jw) = -1,   M = N + Gc(jw)

    FOPDT   T = sqrt((|M| K)^2 - 1)/w
            D = (pi + arg M - atan(w T))/w
    SOPDT   m = (1 + |M| K cos(w D - arg M))/w^2
            n = |M| K sin(w D - arg M)/w,      T1,2 = n/2 +- sqrt(n^2/4 - m)

`h` half the relay's swing (output), `A` PV amplitude zero to peak, `Pu` period (s), `K` static gain (PV/output), `eps`
half width of the relay's dead zone (PV), `D`, `T`, `T1`, `T2`, `n` s, `m` s^2. `Gc` is the frequency response from
error to output (output/PV) of a controller in parallel with the relay, 0 without one: the bias of the describing
function shrinks with the relay's share of `M`. Thesis section 1.3.2 with eqs. 3.2-3.6, 3.13-3.23; hysteresis: Astrom
and Hagglund, Automatica 20 (1984).

Whether `A` is the peak of the wave or its fundamental is the caller's choice. The peak carries the bias of the
describing function (Ku -19 % to +27 % for FOPDT); with the fundamental `|G(jw)| = 1/|N|` holds exactly, and only the
phase is approximate. The static gain is given: an oscillation alone does not show it.

Invariants: pure formulas; inputs that no process of the structure can have produced raise `InputError`.
"""

from __future__ import annotations

import cmath
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


def fopdt(K: float, h: float, A: float, Pu: float, eps: float = 0.0, controller: complex = 0.0) -> Fopdt:
    """Return the first-order process that oscillates with `A` and `Pu`.

    Parameters
    ----------
    K : float
        Static gain, PV/output.
    h, A, Pu, eps : float
        As in `ultimate_point`.
    controller : complex
        `Gc(jw)` at `w = 2 pi/Pu`, output/PV.

    Raises
    ------
    InputError
        `|M K| <= 1`: no lag, however short, leaves that amplitude; or the phase leaves no room for a dead time.
    """
    N, w = ultimate_point(h, A, Pu, eps)
    M = N + controller
    loop_gain = abs(M * K)
    if not loop_gain > 1.0:
        raise InputError(
            f"is no more than {1.0 / abs(M):g}: a first-order process would not attenuate so little",
            field="K",
            value=K,
            remedy="Check static gain and controller gains, use the fundamental amplitude, or use the closed form.",
        )
    T = math.sqrt(loop_gain**2 - 1.0) / w
    D = (math.pi + cmath.phase(M) - math.atan(w * T)) / w
    if D < 0.0:
        raise InputError(
            f"leaves a dead time of {D:g} s",
            field="controller",
            value=[controller.real, controller.imag],
            remedy="Check controller gains and dead zone: with these the process would answer before its input moves.",
        )
    return Fopdt(K, T, D)


def sopdt(
    K: float, D: float, h: float, A: float, Pu: float, eps: float = 0.0, controller: complex = 0.0
) -> SopdtOverdamped | SopdtUnderdamped:
    """Return the second-order process with dead time `D` that oscillates so; parameters as in `fopdt`.

    Raises
    ------
    InputError
        The dead time is negative, or does not go with this oscillation: `m` or `n` would not be positive.
    """
    N, w = ultimate_point(h, A, Pu, eps)
    if not 0.0 <= D < math.inf:
        raise InputError("must not be negative", field="D", value=D, remedy="Give the dead time in s.")
    turned = abs(K) * (N + controller) * cmath.exp(-1j * w * D)
    m, n = (1.0 + turned.real) / w**2, -turned.imag / w
    if not (m > 0.0 and n > 0.0):
        raise InputError(
            f"does not go with a second-order process of period {Pu:g} s: m = {m:.4g} s^2 and n = {n:.4g} s, both must "
            "be positive",
            field="D",
            value=D,
            remedy="Check dead time, static gain and controller gains, or use least squares.",
        )
    return second_order(K, m, n, D)
