"""Updates of an actuator in a loop at uneven times, fitted in turn with the process.

The process alone has taken up the mean lateness of the updates as dead time, which is not known: the search begins with
a few. From what is left by a process that is far off, only few updates follow. Each process leads to better ones, and
these to a better process; in the end all times are fitted beside it. (Likeliest times: `updates_in_loop`.)
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effects.actuator.position_in_loop import shows_positions
from autotuner.core.diagnosis.effects.actuator.update_jitter import FEWEST
from autotuner.core.diagnosis.effects.actuator.updates_in_loop import beside, updates_in_loop
from autotuner.core.diagnosis.extended.base import is_physical
from autotuner.core.diagnosis.extended.extended_model import closest_first
from autotuner.core.diagnosis.extended.fitting import fit
from autotuner.core.diagnosis.extended.seen_again import left_to
from autotuner.core.diagnosis.search.joint.positions import with_two_lags
from autotuner.core.diagnosis.search.judge import is_near_noise, noise_of
from autotuner.core.diagnosis.search.search import COARSE_STEPS, QUICK_STEPS, within

if TYPE_CHECKING:
    from autotuner.core.diagnosis.extended.base import Base
    from autotuner.core.diagnosis.extended.effect import Effect
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext

LATE_BY = (0.0, 3.0, 6.0)
"""Mean lateness of the output with which the search begins, samples."""
FIRST_ROUNDS, MORE_ROUNDS, LAST_ROUNDS = 2, 5, 4
"""How often updates and process follow from each other: from each begin, from the best ones, and with all times
fitted."""
FOLLOWED = 2
"""How many of the processes that the first rounds come to are followed."""
HOPEFUL = 0.85
"""Error after the first rounds, over that of the process alone, from which there are no updates."""
NOT_YET = 0.7
"""Share of the error of a process that is taken for noise: the rest is that of updates not found yet."""


@lru_cache(maxsize=2)
def with_times_of_updates(context: FitContext, base: Base) -> tuple[Fitted, ...]:
    """Return the process with updates of the actuator at times of their own, the best; empty without any. Cached."""
    origins = [o for o in (base.best, *base.origins) if o.problem.structure.gains == 1]
    settled = [o for o in {id(o): o for o in origins}.values() if o.problem.structure.stiffness > 0.0]
    if not shows_positions(context.dataset) or not settled:
        return ()
    begins = [(o, late) for o in settled[:2] for late in LATE_BY]
    first = [
        _in_turn(context, _with_less_delay(origin, late), FIRST_ROUNDS, searched=False)
        for origin, late in within(context.dataset.budget, begins)
    ]
    found = closest_first(closest_first(of)[0] for of in first if of)
    if not found or found[0].rms > HOPEFUL * base.best.rms:
        return ()
    timed = [c for one in found[:FOLLOWED] for c in _followed(context, one)]
    physical = [c for c in timed if is_physical(c)]
    return (context.best(physical),) if physical else ()


def _with_less_delay(origin: Fitted, late: float) -> Fitted:
    """Return the process, its gain and background as they were, with less dead time by some samples."""
    theta, at = origin.theta.copy(), len(origin.problem.structure.shape)
    by = late * origin.problem.dataset.data.interval_s / origin.problem.unit_s
    theta[at] = max(theta[at] - by, 0.0)
    return replace(origin, theta=theta)


def _followed(context: FitContext, candidate: Fitted) -> list[Fitted]:
    """Return processes with all times fitted, from the closest that follows from a candidate with given ones."""
    more = _in_turn(context, candidate, MORE_ROUNDS, searched=False)
    return _in_turn(context, closest_first(more or [candidate])[0], LAST_ROUNDS, searched=True)


def _in_turn(context: FitContext, candidate: Fitted, rounds: int, *, searched: bool) -> list[Fitted]:
    """Return processes beside updates, each by those that follow from the one before; with all times fitted or not.

    With all times fitted, the search ends where only noise is left.
    """
    rows, steps = (context.fine, COARSE_STEPS) if searched else (context.coarse, QUICK_STEPS)
    found: list[Fitted] = []
    for _ in within(context.dataset.budget, range(rounds)):
        effect = _updated(context, candidate, searched=searched)
        if effect is None:
            break
        head = len(candidate.problem.structure.shape) + 1
        start = np.concatenate((candidate.theta[:head], effect.starts[0]))
        problem = replace(candidate.problem, effects=(effect,), rows=rows)
        candidate = with_two_lags(fit(problem, start, steps))
        found.append(candidate)
        if searched and is_near_noise(context, candidate):
            break
    return found


def _updated(context: FitContext, candidate: Fitted, *, searched: bool) -> Effect | None:
    """Return the likeliest updates beside the process of a candidate, as it is; None of too few."""
    seen = left_to(candidate, 0 if candidate.problem.effects else None, np.flatnonzero(context.dataset.fitted))
    updates = updates_in_loop(seen, max(NOT_YET * candidate.rms, noise_of(context, candidate)))
    return beside(seen, updates, searched=searched) if updates.size >= FEWEST else None
