"""A process that responds while its PV drifts: choice of the background, and removal of the drift from the record.

    pv(t) = response + offset + drift t            an external disturbance moves the PV
    pv(t) = response + offset + free response      the process itself has not settled yet

Both are similar for a while, because a slow lag and a line can replace each other. A straight line is therefore
offered to a process that settles only where the PV followed one before the first move of the output (a PV that bends
there still responds to an output from before the record), or, where the record does not begin at rest, where most of
the line is not a free response of the process: an output that alternates much faster than the record is long excludes
a slow lag.

Beyond the samples to which it is fitted, a line has two forms:

    pv(t) = offset + drift t       where the residual about it is white, or it is that of the PV before any move
    pv(t) = offset + drift t_end   else: the disturbance wanders, and its last value is the forecast

(Box and Jenkins, Time Series Analysis, 1970: the forecast of integrated moving averages is flat.) `drift` PV/s.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.estimation.backgrounds import SETTLING, Background, backgrounds, floor_of
from autotuner.core.estimation.linear_least_squares import residual_after
from autotuner.core.model.zoh_input import unit_step
from autotuner.core.signals.noise import inflation, rms
from autotuner.core.signals.quiet import measure_quiet
from autotuner.core.signals.static_gain import FEWEST_AT_REST, RESTLESS, stands_still

if TYPE_CHECKING:
    from autotuner.core.estimation.candidate import Candidate
    from autotuner.core.estimation.data import Data
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.step_responses import Motion
    from autotuner.core.recording import Recording

DRIFTING: tuple[Background, ...] = (
    ("offset",),
    ("offset", "before"),
    ("offset", "state"),
    ("offset", "drift"),
    ("offset", "drift", "state"),
)

ITS_OWN = 0.75
"""Share of a straight line that the process's motions must leave, for the line to be distinguished from them."""
ABOUT = 2.0
"""Ratio of two slopes up to which they are of the same drift."""


def choices_of(data: Data, a0: float) -> tuple[Background, ...]:
    """Return the backgrounds that a recording may need, the widest last; `a0` as in `backgrounds`."""
    return DRIFTING if a0 > 0.0 and drift_at_rest(data) is not None else backgrounds(a0)


def choices_beside(
    motion: Motion, delay_s: float, data: Data, choices: tuple[Background, ...]
) -> tuple[Background, ...]:
    """Return the choices, with a straight line among them where it can be distinguished from the process.

    Parameters
    ----------
    motion : Motion
        The process's motion.
    delay_s : float
        Its dead time, s.
    data : Data
        The recording.
    choices : tuple of Background
        What is offered without.
    """
    if choices != SETTLING or starts_at_rest(data):
        return choices
    responses = [motion.forced(held, data.t - delay_s) for held in (data.held, unit_step(0.0))]
    moves = [column for pair in responses for columns in pair for column in columns]
    columns = data.balanced(np.column_stack((np.ones(data.t.size), *moves, *motion.free(data.t))))
    line = residual_after(columns[:, :1], data.balanced(data.t))
    residual = residual_after(columns, line)
    return DRIFTING if float(residual @ residual) > ITS_OWN * float(line @ line) else choices


def starts_at_rest(data: Data) -> bool:
    """Return whether the PV is at rest, within its noise, while the output has not changed yet."""
    if data.held.times.size < 2:
        return False
    quiet = data.t <= data.held.times[1]
    return stands_still(data.t[quiet], data.pv[quiet])


def drift_at_rest(data: Data) -> float | None:
    """Return how fast the PV drifts before the output is moved for the first time, PV/s; None where it does not."""
    if data.held.times.size < 2:
        return None
    quiet = data.t <= data.held.times[1]
    if int(quiet.sum()) < FEWEST_AT_REST:
        return None
    t, pv = data.t[quiet], data.pv[quiet]
    measured = measure_quiet(t, pv)
    deviation = pv - pv.mean() - measured.drift_per_s * (t - t.mean())
    drifts = measured.drifts and float(np.std(deviation)) <= RESTLESS * measured.unsure
    return measured.drift_per_s if drifts else None


def goes_straight_on(data: Data, slope_per_s: float, residual: FloatArray) -> bool:
    """Return whether a drift that was fitted to a part of a record continues as a line beyond it.

    Parameters
    ----------
    data : Data
        The recording.
    slope_per_s : float
        The drift, PV/s.
    residual : array of float
        What model and background leave of the part, PV.
    """
    if rms(residual) <= floor_of(data) or inflation(residual) == 1.0:
        return True
    seen_per_s = drift_at_rest(data)
    return seen_per_s is not None and 1.0 / ABOUT < slope_per_s / seen_per_s < ABOUT


def levelled(recording: Recording, best: Candidate) -> Recording:
    """Return a recording without the background that a fit found in it, but for its offset."""
    problem, theta = best.solution.problem, best.solution.theta
    settles_on_a_line = "drift" in problem.background and problem.structure.stiffness > 0.0
    if len(problem.background) == 1 or not (settles_on_a_line or drift_at_rest(problem.data) is not None):
        return recording
    gains = problem.structure.gains
    own = slice(gains + 1, problem.linear(theta).size - len(problem.data.others))
    return replace(recording, pv=recording.pv - problem.layout(theta).columns[:, own] @ problem.linear(theta)[own])


def output_before(best: Candidate) -> float | None:
    """Return the output before the record that a fit claims, as deviation from its first one; None where it does not.

    A state away from rest is that of an output which had been there for long.
    """
    problem, theta = best.solution.problem, best.solution.theta
    names, gain = problem.background, best.solution.gain
    if problem.structure.stiffness <= 0.0 or names[-1] not in {"before", "state"} or gain == 0.0:
        return None
    first = float(problem.linear(theta)[problem.structure.gains + len(names) - 1])
    return first / gain if names[-1] == "state" else -first / gain
