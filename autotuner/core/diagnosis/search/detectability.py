"""Detectability: effects that a record could not have shown, by adding each to the model at several sizes.

    hidden   |P (simulated with the effect - simulated without)| < h sigma sqrt(N),   P = I - Q Q'

`Q` spans columns and slopes of the model, so that effects that a different process would absorb do not count; `h`
makes the misfit `VISIBLE` times the noise, up to which a record is called adequate. Where the noise has a memory, all
of it is of predictions, and `sigma` is that of the innovations. Limits are hidden beyond the range of the record.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effects.actuator.friction import friction_effects
from autotuner.core.diagnosis.effects.actuator.textbook_forms import quantisation, rate_limit, updated_every
from autotuner.core.diagnosis.extended.effect import Effect, Place, Searched, View
from autotuner.core.diagnosis.extended.fitting import tangent
from autotuner.core.diagnosis.search.judge import VISIBLE
from autotuner.core.diagnosis.search.screen import fits_beside, theta_with
from autotuner.core.estimation.linear_least_squares import solve_linear
from autotuner.core.model.arrays import SMALLEST_DIVISOR
from autotuner.core.model.step_responses import Lag

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext
    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

SHARES = (0.005, 0.01, 0.02, 0.04, 0.07, 0.1, 0.15, 0.22, 0.33, 0.5)
"""Sizes tried: bands in swings, slow modes in gains of the process, update times and times of travel in fifths of the
median time between moves."""
GRAVE, GRAVE_TIME, GRAVE_SHARE = 0.05, 0.3, 0.1
"""Shares from which a hidden effect is reported with the verdict: of bands and steps, of times, and of the gain."""
SLOWER = 10.0
"""Time constant of a slow mode, such as that of a wall or a jacket, over the lags of the process."""
FEW_LEVELS, FEW_TURNS, MANY_MOVES = 4, 2, 2000


@dataclass(frozen=True, slots=True)
class Spot:
    """An undetectable effect, in words, and whether it is reported with the verdict."""

    words: str
    grave: bool


@dataclass(frozen=True, slots=True)
class _Doubt:
    """An effect with its values by share; of its sizes, `size` is described by `words`."""

    words: str
    size: str
    effect: Effect
    values: Sequence[tuple[float, ...]]
    grave: float = GRAVE


def blind_spots(context: FitContext, chosen: Fitted, noise: float) -> list[Spot]:
    """Return the undetectable effects of a record, the most important first.

    Parameters
    ----------
    context : FitContext
        The recording.
    chosen : Fitted
        The model that explains it.
    noise : float
        Standard deviation of the noise, PV.
    """
    dataset = context.dataset
    levels = np.unique(np.round(dataset.data.held.levels / max(dataset.swing, SMALLEST_DIVISOR), 2))
    turns = np.sign(np.diff(dataset.data.held.levels))
    never_turns = int(np.count_nonzero(np.diff(turns[turns != 0.0]))) < FEW_TURNS
    spots = []
    if never_turns:
        spots.append(Spot("play, sticking and other friction (the output never turns back)", grave=True))
    if levels.size < FEW_LEVELS:
        few = "curves, limits and unequal directions of the actuator (the output takes too few levels)"
        spots.append(Spot(few, grave=True))
    doubts = [*_doubts(dataset, friction=not never_turns), *_slow_mode(chosen)]
    spots += _hidden(context, chosen, noise, doubts)
    pv = dataset.data.pv + dataset.pv0
    low, high = dataset.output0 + dataset.data.held.levels.min(), dataset.output0 + dataset.data.held.levels.max()
    reached = f"limits beyond what it reached (output {low:.4g} to {high:.4g}, PV {pv.min():.4g} to {pv.max():.4g})"
    return sorted([*spots, Spot(reached, grave=False)], key=lambda s: not s.grave)


def _doubts(dataset: Dataset, *, friction: bool) -> list[_Doubt]:
    """Return the effects that may be hidden."""
    held = dataset.data.held
    doubts = []
    if friction:
        play, _, sticking, *_ = friction_effects(dataset)
        doubts += [
            _Doubt("play up to {size:g} of output", "width", play, [(s,) for s in SHARES]),
            _Doubt("sticking up to {size:g} of output", "band", sticking, [(s, 0.0) for s in SHARES]),
        ]
    steps = quantisation(dataset, "", [(0.1, 0.0)])
    doubts.append(_Doubt("steps of the actuator up to {size:g}", "step", steps, [(s, 0.25) for s in SHARES]))
    if held.times.size <= MANY_MOVES:
        between = float(np.median(np.diff(held.times)))
        travels = [s * between / 5.0 for s in SHARES]
        rates = [(-math.log(travel),) for travel in travels]
        doubts.append(
            _Doubt(
                "rate limits above {size:g} of output a second", "rate_per_s", rate_limit(dataset), rates, GRAVE_TIME
            )
        )
        updates = [(math.log(travel), 0.3) for travel in travels]
        updated = updated_every(dataset, [(1.0, 0.0)])
        doubts.append(_Doubt("update times of the actuator up to {size:g} s", "period_s", updated, updates, GRAVE_TIME))
    return doubts


def _slow_mode(chosen: Fitted) -> list[_Doubt]:
    """Return a slow mode that takes up a share of the gain of a process that settles; empty of any other one."""
    structure = chosen.problem.structure
    if structure.stiffness <= 0.0:
        return []
    shape, _, _ = chosen.problem.split(chosen.theta)
    slow = Lag(SLOWER * shape[0])

    def response(view: View, p: Sequence[float]) -> FloatArray:
        answer = slow.forced(view.input, view.t - view.delay_s)[0][0]
        result: FloatArray = (1.0 - p[0]) * view.forced(view.input) + p[0] * answer
        return result

    mode = Effect(
        "slow_mode",
        Place.PROCESS,
        (Searched("share", 0.0, 1.0),),
        [(share,) for share in SHARES],
        lambda p, _c, _g: {"percent": 100.0 * p[0]},
        response=response,
        group="soak",
    )
    words = f"slow modes of some {_rounded(slow.T):g} s up to {{size:g}} % of the gain"
    return [_Doubt(words, "percent", mode, mode.starts, GRAVE_SHARE)]


def _hidden(context: FitContext, chosen: Fitted, noise: float, doubts: Sequence[_Doubt]) -> list[Spot]:
    """Return the largest hidden size of each effect; omit effects whose sizes are all visible."""
    rows = context.coarse
    plain = replace(chosen.problem, rows=rows)
    columns, slopes = tangent(plain, chosen.theta)
    q, _ = solve_linear(np.hstack((columns, slopes)), plain.target)
    sigma = noise if plain.memory is None else chosen.rms  # noise with a memory hides what its innovations hide
    most = math.sqrt(VISIBLE**2 - 1.0) * math.hypot(sigma, context.dataset.floor)
    spots = []
    for doubt in (d for d in doubts if fits_beside(d.effect, plain.effects)):
        problem = plain.with_effect(doubt.effect)
        largest = None
        for share, values in zip(SHARES, doubt.values, strict=True):
            theta = theta_with(chosen, problem, doubt.effect, values)
            added = (problem.whitened(problem.columns(theta, problem.computed)[0]) - columns) @ chosen.linear
            added = added - q @ (q.T @ added)
            if math.sqrt(float(added @ added) / rows.size) < most:
                largest = share, doubt.effect.sizes(values, (), float(chosen.linear[0]))[doubt.size]
        if largest is not None:
            spots.append(Spot(doubt.words.format(size=_rounded(largest[1])), grave=largest[0] > doubt.grave))
    return spots


def _rounded(value: float) -> float:
    """Return a value to two digits."""
    return float(f"{value:.2g}")
