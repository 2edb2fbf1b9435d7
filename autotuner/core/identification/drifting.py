"""A process that answers while its PV drifts: what the background may be, and the record with it taken out.

    pv(t) = response + offset + drift t            something from outside moves the PV on
    pv(t) = response + offset + motion from a state   the process itself has not settled yet

Both look alike for a while, because a slow lag and a line can stand in for each other. So a straight line is offered to
a process that settles only where the PV went along one before the first move of the output: a PV that bends there still
answers to an output from before the record.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.identification.backgrounds import Background, backgrounds
from autotuner.core.identification.static_gain import FEWEST_AT_REST, RESTLESS
from autotuner.core.signals.quiet import measure_quiet

if TYPE_CHECKING:
    from autotuner.core.identification.candidate import Candidate
    from autotuner.core.identification.data import Data
    from autotuner.core.recording import Recording

DRIFTING: tuple[Background, ...] = (
    ("offset",),
    ("offset", "before"),
    ("offset", "state"),
    ("offset", "drift"),
    ("offset", "drift", "state"),
)


def choices_of(data: Data, a0: float) -> tuple[Background, ...]:
    """Return the backgrounds that a recording may need, the widest last; `a0` as in `backgrounds`."""
    return DRIFTING if a0 > 0.0 and drifts_at_rest(data) else backgrounds(a0)


def drifts_at_rest(data: Data) -> bool:
    """Return whether the PV drifts before the output is moved for the first time."""
    if data.held.times.size < 2:
        return False
    quiet = data.t <= data.held.times[1]
    if int(quiet.sum()) < FEWEST_AT_REST:
        return False
    t, pv = data.t[quiet], data.pv[quiet]
    measured = measure_quiet(t, pv)
    off = pv - pv.mean() - measured.drift_per_s * (t - t.mean())
    return measured.drifts and float(np.std(off)) <= RESTLESS * measured.unsure


def levelled(recording: Recording, best: Candidate) -> Recording:
    """Return a recording without the background that a fit found in it, but for its offset."""
    problem, theta = best.solution.problem, best.solution.theta
    if len(problem.background) == 1 or not drifts_at_rest(problem.data):
        return recording
    gains = problem.structure.gains
    own = slice(gains + 1, problem.linear(theta).size - len(problem.data.others))
    return replace(recording, pv=recording.pv - problem.layout(theta).columns[:, own] @ problem.linear(theta)[own])
