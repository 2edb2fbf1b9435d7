"""Expected error of a correct model by what the fitted samples leave open.

    var e(t) = s^2 sum_i (K du_i g'(t - t_i - D))^2,   over the moves without a fitted delay
    e(t) = y(t; seen again) - y(t),     updates of an actuator in a loop, as the selection part shows them
    var e(t) = sum_v p_v (y(t; v) - y(t))^2,     v values that the fitted samples do not distinguish, p_v likelihood

`s` standard deviation of the delay, s, `g` unit-gain step response, `y` simulated PV. An actuator that updates at its
own times delays moves by a known distribution, at unknown times. Steps of an actuator that round all outputs so far
alike round another one differently, and jumps between two samples leave a period open.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.fitting import fit
from autotuner.core.diagnosis.extended.seen_again import with_own_events
from autotuner.core.signals.noise import rms

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import IntArray


def error_left_open(
    candidate: Fitted, dataset: Dataset, rows: IntArray, after_s: float, *, tested: bool = False
) -> float:
    """Return the root mean square error that what is left open makes, PV; 0 where nothing is.

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
    if not rows.size:
        return 0.0
    late = _of_lateness(candidate, dataset, rows, after_s, tested=tested)
    return math.hypot(late, _of_values_alike(candidate, dataset, rows, after_s))


def _of_values_alike(candidate: Fitted, dataset: Dataset, rows: IntArray, after_s: float) -> float:
    """Return the root mean square difference to the same model with values that are alike until then, PV."""
    problem, at, squares = candidate.problem, len(candidate.problem.structure.shape) + 1, 0.0
    for effect, p in zip(problem.effects, problem.split(candidate.theta)[2], strict=True):
        values = [] if effect.alike is None else effect.alike(p, after_s)
        thetas = [np.concatenate((candidate.theta[:at], v, candidate.theta[at + len(p) :])) for v in values]
        squares += _mean_square([fit(problem, theta, 0) for theta in thetas], candidate, dataset, rows)
        at += len(p)
    return math.sqrt(squares)


def _mean_square(alike: Sequence[Fitted], candidate: Fitted, dataset: Dataset, rows: IntArray) -> float:
    """Return the mean square difference of models to a candidate, PV squared, each by its likelihood beside that."""
    if not alike:
        return 0.0
    here = candidate.on(dataset).simulated(rows)
    worse = np.maximum([other.mean_square - candidate.mean_square for other in alike], 0.0)
    likely = np.exp(-0.5 * candidate.residual.size * worse / candidate.misfit)
    squares = [float(np.mean(np.square(other.on(dataset).simulated(rows) - here))) for other in alike]
    return float(likely @ squares) / max(float(likely.sum()), 1.0)  # where all are unlikely, the candidate counts


def _of_lateness(candidate: Fitted, dataset: Dataset, rows: IntArray, after_s: float, *, tested: bool) -> float:
    """Return the root mean square error that unknown latenesses make, PV."""
    # The test part is not looked at: what is expected of it follows from what came before.
    seen = candidate if tested else with_own_events(candidate, dataset, int(rows[-1]) + 1)
    if seen is not candidate:
        return rms(seen.simulated(rows) - candidate.on(dataset).simulated(rows))
    _, _, values = candidate.problem.split(candidate.theta)
    spread_s = 0.0
    for effect, p in zip(candidate.problem.effects, values, strict=True):
        if effect.lateness_s is not None and (tested or effect.unseen_after):
            spread_s = effect.lateness_s(p)
    if spread_s == 0.0:
        return 0.0
    view = candidate.on(dataset).problem.view(candidate.theta, rows)
    moves = view.position.times > after_s - view.delay_s
    moved = candidate.linear[0] * view.slopes_with_times(view.position.times[moves], view.position.steps[moves])
    return spread_s * math.sqrt(float(np.mean((moved**2).sum(axis=1))))
