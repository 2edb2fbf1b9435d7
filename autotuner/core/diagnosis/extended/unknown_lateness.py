"""Expected error by unknown delays of moves.

    var e(t) = s^2 sum_i (K du_i g'(t - t_i - D))^2,   over the moves without a fitted delay

`s` standard deviation of the delay, s, `g` unit-gain step response. An actuator that updates at
its own times delays moves by a known distribution, at unknown times: a correct model leaves this error.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.model.zoh_input import unit_step

if TYPE_CHECKING:
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import IntArray


def unknown_lateness(
    candidate: Fitted, dataset: Dataset, rows: IntArray, after_s: float, *, tested: bool = False
) -> float:
    """Return the root mean square error that unknown latenesses leave, PV; 0 without such an effect.

    Parameters
    ----------
    candidate : Fitted
        The process with its effects.
    dataset : Dataset
        The record, in the units and about the values of the candidate's own.
    rows : array of int
        Samples of the part that is judged.
    after_s : float
        Begin of that part, s.
    tested : bool
        Whether it is the test part: the phase of updates at even times, too, is a guess by then.
    """
    _, _, values = candidate.problem.split(candidate.theta)
    spread_s = 0.0
    for effect, p in zip(candidate.problem.effects, values, strict=True):
        if effect.lateness_s is not None and (tested or effect.unseen_after):
            spread_s = effect.lateness_s(p)
    if spread_s == 0.0 or not rows.size:
        return 0.0
    view = replace(candidate.problem, dataset=dataset).view(candidate.theta, rows)
    moves = view.position.times > after_s - view.delay_s
    since = (view.t - view.delay_s)[:, None] - view.position.times[moves]
    slope = view.motion.forced(unit_step(0.0), np.maximum(since, 0.0))[1][0]
    moved = np.where(since > 0.0, candidate.linear[0] * view.position.steps[moves] * slope, 0.0)
    return spread_s * math.sqrt(float(np.mean((moved**2).sum(axis=1))))
