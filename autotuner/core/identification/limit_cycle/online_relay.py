"""A relay record with a parallel controller: the relay's own limit cycle, and the response of the controller.

    output = relay + v,   Gc(jw) = -V(jw)/Y(jw) over whole cycles

`v` the controller's part of the output, `Y` the fundamental of the PV. `Gc` is known from the gains; agreement with
the record proves that the controller was neither limited nor slewed, so that `(N + Gc) G = -1` is valid (see
`describing_function`). A sampled controller holds its output for the sample interval `d`, so that its response is

    Gc(jw) (1 - e^{-jwd})/(jwd)

Invariants: for a process of negative gain the controller changes its sign too, so all formulas use `|Kp|`; the loop
under control settles more slowly than the relay alone, and its period before its amplitude, therefore only the later
half of the steady cycles counts.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.design.gains import controller_response
from autotuner.core.experiment.parallel_controller import relay_part
from autotuner.core.signals.limit_cycle import measure_limit_cycle

if TYPE_CHECKING:
    from autotuner.core.design.gains import PidGains
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.recording import Recording
    from autotuner.core.signals.limit_cycle import LimitCycle


SAME_RESPONSE = 0.1
"""Relative difference of the two responses of the controller up to which they are the same."""
FEWEST_CYCLES = 2
"""Fewest cycles that are averaged."""


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
