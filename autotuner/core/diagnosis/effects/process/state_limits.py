"""Two stores in series that overflow: tanks, one above the other, where part of the overflow falls into the second.

    T1 x1' = v - o(x1),         x1 <= L1,   the excess overflows:  q
    T2 x2' = o(x1) + s q - o(x2),   x2 <= L2,      o(x) = x + b x^2

`x2` is the response of unit gain; output units as deviation from the first output. `b` < 0 is a free outflow, whose
flow grows with the root of the level (to second order). The order of the two time constants is tried. (Schoukens,
Mattsson, Wigren, Noel, Cascaded tanks benchmark, 2016.)

Between two times the linear part moves exactly, the curve is averaged over its ends (Heun).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effects.process.stepping import WIDE, steps_of
from autotuner.core.diagnosis.extended.effect import Effect, Place, Searched, View
from autotuner.core.model.step_responses import Pair

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

STORES = "stores"
"""Form of `state_saturation`."""
FURTHEST = 1.5
"""Furthest initial level, in swings of the output."""


def overflowing_stores(dataset: Dataset) -> Effect:
    """Return the effect, with starts from the swing of the output."""
    swing = dataset.swing
    extreme = float(dataset.data.held.levels.max())
    reach = 0.0 if dataset.settled_first else FURTHEST

    def response(view: View, p: Sequence[float]) -> FloatArray:
        return _levels(view, p, extreme, swing)

    def sizes(p: Sequence[float], _c: Sequence[float], g: float) -> Mapping[str, float]:
        return {
            "first_limit_above_start": g * (extreme - p[1] * swing),
            "share_into_second": p[2],
            "second_limit_above_start": g * (extreme - p[3] * swing),
            "curvature_per_output": p[4] / swing,
        }

    return Effect(
        "state_saturation",
        Place.PROCESS,
        (
            Searched("slow_first", 0.0, 1.0, 0.0),
            Searched("first", 0.0, 1.0, 1e-4),
            Searched("share", 0.0, 1.0, 1e-3),
            Searched("second", 0.0, 1.0, 1e-4),
            Searched("curvature", -0.9, 0.9, 1e-4),
            Searched("level1", -reach, reach, 1e-4),
            Searched("level2", -reach, reach, 1e-4),
        ),
        [(first, limit, 0.5, 0.3, 0.0, 0.0, 0.0) for first in (0.0, 1.0) for limit in (0.35, 0.5)],
        sizes,
        form=STORES,
        response=response,
        price=3.0,
    )


def _levels(view: View, p: Sequence[float], extreme: float, swing: float) -> FloatArray:
    motion = view.motion
    if not isinstance(motion, Pair):
        return view.forced(view.input)
    slow, fast = lags_of(motion)
    lags = (slow, fast) if p[0] > 0.5 else (fast, slow)
    limits = (extreme - p[1] * swing, extreme - p[3] * swing)
    start = (p[5] * swing, p[6] * swing)
    again = [r for r in view.dataset.restarts_s[1:] if r < view.t[-1]]
    grid, v, h = steps_of(view, view.input, again)
    rows = np.searchsorted(grid, again)
    first, second = (
        _Store(np.exp(-h / T).tolist(), limit, p[4] / swing, x, set(rows.tolist()))
        for T, limit, x in zip(lags, limits, start, strict=True)
    )
    x1, spilled = first.filled(v.tolist())
    before = np.append(start[0], x1[:-1])
    before[rows[rows < before.size]] = start[0]
    b = first.b
    through = 0.5 * (before + b * before * before + x1 + b * x1 * x1) + p[2] * spilled
    x2, _ = second.filled(through.tolist())
    x2[rows - 1] = start[1]
    result: FloatArray = np.append(start[1], x2)[np.searchsorted(grid, view.t)]
    return result


def lags_of(motion: Pair) -> tuple[float, float]:
    """Return the two time constants, the slower first; equal ones for a complex pair."""
    root = math.sqrt(max(motion.n**2 - 4.0 * motion.m, 0.0))
    slow = (motion.n + root) / 2.0 if root > 0.0 else math.sqrt(motion.m)
    return slow, motion.m / slow


@dataclass(frozen=True, slots=True)
class _Store:
    """A store: its decay over each step, its limit, its curvature, its level at the start and after each restart."""

    decays: list[float]
    limit: float
    b: float
    start: float
    restarts: set[int]

    def filled(self, inflow: list[float]) -> tuple[FloatArray, FloatArray]:
        """Return the level at the end of each step, and the mean flow that spilled during it."""
        x, b, limit, levels, spilled = self.start, self.b, self.limit, [], []
        for k, (v, decay) in enumerate(zip(inflow, self.decays, strict=True), 1):
            f = -b * x * x
            tried = v + f + decay * (x - v - f)
            square = tried * tried
            f = 0.5 * (f - b * (WIDE if square > WIDE else square))  # noqa: FURB136 - calls are a third of the time
            tried = v + f + decay * (x - v - f)
            x = limit if tried > limit else -WIDE if tried < -WIDE else tried  # noqa: FURB136
            spilled.append((tried - limit) / max(1.0 - decay, 1e-9) if tried > limit else 0.0)
            levels.append(x)
            x = self.start if k in self.restarts else x
        return np.array(levels), np.array(spilled)
