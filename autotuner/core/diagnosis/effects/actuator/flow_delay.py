"""Dead time that depends on the flow: the actuator's flow passes a pipe, and a larger flow passes faster.

    integral of q over (t - L, t) = V,      q = q0 (1 + a u) > 0,      process input  u(t - L(t))

`L` lag, `u` position as deviation from its start, `a` relative change of the flow with it. With `V/q0` known, the dead
time at the first flow, a position that is taken at `t_i` leaves the pipe at

    t_i' = Q^-1(Q(t_i) + V/q0),     Q(t) = integral of 1 + a u

`Q` is straight between two moves, so that this is exact. (Zenger and Ylinen, IFAC World Congress 2002; the transport
delay of plug flow.)
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.effect import Effect, Place, Searched
from autotuner.core.model.zoh_input import HeldInput

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from autotuner.core.diagnosis.record.dataset import Dataset

LEAST_FLOW = 0.05
"""Smallest flow in a record over the first one: below, the content of the pipe hardly moves."""
MOST_CHANGE = 6.0
"""Largest change of the flow over the swing of the output, in first flows."""
STARTS = (-1.2, -0.5, 0.3, 0.7, 1.2, 2.0)
"""Changes of the flow over the swing to begin from."""


def flow_delay(dataset: Dataset) -> Effect:
    """Return the effect; the flow rises with the output, or falls as behind a bypass valve."""
    swing, levels = dataset.swing, dataset.data.held.levels / dataset.swing
    highest, lowest = max(float(levels.max()), 0.0), min(float(levels.min()), 0.0)
    most = min((1.0 - LEAST_FLOW) / max(-lowest, 1e-9), MOST_CHANGE)
    least = max(-(1.0 - LEAST_FLOW) / max(highest, 1e-9), -MOST_CHANGE)

    def transport(held: HeldInput, p: Sequence[float], delay_s: float, _: Dataset) -> HeldInput:
        return carried(held, p[0] / swing, delay_s)

    def sizes(p: Sequence[float], _c: Sequence[float], _g: float) -> Mapping[str, float]:
        slowest = 1.0 + min(p[0] * highest, p[0] * lowest)
        return {"flow_per_output": p[0] / swing, "longest_over_first": 1.0 / max(slowest, LEAST_FLOW)}

    return Effect(
        "flow_delay",
        Place.PROCESS,
        (Searched("change", least, most, 1e-4),),
        [(change,) for change in STARTS if least < change < most],
        sizes,
        transport=transport,
        order=3,
        group="timing",
    )


def carried(held: HeldInput, flow_per_output: float, delay_s: float) -> HeldInput:
    """Return a position as it leaves the pipe, the dead time at the first flow left out.

    Parameters
    ----------
    held : HeldInput
        The position, output units as deviation from its start.
    flow_per_output : float
        Relative change of the flow, 1/output.
    delay_s : float
        Dead time at the first flow, s.
    """
    flow = np.maximum(1.0 + flow_per_output * held.levels, LEAST_FLOW)
    passed = np.concatenate(([0.0], np.cumsum(flow[:-1] * np.diff(held.times))))
    leaves = passed + delay_s
    k = np.searchsorted(passed, leaves, side="right") - 1
    times = held.times[k] + (leaves - passed[k]) / flow[k] - delay_s
    times[0] = min(float(held.times[0]), float(times[1:].min(initial=np.inf)))  # an early arrival may precede it
    return HeldInput(times, held.levels)
