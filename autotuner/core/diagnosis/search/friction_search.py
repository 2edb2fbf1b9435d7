"""Search for friction in the record of a closed loop, together with the process.

A valve that sticks under a controller makes the PV a square wave while the output ramps. No linear process fits
this, so there is no process alone from which a search for friction could start. Instead

    lag, dead time from a grid of sample intervals;   bands from the output's range;   gain, offset by least squares

and the best few are fitted jointly.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effects.process_friction import process_friction
from autotuner.core.diagnosis.extended.base import is_physical
from autotuner.core.diagnosis.extended.extended_model import (
    Extended,
    Fitted,
    closest_first,
    fit,
    linearised,
    without_rounding,
)
from autotuner.core.diagnosis.search.search import refined, within
from autotuner.core.model.structures import FOPDT, INTEGRATING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.extended.effect import Effect
    from autotuner.core.diagnosis.extended.fit_context import Bench

LAGS, DELAYS = (0.6, 2.5, 8.0), (0.0, 2.0)
"""In sample intervals."""
FOLLOWED, STEPS = 2, 12
AXIS_LAGS, FAR, HALF = (5.0, 30.0), 3.0, 0.6
"""Lags of an axis to start from, in sample intervals; error over noise from which friction on the process is tried;
error after over before, on both parts, under which it is an explanation."""


def with_friction(bench: Bench, alone: Fitted, effects: Sequence[Effect]) -> list[Fitted]:
    """Return processes with each kind of friction, fitted on all samples; none where no controller moves the output.

    Parameters
    ----------
    bench : Bench
        The recording.
    alone : Fitted
        The process alone, for its background.
    effects : sequence of Effect
        The catalogue.
    """
    if not bench.case.in_loop or bench.case.budget.spent:
        return []
    friction = [e for e in effects if e.group == "friction" and e.form not in {"seated", "uneven"}]
    found = [f for effect in within(bench.case.budget, friction) for f in _beside(bench, alone, effect)]
    return [f for f in found if is_physical(f)]


def _beside(bench: Bench, alone: Fitted, effect: Effect) -> list[Fitted]:
    problem = Extended(bench.case, FOPDT, (effect,), bench.screen, alone.problem.background)
    interval = bench.case.data.interval_s
    grid = product(LAGS, DELAYS, effect.starts)
    thetas = [np.array([math.log(T * interval), D * interval / problem.unit_s, *p]) for T, D, p in grid]
    ranked = closest_first(fit(problem, theta, 0) for theta in thetas)
    coarse = [fit(replace(problem, rows=bench.coarse), f.theta, STEPS) for f in ranked[:FOLLOWED]]
    return [refined(bench, c) for c in closest_first(coarse)[:1]]


def with_process_friction(bench: Bench, alone: Fitted) -> list[Fitted]:
    """Return a lag and an integrating process with dry friction where that explains a record far better; else none.

    The process alone is not a start: with friction, a lag is identified as too short.

    Parameters
    ----------
    bench : Bench
        The recording.
    alone : Fitted
        The process alone.
    """
    if bench.case.tuned or bench.case.budget.spent or alone.rms < FAR * math.hypot(bench.case.noise, bench.case.floor):
        return []
    interval, found = bench.case.data.interval_s, []
    for structure in (FOPDT, INTEGRATING):
        plain = Extended(bench.case, structure, (), bench.coarse, alone.problem.background)
        effect = process_friction(bench.case)
        problem = replace(plain, effects=(effect,), rows=bench.screen)
        starts = [np.array([math.log(lag * interval), 0.0, *s]) for lag in AXIS_LAGS for s in effect.starts]
        ranked = without_rounding(starts, partial(linearised, problem))
        coarse = [fit(replace(problem, rows=bench.coarse), theta, STEPS) for theta in ranked[:FOLLOWED]]
        found.append(refined(bench, closest_first(coarse)[0]))
    before = bench.held_out_error(alone)
    return [f for f in found if is_physical(f) and f.rms < HALF * alone.rms and bench.held_out_error(f) < HALF * before]
