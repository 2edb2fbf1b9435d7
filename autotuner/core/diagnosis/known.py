"""Measured disturbances come first: a further column of the record is knowledge, not a guess.

Process and disturbance are fitted together from a grid of time constants, because a process fitted without the
disturbance may lie far away from the one beside it.

    T = span/40, span/15, span/6, and 1/10, 1/3 of the time between moves;   second lag T/10, T/2;
    the disturbance behind a lag of its own
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.base import is_physical
from autotuner.core.diagnosis.extended import Extended, Fitted, fit, linearised
from autotuner.core.diagnosis.judge import is_helpful, weigh
from autotuner.core.diagnosis.search import better_of, refined
from autotuner.core.identification.structures import SECOND_ORDER

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.bench import Bench
    from autotuner.core.diagnosis.effect import Effect

MEASURED = frozenset({"measured_disturbance", "ambient"})
SLOW, SECOND = (1 / 40, 1 / 15, 1 / 6), (0.1, 0.5)
OF_MOVES, MANY_MOVES = (0.1, 0.35), 400
"""Shares of the median time between moves, and moves from which they tell nothing of the process."""
FOLLOWED, STEPS = 3, 15


def with_known(bench: Bench, alone: Fitted, effects: Sequence[Effect]) -> Fitted:
    """Return the process with the measured disturbances that help on the part not fitted; alone where none does.

    Parameters
    ----------
    bench : Bench
        The recording.
    alone : Fitted
        The process alone.
    effects : sequence of Effect
        The catalogue.
    """
    best = alone
    measured = [e for e in effects if e.name in MEASURED]
    for column in dict.fromkeys(e.group for e in measured):
        found = [_fitted_beside(bench, best, e) for e in measured if e.group == column]
        helpful = [f for f in found if f is not None and is_helpful(weigh(bench, best, f))]
        best = better_of(bench, helpful) if helpful else best
    return best


def _fitted_beside(bench: Bench, base: Fitted, effect: Effect) -> Fitted | None:
    problem = replace(
        base.problem, structure=SECOND_ORDER, effects=(*base.problem.effects, effect), rows=bench.screen, fixed=None
    )
    ranked = sorted(_starts(problem, base, effect), key=lambda theta: linearised(problem, theta))
    coarse = [fit(replace(problem, rows=bench.coarse), theta, STEPS) for theta in ranked[:FOLLOWED]]
    fine = [refined(bench, c) for c in sorted(coarse, key=lambda c: c.mean_square)[:2]]
    return min((f for f in fine if is_physical(f)), key=lambda f: f.mean_square, default=None)


def _starts(problem: Extended, base: Fitted, effect: Effect) -> list[np.ndarray]:
    span = problem.case.span_s
    _, _, values = base.problem.split(base.theta)
    others = [v for p in values for v in p]
    moves = problem.case.data.held.times
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
