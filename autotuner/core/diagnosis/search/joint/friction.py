"""Search for friction in the record of a closed loop, together with the process.

A valve that sticks under a controller makes the PV a square wave while the output ramps. No linear process fits
this, so there is no process alone from which a search for friction could start. Instead all bands are tried beside each
process of a grid (see `valve_bands`), and the best few are fitted jointly. A valve that slips earlier beside a longer
dead time looks much alike: bands around those that were found are tried with other dead times too, ever nearer.

A loop cycles about as far as its valve's band. One that its set point moves far shows a smaller band too: such a band
counts only where it leaves little but noise.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effects.actuator.friction import (
    LARGEST,
    LARGEST_LEFT,
    SMALLEST,
    SMALLEST_IN_LOOP,
    TURNING,
    play,
    sticking,
)
from autotuner.core.diagnosis.effects.process.friction import process_friction
from autotuner.core.diagnosis.effects.waves import lines_of_all, wave_at_the_input
from autotuner.core.diagnosis.extended.base import is_physical
from autotuner.core.diagnosis.extended.extended_model import Extended, Fitted, apart, closest_first, without_rounding
from autotuner.core.diagnosis.extended.fitting import fit, linearised
from autotuner.core.diagnosis.record.waiting import waiting_of
from autotuner.core.diagnosis.search.joint.valve_bands import Bands, bands_of
from autotuner.core.diagnosis.search.judge import is_visible
from autotuner.core.diagnosis.search.search import (
    alone_beside,
    best_on_both_parts,
    disturbances_of,
    extend,
    free_load_of,
    refined,
    with_second_lag,
    within,
)
from autotuner.core.model.structures import FOPDT, INTEGRATING, SECOND_ORDER

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.extended.base import Base
    from autotuner.core.diagnosis.extended.effect import Effect
    from autotuner.core.diagnosis.extended.fit_context import FitContext
    from autotuner.core.model.arrays import FloatArray, IntArray
    from autotuner.core.model.structures import Structure

LAGS, DELAYS = (2.5, 6.0, 15.0), (1.0, 3.0, 6.0)
"""In sample intervals."""
FOLLOWED, STEPS, FEW_STEPS = 3, 12, 6
TRAVELS, LEFT = np.geomspace(0.01, 2.0 * LARGEST, 150), np.array([0.0, 0.2, 0.4, 0.6, 0.8, 1.0])
"""Travels of the command between two slips that are tried, in swings, and what is left of a band after a slip."""
APART = 0.04
"""Least relative distance of two travels that are followed."""
AROUND = (
    (0.15, 31, 0.3, 9, (-3.0, -1.5, 0.0, 1.5)),
    (0.04, 25, 0.1, 9, (-1.0, 0.0, 1.0)),
    (0.01, 21, 0.02, 9, (0.0,)),
)
"""How far around a travel others are tried, as a share of it, and how many; the same for what is left of the band; and
other dead times, in sample intervals; ever nearer."""
NEARER = 0.9
"""Error over that of the process alone up to which bands are followed."""
WAVE_STEPS = 5
"""Most steps of the optimiser from each period of a wave."""
AXIS_LAGS, FAR, HALF = (5.0, 30.0), 3.0, 0.6
"""Lags of an axis to start from, in sample intervals; error over noise from which friction on the process is tried;
error after over before, on both parts, under which it is an explanation."""


def with_friction(context: FitContext, base: Base, effects: Sequence[Effect]) -> list[Fitted]:
    """Return processes with each kind of friction, fitted on all samples; none where no valve of a loop may stick."""
    if not _may_stick(context):
        return []
    turning = [e for e in effects if e.group == "friction" and e.form == TURNING]
    found = [_turning(context, base, effect) for effect in within(context.dataset.budget, turning)]
    found += _with_bands(context, base)
    return [f for f in found if is_physical(f) and _is_shown(context, base.best, f)]


def with_friction_beside_a_load(context: FitContext, base: Base, effects: Sequence[Effect]) -> list[Fitted]:
    """Return the same with a disturbance, found beside a load of free shape: neither is visible without the other.

    A load is also why the integral action moves the output on. Without it, a slow process follows the load instead, and
    no band predicts the slip.
    """
    free = free_load_of(effects)
    if free is None or not _may_stick(context):
        return []
    found = _with_bands(context, base, free)
    alone = [alone_beside(context, f, f.problem.effects[0]) for f in found]
    return extend(context, alone, disturbances_of(effects)) if alone else []


def _may_stick(context: FitContext) -> bool:
    """Return whether friction is searched with a process of its own: in a loop whose PV does not follow every move."""
    seen = waiting_of(context.dataset)
    return (context.dataset.in_loop or seen.sticks) and not seen.follows and not context.dataset.budget.spent


def _is_shown(context: FitContext, alone: Fitted, candidate: Fitted) -> bool:
    """Return whether bands are as wide as a loop cycles, or leave little but noise, and half of the rest elsewhere."""
    band = candidate.problem.split(candidate.theta)[2][0][0]
    if candidate.problem.effects[0].form == TURNING or band > SMALLEST_IN_LOOP:
        return True
    close = not is_visible(context, candidate)
    return close and context.held_out_error(candidate) < HALF * context.held_out_error(alone)


def _turning(context: FitContext, base: Base, effect: Effect) -> Fitted:
    """Return the best process of the grid, or beside the free one, with a valve that slips where the output turns."""
    problem = Extended(context.dataset, FOPDT, (effect,), context.screen, base.best.problem.background)
    grid = product(effect.starts, _processes(problem))  # the process last: positions are kept for a while
    ranked = closest_first(fit(problem, np.array([*process, *p]), 0) for p, process in grid)[:FOLLOWED]
    ranked += closest_first(_beside_the_free(context, base.origins[0], effect))[:FOLLOWED]
    coarse = [fit(replace(f.problem, rows=context.coarse), f.theta, STEPS) for f in ranked]
    return refined(context, closest_first(coarse)[0])


def _processes(problem: Extended) -> list[FloatArray]:
    """Return the processes of the grid, as `theta`."""
    interval = problem.dataset.data.interval_s
    return [np.array([math.log(T * interval), D * interval / problem.unit_s]) for T, D in product(LAGS, DELAYS)]


def _with_bands(context: FitContext, base: Base, load: Effect | None = None) -> list[Fitted]:
    """Return processes with a valve that sticks or has play: the closest with wide bands, and with narrow ones.

    With a load beside it only where they are wide.
    """
    dataset, beside = context.dataset, () if load is None else (load,)
    bands = Bands(dataset, *bands_of(TRAVELS, LEFT), context.coarse, base.best.problem.background, beside)
    alone = [o for o in (base.best, base.origins[0]) if o.problem.structure in (FOPDT, SECOND_ORDER)]
    processes = [(FOPDT, theta) for theta in _processes(base.best.problem)]
    processes += [(o.problem.structure, o.theta) for o in {id(o): o for o in alone}.values()]
    squares = np.stack([bands.squares(*process) for process in processes])
    loaded = (fit(replace(o.problem, effects=beside, rows=context.coarse), o.theta, FEW_STEPS) for o in base.origins)
    most = NEARER * (base.best if load is None else closest_first(loaded)[0]).rms
    found = []
    wide, plays = bands.bands > SMALLEST_IN_LOOP, bands.left == 1.0
    for lane in (wide & ~plays, *((~wide,) if load is None else ()), plays):
        starts = [
            _started(context, *processes[n], bands, m)
            for n, m in _apart(bands, np.where(lane & (bands.bands >= SMALLEST), squares, np.inf))
        ]
        coarse = [_in_detail(context, c) for c in within(dataset.budget, starts) if c.rms < most]
        found += [_as_good_elsewhere(context, refined(context, c)) for c in closest_first(coarse)[:1]]
    return found


def _as_good_elsewhere(context: FitContext, candidate: Fitted) -> Fitted:
    """Return friction with the bands nearby that are best on both parts: those with the same slips in one are alike."""
    travel, count, left, lefts, later = AROUND[-1]
    around = np.linspace(-travel, travel, count), np.linspace(-left, left, lefts)
    rows = np.union1d(context.coarse, context.held_out)
    return best_on_both_parts(context, [candidate, *_around(context, candidate, rows, *around, later)])[0]


def _apart(bands: Bands, squares: FloatArray) -> list[tuple[int, int]]:
    """Return process and bands of the smallest squares, at travels that lie apart."""
    travels, order = bands.bands * (1.0 + bands.left), np.argsort(squares.min(axis=0), kind="stable").tolist()
    kept = apart(order, lambda m, other: abs(travels[m] / travels[other] - 1.0), APART, FOLLOWED)
    return [(int(np.argmin(squares[:, m])), m) for m in kept]


def _started(context: FitContext, structure: Structure, theta: FloatArray, bands: Bands, m: int) -> Fitted:
    """Return a process of the grid with one of the bands, fitted."""
    S, f = float(bands.bands[m]), float(bands.left[m])
    effect, numbers = (play(context.dataset), [2.0 * S]) if f == 1.0 else (sticking(context.dataset), [S, f])
    problem = Extended(context.dataset, structure, (effect, *bands.beside), context.coarse, bands.background)
    return fit(problem, np.array([*theta, *numbers]), STEPS)


def _in_detail(context: FitContext, candidate: Fitted) -> Fitted:
    """Return friction with the best of the bands around its own, beside a process of one lag or two."""
    for travel, count, left, lefts, later in AROUND:
        around = np.linspace(-travel, travel, count), np.linspace(-left, left, lefts)
        nearer = _around(context, candidate, candidate.problem.rows, *around, later)
        candidate = closest_first([candidate, *nearer])[0]
        lags = len(candidate.problem.structure.shape)
        pair = candidate.theta if lags > 1 else with_second_lag(candidate.theta)
        again = fit(replace(candidate.problem, structure=SECOND_ORDER), pair, FEW_STEPS)
        candidate = again if again.rms < NEARER * candidate.rms else candidate
    return candidate


def _around(
    context: FitContext,
    candidate: Fitted,
    rows: IntArray,
    travels: FloatArray,
    left: FloatArray,
    later: Sequence[float],
) -> list[Fitted]:
    """Return friction with the few best of the bands around, by some samples, fitted to those of the candidate."""
    problem, at = candidate.problem, len(candidate.problem.structure.shape)
    process, numbers = candidate.theta[: at + 1], candidate.theta[at + 1 :]
    is_play = numbers.size == 1
    S, f = (numbers[0] / 2.0, 1.0) if is_play else numbers
    near = np.ones(1) if is_play else np.unique(np.clip(f + left, 0.0, LARGEST_LEFT))
    some = bands_of(S * (1.0 + f) * (1.0 + travels), near)
    bands = Bands(problem.dataset, *some, rows, problem.background, problem.effects[1:])
    sample = context.dataset.data.interval_s / problem.unit_s
    others = [np.array([*process[:at], max(process[at] + by * sample, 0.0)]) for by in later]
    squares = np.stack([bands.squares(problem.structure, other) for other in others])
    tried = []
    for n, m in np.argwhere(squares <= np.sort(squares, axis=None)[FOLLOWED - 1])[:FOLLOWED].tolist():
        found = [2.0 * bands.bands[m]] if is_play else [bands.bands[m], bands.left[m]]
        tried.append(fit(problem, np.array([*others[n], *found]), FEW_STEPS))
    return tried


def _beside_the_free(context: FitContext, origin: Fitted, effect: Effect) -> list[Fitted]:
    """Return the starts of friction beside a process that was found without: one that its set point moves is near."""
    if origin.problem.structure is not SECOND_ORDER:
        return []
    problem = replace(origin.problem, effects=(effect,), rows=context.screen)
    return [fit(problem, np.array([*origin.theta, *p]), 0) for p in effect.starts]


def with_process_friction(context: FitContext, alone: Fitted) -> list[Fitted]:
    """Return a lag and an integrating process with dry friction where that explains a record far better; else none.

    The process alone is not a start: with friction, a lag is identified as too short.
    """
    if (
        context.dataset.tuned
        or context.dataset.budget.spent
        or alone.rms < FAR * math.hypot(context.dataset.noise, context.dataset.floor)
    ):
        return []
    interval, found = context.dataset.data.interval_s, []
    for structure in (FOPDT, INTEGRATING):
        effect = process_friction(context.dataset)
        problem = Extended(context.dataset, structure, (effect,), context.screen)
        starts = [np.array([math.log(lag * interval), 0.0, *s]) for lag in AXIS_LAGS for s in effect.starts]
        ranked = without_rounding(starts, partial(linearised, problem))
        coarse = [fit(replace(problem, rows=context.coarse), theta, STEPS) for theta in ranked[:FOLLOWED]]
        nearest = closest_first(coarse)[0]
        if nearest.rms > alone.rms:
            continue
        alike = refined(context, nearest)
        each = replace(alike.problem, effects=(process_friction(context.dataset, by_direction=True),))
        beyond = len(structure.shape) + 3  # the process, Coulomb friction and constant are before the ratio
        found += [alike, fit(each, np.insert(alike.theta, beyond, 0.0), STEPS)]
    before = context.held_out_error(alone)
    return [
        f for f in found if is_physical(f) and f.rms < HALF * alone.rms and context.held_out_error(f) < HALF * before
    ]


def with_wave(context: FitContext, candidate: Fitted) -> list[Fitted]:
    """Return a process with dry friction with a periodic load beside it, the best one first; none without friction.

    Dry friction answers to the sum of the forces: beside it, a wave on the PV is none at the input. An axis integrates
    it twice, so that its period shows in the slope of the residual only.
    """
    if not any(e.name == "process_friction" for e in candidate.problem.effects) or context.dataset.budget.spent:
        return []
    dataset = context.dataset
    residual = dataset.data.pv - candidate.simulated(np.arange(dataset.data.t.size))
    lines = lines_of_all(dataset, [residual, np.gradient(residual, dataset.data.t)])
    problem = replace(candidate.problem, rows=context.coarse)
    starts = [np.array([*candidate.theta, math.log(line), 0.0, 0.0]) for line in lines]
    sine = replace(problem, effects=(*problem.effects, wave_at_the_input(dataset)))
    quick = closest_first(fit(sine, theta, WAVE_STEPS) for theta in within(dataset.budget, starts))
    if not quick:
        return []
    square = replace(problem, effects=(*problem.effects, wave_at_the_input(dataset, switched=True)))
    return [refined(context, c) for c in (quick[0], fit(square, quick[0].theta, WAVE_STEPS))]
