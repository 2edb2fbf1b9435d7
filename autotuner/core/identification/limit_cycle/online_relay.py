"""Describing function of a relay in parallel with a controller: a process model from amplitude and period.

    (N + Gc(jw)) G(jw) = -1,   M = N + Gc(jw),   N = 4h/(pi A) e^{-j asin(eps/A)},   w = 2 pi/Pu

    FOPDT   T = sqrt((|M| K)^2 - 1)/w
            D = (pi + arg M - atan(w T))/w
    SOPDT   m = (1 + |M| K cos(w D - arg M))/w^2
            n = |M| K sin(w D - arg M)/w,      T1,2 = n/2 +- sqrt(n^2/4 - m)

`h` half the relay's swing (output), `A` PV amplitude zero to peak, `Pu` period (s), `K` static gain (PV/output), `eps`
half width of the relay's dead zone (PV), `Gc(jw)` frequency response of the controller from error to output
(output/PV), `D`, `T`, `T1`, `T2`, `n` s, `m` s^2. Thesis section 1.3.2 with eqs. 3.2-3.6 and 3.16-3.23; without a
controller these are the formulas of `describing_function`.

A sampled controller holds its output for the sample interval `d`, so that its response is

    Gc(jw) (1 - e^{-jwd})/(jwd)

and the bias of the describing function shrinks with the relay's share of `M`, because only the relay is approximated.

Invariants: pure formulas; inputs that no process of the structure can have produced raise `InputError`; for a
process of negative gain, relay and controller change their sign too, so all formulas use `|K|` and `|Kp|`.

A relay record with a parallel controller: the relay's own limit cycle, and the response of the controller.

    output = relay + v,   Gc(jw) = -V(jw)/Y(jw) over whole cycles

`v` the controller's part of the output, `Y` the fundamental of the PV. `Gc` is known from the gains; agreement with
the record proves that the controller was neither limited nor slewed, so that `(N + Gc) G = -1` is valid.

Invariant: the loop under control settles more slowly than the relay alone, and its period before its
amplitude; therefore only the later half of the steady cycles counts.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.design.gains import controller_response
from autotuner.core.experiment.parallel_controller import relay_part
from autotuner.core.identification.limit_cycle.describing_function import ultimate_point
from autotuner.core.model.process import Fopdt, SopdtOverdamped, SopdtUnderdamped, second_order
from autotuner.core.signals.limit_cycle import measure_limit_cycle
from autotuner.errors import InputError

if TYPE_CHECKING:
    from autotuner.core.design.gains import PidGains
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.recording import Recording
    from autotuner.core.signals.limit_cycle import LimitCycle


def fopdt(K: float, h: float, A: float, Pu: float, controller: complex, eps: float = 0.0) -> Fopdt:
    """Return the first-order process that oscillates with `A` and `Pu` under relay and controller.

    Parameters
    ----------
    K : float
        Static gain, PV/output.
    h, A, Pu, eps : float
        As in `describing_function.ultimate_point`.
    controller : complex
        `Gc(jw)` at `w = 2 pi/Pu`, output/PV; see `held_response`.

    Raises
    ------
    InputError
        `|M K| <= 1`, or the phase leaves no room for a dead time.
    """
    M, w = _inverse_response(h, A, Pu, controller, eps)
    loop_gain = abs(M * K)
    if not loop_gain > 1.0:
        raise InputError(
            f"is no more than 1/|N + Gc| = {1.0 / abs(M):g}: a first-order process would not attenuate so little",
            field="K",
            value=K,
            remedy="Check static gain and controller gains, or use least squares.",
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
    K: float, D: float, h: float, A: float, Pu: float, controller: complex, eps: float = 0.0
) -> SopdtOverdamped | SopdtUnderdamped:
    """Return the second-order process with dead time `D` that oscillates so; parameters as in `fopdt`.

    Raises
    ------
    InputError
        The dead time is negative, or does not go with this oscillation: `m` or `n` would not be positive.
    """
    M, w = _inverse_response(h, A, Pu, controller, eps)
    if not 0.0 <= D < math.inf:
        raise InputError("must not be negative", field="D", value=D, remedy="Give the dead time in s.")
    turned = abs(K) * M * cmath.exp(-1j * w * D)
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


def held_response(gains: PidGains, Pu: float, interval_s: float) -> complex:
    """Return `Gc(jw)` of a controller that holds its output between samples, for a process of positive gain.

    Parameters
    ----------
    gains : PidGains
        The controller.
    Pu : float
        Period of the oscillation, s.
    interval_s : float
        Time between two samples, s; 0 for a continuous controller.
    """
    w = 2.0 * math.pi / Pu
    turn = w * interval_s
    held = cmath.exp(-0.5j * turn) * float(np.sinc(turn / (2.0 * math.pi)))
    return math.copysign(1.0, gains.Kp) * complex(controller_response(gains, np.array([w]))[0]) * held


def seen_response(t: FloatArray, pv: FloatArray, part: FloatArray, Pu: float) -> complex:
    """Return the response of a controller as its part of the output shows it: its fundamental over that of `-pv`.

    Parameters
    ----------
    t, pv, part : array of float, shape (N,)
        Samples over whole periods, s, PV and output units; `part` is held from each sample to the next.
    Pu : float
        Period, s.
    """
    w = 2.0 * math.pi / Pu
    turns = np.exp(-1j * w * t)
    answered = np.trapezoid((pv - pv.mean()) * turns, t)
    acted = (part[:-1] - part[:-1].mean()) @ np.diff(turns) / (-1j * w)
    return complex(-acted / answered)


def _inverse_response(h: float, A: float, Pu: float, controller: complex, eps: float) -> tuple[complex, float]:
    """Return `M = -1/G(jw)`, output/PV, and `w`, rad/s."""
    N, w = ultimate_point(h, A, Pu, eps)
    return N + controller, w


SAME_RESPONSE = 0.1
"""Relative difference of the two responses of the controller up to which they are the same."""
FEWEST_CYCLES = 2
"""Fewest cycles that are averaged."""


@dataclass(frozen=True, slots=True)
class Beside:
    """A controller in parallel with an oscillating relay.

    Attributes
    ----------
    cycle : LimitCycle
        The relay's limit cycle.
    declared, seen : complex
        Response of the controller at its period, output/PV: from its gains, and from the record.
    """

    cycle: LimitCycle
    declared: complex
    seen: complex

    @property
    def as_declared(self) -> bool:
        """Whether the controller acted according to its gains."""
        return abs(self.seen - self.declared) <= SAME_RESPONSE * abs(self.declared)


def controller_beside(recording: Recording) -> Beside | None:
    """Return the parallel controller, or None without one, or without a steady oscillation of the relay."""
    part = relay_part(recording)
    cycle = None if part is None else _settled_cycle(part.recording)
    if part is None or cycle is None:
        return None
    rows = (recording.t >= cycle.start_s) & (recording.t <= cycle.end_s)
    own = part.recording.window(cycle.start_s, cycle.end_s)
    return Beside(
        replace(cycle, alone=False),
        held_response(part.gains, cycle.Pu, recording.sample_interval_s),
        seen_response(own.t, own.pv, recording.output[rows] - own.output, cycle.Pu) * math.copysign(1.0, part.gains.Kp),
    )


def _settled_cycle(relay: Recording) -> LimitCycle | None:
    cycle = measure_limit_cycle(relay)
    if cycle is None or cycle.cycles <= FEWEST_CYCLES:
        return cycle
    counted = max(FEWEST_CYCLES, math.ceil(cycle.cycles / 2))
    return measure_limit_cycle(relay.window(cycle.end_s - (counted + 0.25) * cycle.Pu, cycle.end_s))
