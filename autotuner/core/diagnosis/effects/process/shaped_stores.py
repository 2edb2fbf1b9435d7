"""Two stores in series that overflow, each with an outflow of its own shape.

    T1 p1 h1' = f - h1^p1,            h1 <= L1,   what is above spills:  q
    T2 p2 h2' = h1^p1 + s q - h2^p2,  h2 <= L2,   f = max(u - u0, 0)/F

`h` levels and `f` the flow over those at the flow `F`, at the middle of the output's range; `u0` the output at which
nothing flows. `p` = 1/2 is a hole in a prismatic store (Torricelli); another power stands for another shape of store
and outlet. About the middle both are lags of `T1` and `T2`, and `F p2 (h2 - 1)` is the response of unit gain.
(Schoukens, Mattsson, Wigren, Noel, Cascaded tanks benchmark, 2016.)

This form has more numbers than a search from anywhere finds: it begins from stores with one curvature (`state_limits`).
Between two times both levels move by the midpoint rule.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effects.process.state_limits import lags_of
from autotuner.core.diagnosis.effects.process.stepping import steps_of
from autotuner.core.diagnosis.extended.effect import Effect, Place, Searched, View
from autotuner.core.model.step_responses import Pair

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

SHAPED = "stores of any shape"
"""Form of `state_saturation`."""
POWERS = ((0.5, 0.5), (1.0, 0.5), (1.5, 0.35), (0.5, 1.0))
"""Powers to start from."""
EMPTY = 0.1
"""Distance of the lowest output from that at which nothing flows, to start from, in swings, where zero is beyond it."""
FINE = 0.1
"""Step over the shorter of the two time constants."""
HIGHEST = 100.0
"""Bound of a level: a trial that diverges stays finite, and fits badly."""


def shaped_stores(dataset: Dataset, curved: Sequence[float]) -> Effect:
    """Return the effect.

    Parameters
    ----------
    dataset : Dataset
        The record.
    curved : sequence of float
        What was found for stores with one curvature: the numbers that `state_limits` searches for.
    """
    levels = dataset.data.held.levels
    low, high, swing = float(levels.min()), float(levels.max()), dataset.swing
    from_zero = (dataset.output0 + low) / swing
    empty = from_zero if 0.0 < from_zero < 1.0 else EMPTY
    reach = 0.0 if dataset.settled_first else 2.0

    def flow_of(p: Sequence[float]) -> tuple[float, float]:
        """Return the output at which nothing flows, as deviation from the first one, and the flow at the middle."""
        u0 = low - math.exp(p[6]) * swing
        return u0, (low + high) / 2.0 - u0

    def response(view: View, p: Sequence[float]) -> FloatArray:
        motion = view.motion
        if not isinstance(motion, Pair):
            return view.forced(view.input)
        u0, F = flow_of(p)
        return F * p[5] * (_levels(view, motion, p, u0, F) - 1.0)

    def sizes(p: Sequence[float], _c: Sequence[float], g: float) -> Mapping[str, float]:
        u0, F = flow_of(p)
        first = max(-u0 / F, 0.0) ** (1.0 / p[5])
        return {
            "share_into_second": p[2],
            "second_limit_above_start": g * F * p[5] * (math.exp(p[3]) - first - p[8]),
            "power_of_first": p[4],
            "power_of_second": p[5],
            "no_flow_at": dataset.output0 + u0,
        }

    return Effect(
        "state_saturation",
        Place.PROCESS,
        (
            Searched("slow_first", 0.0, 1.0, 0.0),
            Searched("log_first", -2.0, 3.0, 1e-4),
            Searched("share", 0.0, 1.0, 1e-3),
            Searched("log_second", -2.0, 3.0, 1e-4),
            Searched("power1", 0.2, 3.0, 1e-4),
            Searched("power2", 0.2, 3.0, 1e-4),
            Searched("log_empty", math.log(0.01), math.log(10.0), 1e-4),
            Searched("level1", -reach, reach, 1e-4),
            Searched("level2", -reach, reach, 1e-4),
        ),
        _starts(dataset, curved, empty),
        sizes,
        form=SHAPED,
        response=response,
        price=5.0,
    )


def _starts(dataset: Dataset, curved: Sequence[float], empty: float) -> list[tuple[float, ...]]:
    """Return starts from stores with one curvature, for each pair of powers."""
    low, high, swing = float(dataset.data.held.levels.min()), float(dataset.data.held.levels.max()), dataset.swing
    F = empty * swing + swing / 2.0

    def limit(power: float, below: float) -> float:
        return math.log(max(1.0 + (high - below * swing - (low + high) / 2.0) / (power * F), 0.2))

    return [
        (curved[0], limit(a, curved[1]), curved[2], limit(b, curved[3]), a, b, math.log(empty), 0.0, 0.0)
        for a, b in POWERS
    ]


def _levels(view: View, motion: Pair, p: Sequence[float], u0: float, F: float) -> FloatArray:
    """Return the level of the second store, over that at the middle flow."""
    slow, fast = lags_of(motion)
    T1, T2 = (slow, fast) if p[0] > 0.5 else (fast, slow)
    again = [r for r in view.dataset.restarts_s[1:] if r < view.t[-1]]
    grid, v, h = steps_of(view, view.input, again)
    flow = np.maximum(v - u0, 0.0) / F
    first = max(-u0 / F, 0.0)
    begin = tuple(min(max(first ** (1.0 / p[k]) + p[k + 3], 0.0), HIGHEST) for k in (4, 5))
    restarts = set(np.searchsorted(grid, again).tolist())
    pieces = np.ceil(h / (FINE * min(T1, T2))).clip(1, 20).astype(int)
    course = _run(
        flow.tolist(), (h / pieces).tolist(), pieces.tolist(), (T1 * p[4], T2 * p[5]), (p[4], p[5]),
        (math.exp(p[1]), math.exp(p[3])), p[2], begin, restarts,
    )  # fmt: skip
    result: FloatArray = np.array(course)[np.searchsorted(grid, view.t)]
    return result


def _run(
    flow: list[float],
    steps: list[float],
    pieces: list[int],
    times: tuple[float, float],
    powers: tuple[float, float],
    limits: tuple[float, float],
    share: float,
    begin: tuple[float, float],
    restarts: set[int],
) -> list[float]:
    (a1, a2), (p1, p2), (L1, L2) = times, powers, limits
    h1, h2 = min(begin[0], L1), min(begin[1], L2)
    result = [h2]
    for k, (f, dt, count) in enumerate(zip(flow, steps, pieces, strict=True), 1):
        for _ in range(count):
            middle = max(h1 + 0.5 * dt * (f - h1**p1) / a1, 0.0)
            through = middle**p1
            filled = h1 + dt * (f - through) / a1
            spilled = (filled - L1) * a1 / dt if filled > L1 else 0.0
            h1 = L1 if filled > L1 else max(filled, 0.0)
            entering = through + share * spilled
            middle = max(h2 + 0.5 * dt * (entering - h2**p2) / a2, 0.0)
            h2 = min(max(h2 + dt * (entering - middle**p2) / a2, 0.0), L2)
        if k in restarts:
            h1, h2 = min(begin[0], L1), min(begin[1], L2)
        result.append(h2)
    return result
