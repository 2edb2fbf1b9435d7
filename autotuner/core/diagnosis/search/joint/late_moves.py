"""Moves that arrive late: by times of their own where an actuator takes its command over at uneven times.

Of a move, only the time is searched, which is one number for each: many, so that they are accepted where nothing else
explains the record.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effects.actuator.flow_delay import dead_time_jump
from autotuner.core.diagnosis.effects.actuator.textbook_forms import updated_every
from autotuner.core.diagnosis.effects.actuator.update_jitter import FEWEST, grids_of_times, one_later, uneven_updates
from autotuner.core.diagnosis.extended.base import is_physical
from autotuner.core.diagnosis.extended.extended_model import closest_first, plainness, without_rounding
from autotuner.core.diagnosis.extended.fitting import fit
from autotuner.core.diagnosis.search.acceptance import is_accepted, is_noise
from autotuner.core.diagnosis.search.exchange import exchanged, first_number, values_of
from autotuner.core.diagnosis.search.joint.times_of_updates import with_times_of_updates
from autotuner.core.diagnosis.search.judge import VISIBLE, is_near_noise, is_visible, noise_of
from autotuner.core.diagnosis.search.search import (
    AS_NEAR,
    best_on_both_parts,
    extend,
    first_of_each,
    refined,
    with_second_lag,
    within,
)
from autotuner.core.model.structures import FOPDT, SECOND_ORDER

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.extended.base import Base
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext

UNEVEN, WORSE = 0.6, 1.25
"""Ratio of misfits below which delays of every move, many parameters, are accepted; and the largest ratio on
the held-out part, whose moves have their own delays."""
LATE = 1.5
"""Smallest spread of the delays, in samples."""
TRIED_TIMES, ONE_BY_ONE = (-1.0, -0.6, -0.3, 0.0, 0.3, 0.6, 1.0), 15
"""Delays of a move that are tried, relative to the longest, and the most steps of the optimiser after it."""
HELD = 5
"""Closest explanations among which updates, or pulses, at even times are looked at again."""
PARTS = (1.0, 1.5, 0.5, 1.0 / 3.0, 2.0)
"""Other periods, over the one that was found: moves at updates of one may fall on those of another."""
GRIDS = (
    (PARTS, (0.04, 25), (1 / 8, 4)),
    (PARTS[:1], (0.02, 12), (1 / 32, 16)),
    (PARTS[:1], (0.01, 6), (1 / 64, 8)),
    (PARTS[:1], (0.003, 8), (1 / 256, 12)),
)
"""What is tried, ever finer: periods over the one found; around each, steps in shares of it over the whole record, and
steps of the phase in periods, with how many of them to either side. With many moves, one is near the next update for
each small step."""
FOLLOWED = 2
"""Forms of even times that are followed to finer periods."""
FLOW, PAIR = "flow_delay", 2
"""Effect that delays of every move may replace, and the fewest moves for which it is tried."""


def with_uneven_updates(context: FitContext, base: Base, best: Fitted) -> tuple[Fitted, list[Fitted]]:
    """Return delays of single moves as explanation of a record that nothing else explains."""
    named = bool(best.problem.effects)
    updated = any(effect.clocked for effect in best.problem.effects) and context.dataset.in_loop
    if named and (is_near_noise(context, best) if updated else not is_visible(context, best)):
        return best, []
    most = context.held_out_error(best) if named else WORSE * context.held_out_error(base.best)
    found = with_own_times(context, base)
    if not context.dataset.in_loop:
        found += [even for timed in found[:1] for even in _on_a_grid(context, timed)]
    inflated = min((context.colour(c) for c in found), default=1.0)
    better = [c for c in found if context.criterion(c, inflated) < context.criterion(best, inflated)]
    better = [c for c in better if c.rms < _most_left(best, c) * best.rms and _spread_of_times(c) > LATE]
    accepted = [c for c in better if is_accepted(context, base, base.best, c) and _is_as_good(context, c, most)]
    return next(iter(without_rounding(accepted, lambda c: _surprise(context, c), plainness)), best), found


def with_own_times(context: FitContext, base: Base, fewest: int = FEWEST) -> list[Fitted]:
    """Return the process with delays of single moves; in a loop, whose every sample has one, with times of updates."""
    if context.dataset.budget.spent:
        return []
    if context.dataset.in_loop:
        return [*with_times_of_updates(context, base)]
    origins = {id(o): o for o in (base.best, *base.origins[:1])}.values()
    timed = [(origin, uneven_updates(origin, context.coarse, fewest)) for origin in origins]
    found = [c for origin, effect in timed if effect is not None for c in extend(context, [origin], [effect])]
    return closest_first([*found, *(_move_by_move(context, c) for c in closest_first(found)[:1])])


def _move_by_move(context: FitContext, timed: Fitted) -> Fitted:
    """Return latenesses searched for one after the other, then together: a move that the next one swallowed is far off.

    A slope does not lead there, because a move that has no effect has no slope.
    """
    if is_near_noise(context, timed) or context.dataset.budget.spent:
        return timed
    problem, dataset = replace(timed.problem, rows=context.screen), context.dataset
    first = len(problem.structure.shape) + 1
    steps = dataset.data.held.steps[1 : timed.theta.size - first + 1]
    unit, most = dataset.data.interval_s / problem.unit_s, problem.searched[-1].high
    best = fit(problem, timed.theta, 0)
    for k in within(dataset.budget, np.argsort(-np.abs(steps))):
        tried = [one_later(best.theta, int(k), most * share, first, steps, unit) for share in TRIED_TIMES]
        best = closest_first([best, *(fit(problem, theta, 0) for theta in tried)])[0]
    again = [fit(replace(problem, rows=context.fine), best.theta, ONE_BY_ONE)]
    if problem.structure is FOPDT:
        pair = replace(problem, structure=SECOND_ORDER, rows=context.fine)
        again.append(fit(pair, with_second_lag(best.theta), ONE_BY_ONE))
    return closest_first([timed, *filter(is_physical, again)])[0]


def _on_a_grid(context: FitContext, timed: Fitted) -> list[Fitted]:
    """Return the process with updates at even times that the latenesses of the moves suggest."""
    grids = grids_of_times(timed)
    head = timed.theta[: len(timed.problem.structure.shape) + 1]
    origin = fit(replace(timed.problem, effects=(), rows=context.coarse), head, 0)
    return extend(context, [origin], [updated_every(context.dataset, grids)]) if grids else []


def with_other_grids(context: FitContext, found: Sequence[Fitted]) -> list[Fitted]:
    """Return the closest explanation by even times with other periods and phases, where it leaves more than noise.

    These are of updates, or of pulses, in each of their forms. A move that reaches another one is a jump of the misfit,
    beyond which no slope leads. Several grids may explain the fitted part as well, until a move of the other part shows
    which of them it is.
    """
    held = next((c for c in found[:HELD] if any(e.clocked for e in c.problem.effects)), None)
    if held is None or is_noise(context, held) or context.dataset.budget.spent:
        return []
    grids: list[Fitted] = []
    in_forms = _in_clocked_forms(held)
    for parts, *around in GRIDS:
        tried = closest_first(
            c for one in in_forms for c in on_grids(context, one, parts if one is held else PARTS[:1], *around)
        )
        as_near = [c for c in tried if c.rms < AS_NEAR * tried[0].rms]
        chosen = {id(c): c for c in (*_closest_forms(tried), best_on_both_parts(context, as_near)[0])}
        fitted = closest_first(refined(context, c) for c in chosen.values())
        grids, in_forms = [*grids, *fitted], _closest_forms(fitted)
        if all(is_noise(context, c) for c in in_forms):  # the right form may come to its grid later than a near one
            break
    return [c for c in grids if is_physical(c)]


def _in_clocked_forms(held: Fitted) -> list[Fitted]:
    """Return an explanation by even times in each form of them, with the numbers that were found."""
    clocked = next(e for e in held.problem.effects if e.clocked)
    values = values_of(held, clocked)
    return [held, *(exchanged(held, clocked, form, values, 0) for form in clocked.other_forms)]


def _closest_forms(ranked: Sequence[Fitted]) -> list[Fitted]:
    """Return the closest explanation in each of the two closest forms."""
    return first_of_each(ranked, lambda candidate: candidate.keys)[:FOLLOWED]


def on_grids(
    context: FitContext,
    held: Fitted,
    parts: Sequence[float],
    periods: tuple[float, int],
    phases: tuple[float, int],
) -> list[Fitted]:
    """Return an explanation by even times with periods about parts of its own, and all moves as late in the mean."""
    problem, dead_time = replace(held.problem, rows=context.screen), len(held.problem.structure.shape)
    at = first_number(problem, next(e for e in problem.effects if e.clocked))
    period, phase = math.exp(held.theta[at]), float(held.theta[at + 1])
    tried = []
    for part, longer, later in product(parts, _about(*periods), _about(*phases)):
        other = period * part * (1.0 + longer * period * part / context.dataset.span_s)
        theta = held.theta.copy()
        theta[at : at + 2] = math.log(other), (phase * period / other + later) % 1.0
        theta[dead_time] += ((period - other) / 2.0 - later * other) / problem.unit_s
        tried.append(theta)
    return [fit(problem, theta, 0) for theta in tried if theta[dead_time] >= 0.0]


def _about(step: float, each_way: int) -> list[float]:
    return [step * k for k in range(-each_way, each_way + 1)]


def _spread_of_times(timed: Fitted) -> float:
    """Return how far apart the latenesses of the moves lie, in sample intervals."""
    times = timed.problem.split(timed.theta)[2][0]
    return float(np.ptp(times)) if len(times) > 2 else math.inf  # a grid has a period and a phase


def _left_over(context: FitContext, timed: Fitted) -> float:
    """Return the larger error of the two parts, over the error expected there if the explanation is right."""
    noise = noise_of(context, timed)
    return max(timed.rms / noise, context.held_out_error(timed) / context.expected(timed, noise))


def _surprise(context: FitContext, timed: Fitted) -> float:
    """Return the negative log likelihood of a sample of the held-out part, for a normal distribution of expected width.

    Even updates predict the times of the moves; uneven ones predict their spread.
    """
    expected = context.expected(timed, noise_of(context, timed))
    return math.log(expected) + (context.held_out_error(timed) / expected) ** 2 / 2.0


def _is_as_good(context: FitContext, timed: Fitted, most: float) -> bool:
    """Return whether updates leave no more of the part not fitted than others do, or than unknown latenesses make."""
    return context.held_out_error(timed) < most or _left_over(context, timed) < VISIBLE


def _most_left(best: Fitted, timed: Fitted) -> float:
    """Return the misfit over that of the best explanation under which updates are accepted.

    Those at even times are two numbers, and one effect: they need not be much closer than several effects together. In
    a loop, the times of the other part are found beside the same process, which shows more than the misfit.
    """
    even = timed.problem.effects[0].form != "uneven"
    in_loop = timed.problem.dataset.in_loop
    return 1.0 if in_loop or (even and len(best.names) > 1) else UNEVEN


def late_instead(context: FitContext, base: Base, chosen: Fitted) -> list[Fitted]:
    """Return moves that are late by times of their own, and a dead time that jumps between two of them.

    Where no further move separates them from another effect, all are reported.
    """
    few = bool(chosen.problem.effects) and context.dataset.data.held.times.size <= FEWEST
    if not few and FLOW not in chosen.names:
        return []
    jump = extend(context, base.origins, [dead_time_jump(context.dataset, fewest=1)])
    return [*with_own_times(context, base, PAIR), *jump]
