"""Measured disturbances come first: a further column of the record is knowledge, not a guess.

Process and disturbance are fitted together from a grid of time constants, because a process fitted without the
disturbance may be far from the true one. Of several columns the most helpful comes first, because they may
carry much the same information: a neighbour's heater and its temperature.

    T = span/40, span/15, span/6, and 1/10, 1/3 of the time between moves;   second lag T/10, T/2;
    the disturbance through its own lag
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.base import is_physical
from autotuner.core.diagnosis.extended.extended_model import Extended, Fitted, closest_first, without_rounding
from autotuner.core.diagnosis.extended.fitting import fit, linearised
from autotuner.core.diagnosis.search.judge import is_helpful, weigh
from autotuner.core.diagnosis.search.search import best_on_both_parts, better_of, refined
from autotuner.core.model.structures import SECOND_ORDER

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from autotuner.core.diagnosis.extended.effect import Effect
    from autotuner.core.diagnosis.extended.fit_context import FitContext

SLOW, SECOND = (1 / 40, 1 / 15, 1 / 6), (0.1, 0.5)
OF_MOVES, MANY_MOVES = (0.1, 0.35), 400
"""Shares of the median time between moves, and moves from which they show nothing of the process."""
FOLLOWED, STEPS = 3, 15


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """Explanation by the further columns of a record.

    Attributes
    ----------
    best : Fitted
        The process with the columns that help on the part not fitted; alone where none does.
    tried : mapping of str to Fitted
        By column, the process with that column alone that comes nearest on both parts.
    """

    best: Fitted
    tried: Mapping[str, Fitted]


def with_known(context: FitContext, alone: Fitted, effects: Sequence[Effect]) -> Known:
    """Return the process with the measured disturbances that help on the part not fitted, the most helpful first."""
    best, tried = alone, dict[str, Fitted]()
    measured = [e for e in effects if e.measured]
    while measured:
        found = [f for e in measured if (f := _fitted_beside(context, best, e)) is not None]
        tried = tried or _by_column(context, found)
        helpful = [f for f in found if is_helpful(weigh(context, best, f))]
        if not helpful:
            break
        best = better_of(context, helpful)
        measured = [e for e in measured if e.group != best.problem.effects[-1].group]
    return Known(best, tried)


def _by_column(context: FitContext, found: Sequence[Fitted]) -> dict[str, Fitted]:
    columns = dict.fromkeys(f.problem.effects[-1].group for f in found)
    return {
        column: best_on_both_parts(context, (f for f in found if f.problem.effects[-1].group == column))[0]
        for column in columns
    }


def of_columns(context: FitContext, alone: Fitted, tried: Mapping[str, Fitted], chosen: Fitted) -> list[str]:
    """Return notes on the columns that were not accepted, with their possible influence."""
    taken = {e.group for e in chosen.problem.effects}
    return [
        f"{column} is not taken in: with it alone the error is {f.rms:.4g} on the fitted part ({alone.rms:.4g} without)"
        f" and {context.held_out_error(f):.4g} on the other ({context.held_out_error(alone):.4g})"
        for column, f in tried.items()
        if column not in taken
    ]


def _fitted_beside(context: FitContext, base: Fitted, effect: Effect) -> Fitted | None:
    problem = replace(
        base.problem, structure=SECOND_ORDER, effects=(*base.problem.effects, effect), rows=context.screen, fixed=None
    )
    ranked = without_rounding(_starts(problem, base, effect), lambda theta: linearised(problem, theta))
    coarse = [fit(replace(problem, rows=context.coarse), theta, STEPS) for theta in ranked[:FOLLOWED]]
    fine = [refined(context, c) for c in closest_first(coarse)[:2]]
    return next(iter(closest_first(f for f in fine if is_physical(f))), None)


def _starts(problem: Extended, base: Fitted, effect: Effect) -> list[np.ndarray]:
    span = problem.dataset.span_s
    _, _, values = base.problem.split(base.theta)
    others = [v for p in values for v in p]
    moves = problem.dataset.data.held.times
    between = float(np.median(np.diff(moves))) if 2 < moves.size < MANY_MOVES else 0.0
    lags = [*(share * span for share in SLOW), *(share * between for share in OF_MOVES if between > 0.0)]
    grid = product(lags, SECOND, (0.0, 1.0), effect.starts)
    starts = [
        np.array([math.log(T * (1.0 + b)), math.log(T * b / (1.0 + b)), delay, *others, *start])
        for T, b, delay, start in grid
    ]
    if base.problem.structure is SECOND_ORDER:
        starts += [np.array([*base.theta, *start]) for start in effect.starts]
    return starts
