"""Friction on the record of a loop: the process is looked for together with it.

A valve that sticks under a controller makes the PV a square wave below an output that ramps. No linear process comes
near that, so there is no process alone from which a search for friction could begin. Instead

    lag, dead time from a grid of sample intervals;   bands from the output's range;   gain, offset by least squares

and the best few are fitted jointly.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.base import is_physical
from autotuner.core.diagnosis.extended import Extended, Fitted, fit
from autotuner.core.diagnosis.search import refined
from autotuner.core.identification.structures import FOPDT

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.bench import Bench
    from autotuner.core.diagnosis.effect import Effect

LAGS, DELAYS = (0.6, 2.5, 8.0), (0.0, 2.0)
"""In sample intervals."""
FOLLOWED, STEPS = 2, 12


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
    if not bench.case.in_loop:
        return []
    friction = [e for e in effects if e.group == "friction" and e.form not in {"seated", "uneven"}]
    found = [f for effect in friction for f in _beside(bench, alone, effect)]
    return [f for f in found if is_physical(f)]


def _beside(bench: Bench, alone: Fitted, effect: Effect) -> list[Fitted]:
    problem = Extended(bench.case, FOPDT, (effect,), bench.screen, alone.problem.background)
    interval = bench.case.data.interval_s
    grid = product(LAGS, DELAYS, effect.starts)
    thetas = [np.array([math.log(T * interval), D * interval / problem.unit_s, *p]) for T, D, p in grid]
    ranked = sorted((fit(problem, theta, 0) for theta in thetas), key=lambda f: f.mean_square)
    coarse = [fit(replace(problem, rows=bench.coarse), f.theta, STEPS) for f in ranked[:FOLLOWED]]
    return [refined(bench, c) for c in sorted(coarse, key=lambda c: c.mean_square)[:1]]
