"""A switched output, searched with a process of its own: the process alone takes its ripple up, and lies far away.

A command may count for a whole period. The misfit then jumps wherever a move of the output passes the begin of one, and
no slope leads from one period, or phase, to another. Between grids of them, ever finer about the closest, slopes lead
to the process.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.core.diagnosis.extended.extended_model import closest_first
from autotuner.core.diagnosis.extended.fitting import fit
from autotuner.core.diagnosis.search.joint.dynamics import closest, free_pair, shapes_with, starts_beside
from autotuner.core.diagnosis.search.joint.late_moves import PARTS, on_grids
from autotuner.core.diagnosis.search.search import within

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.extended.base import Base
    from autotuner.core.diagnosis.extended.effect import Effect
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext

PULSES = "time_proportioning"
STARTS, KEPT = 6, 2
"""Starts of each form that are walked from, and those of them that are followed to the finer grids."""
COARSE, FINE = ((1 / 6, 3), (1 / 24, 2)), ((1 / 18, 3), (1 / 72, 2))
FINER = (((1 / 54, 3), (1 / 216, 2)), ((1 / 162, 3), (1 / 648, 2)))
"""Grids about the closest: steps of the period in shares of it over the whole record, and of the phase in periods, with
how many to either side. A start lies within a twelfth of a period of its phase, and its period within half a period of
its own over the record."""
STEPS, ENOUGH = 8, 1e-3
"""Most steps along slopes between two grids, and the relative fall of the misfit at which they end."""


def with_switched_output(context: FitContext, base: Base, effects: Sequence[Effect]) -> list[Fitted]:
    """Return a time-proportioned output with a pair of lags that is searched for beside it, where that is closer."""
    pair = free_pair(base.origins)
    if pair is None:
        return []
    walked = []
    for form in [e for e in effects if e.name == PULSES]:
        begun = starts_beside(context, pair, [form], shapes_with(base))[:STARTS]
        near = closest_first(_walked(context, start, (COARSE, FINE)) for start in within(context.dataset.budget, begun))
        walked += [_walked(context, c, FINER) for c in within(context.dataset.budget, near[:KEPT])]
    return closest(context, walked, pair)


def _walked(context: FitContext, start: Fitted, grids: Sequence[tuple[tuple[float, int], tuple[float, int]]]) -> Fitted:
    """Return the closest that slopes and grids lead to by turns."""
    for periods, phases in grids:
        start = fit(start.problem, start.theta, STEPS, ENOUGH)
        start = closest_first([start, *on_grids(context, start, PARTS[:1], periods, phases)])[0]
    return start
