"""A relay record with a running controller in it: the relay's own limit cycle, and how the controller answered.

    output = relay + v,   Gc(jw) = -V(jw)/Y(jw) over whole cycles

`v` the controller's part of the output, `Y` the fundamental of the PV. `Gc` is known from the gains; that the record
shows the same says that the controller was neither limited nor slewed, so that `(N + Gc) G = -1` may be used.

Rule of this file: the loop under control settles more slowly than the relay alone, and its period before its
amplitude; so of the cycles that repeat the latest half counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from autotuner.core.identification.online import held_response, seen_response
from autotuner.core.parallel import relay_part
from autotuner.core.signals.limit_cycle import measure_limit_cycle

if TYPE_CHECKING:
    from autotuner.core.recording import Recording
    from autotuner.core.signals.limit_cycle import LimitCycle

SAME_RESPONSE = 0.1
"""Relative difference of the two responses of the controller up to which they are the same."""
FEWEST_CYCLES = 2


@dataclass(frozen=True, slots=True)
class Beside:
    """A controller beside a relay that oscillates.

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
        """Whether the controller acted as its gains say."""
        return abs(self.seen - self.declared) <= SAME_RESPONSE * abs(self.declared)


def controller_beside(recording: Recording) -> Beside | None:
    """Return what ran beside the relay, or None when nothing did or the relay shows no steady oscillation."""
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
