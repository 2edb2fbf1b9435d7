"""Numbers that a record shows between two limits only, and where between them they are most likely.

    phase    (t_k - t_0)/P - n_k <= phase < (t_k - t_0)/P - n_k + 1       n_k the update that the k-th move finds
    band     |e_k| <= S where the valve sticks,  S < |e_k| where it slips

`P` period of the updates, s, `t_k` times of the moves, s; `S` band, `e_k` distance of the command from the position,
output units. All numbers within the limits explain the record alike; a later move shows which of them is right.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effects.actuator.friction import bands_alike
from autotuner.core.diagnosis.extended.fitting import fit
from autotuner.core.diagnosis.search.exchange import first_number, values_of

if TYPE_CHECKING:
    from autotuner.core.diagnosis.extended.effect import Effect
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.model.arrays import FloatArray

AS_WELL = 1e-4
"""Relative rise of the misfit that is none."""
OF_BANDS = 1.0 / 3.0
"""Where a band is likely between its limits: small ones are more frequent. A phase may be anywhere, so the middle."""


def most_likely(chosen: Fitted) -> Fitted:
    """Return an explanation with what the record leaves open of its only actuator effect at the most likely value."""
    actuator = [e for e in chosen.problem.effects if e.position is not None]
    likely = LIKELY.get(actuator[0].key) if len(actuator) == 1 else None
    if likely is None:
        return chosen
    found = fit(chosen.problem, likely(chosen, actuator[0]), 0)
    return found if found.misfit < chosen.misfit * (1.0 + AS_WELL) else chosen


def _phase(chosen: Fitted, updates: Effect) -> FloatArray:
    """Return `theta` with the middle phase; the dead time makes up for it."""
    problem, held = chosen.problem, chosen.problem.dataset.data.held
    log_period, phase = values_of(chosen, updates)
    period, delay_s = math.exp(log_period), problem.split(chosen.theta)[1]
    since = (held.times[1:] - held.times[0]) / period
    ahead = since - np.ceil(since - phase)
    latest = min(float(ahead.min()) + 1.0, phase + delay_s / period)
    later = (float(ahead.max()) + latest) / 2.0 - phase
    theta = chosen.theta.copy()
    theta[len(problem.structure.shape)] -= later * period / problem.unit_s
    theta[first_number(problem, updates) + 1] += later
    return theta


def _band(chosen: Fitted, sticking: Effect) -> FloatArray:
    """Return `theta` with a likely band, and as much left of it after a slip."""
    problem, at = chosen.problem, first_number(chosen.problem, sticking)
    band, left = values_of(chosen, sticking)
    swing = problem.dataset.swing
    low, high = (limit / swing for limit in bands_alike(problem.dataset.data.held, band * swing, left * band * swing))
    theta = chosen.theta.copy()
    if high < math.inf:
        theta[at] = low + OF_BANDS * (high - low)
        theta[at + 1] = left * band / theta[at]
    return theta


LIKELY = {"actuator_hold": _phase, "stiction": _band}
"""By the key of an effect, what returns `theta` with its likely number."""
