"""A process that answers to its own PV, step by step.

    w = G[v + f(v, w)],   w clipped to limits

Between two times the linear part moves exactly (`e^{A h}`); `f` is taken at both ends and averaged (Heun), so the error
falls with the square of the step. The steps are the samples wanted and the moments at which the input changes.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.identification.held_input import HeldInput
from autotuner.core.identification.motions import Integrator, Lag, LaggedIntegrator, Pair

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.core.arrays import FloatArray
    from autotuner.core.diagnosis.effect import View

WIDE = 1e6
MANY_MOVES = 300
"""Moves beyond which an input is averaged: a controller's output, whose single moves do not matter."""


def stepped(
    view: View, feedback: Callable[[float, float], float] | None, limits: tuple[float, float] = (-math.inf, math.inf)
) -> FloatArray:
    """Return the response of the process of unit gain at the view's times.

    Parameters
    ----------
    view : View
        Process, input and times.
    feedback : callable, optional
        `f(v, w)`, added to the input.
    limits : tuple of float
        Where the response stops.
    """
    held = view.position
    if held.times.size > MANY_MOVES:
        held = averaged(held, view.case.span_s)
    moves = held.times[1:] + view.delay_s
    grid = np.union1d(np.concatenate((moves[moves < view.t[-1]], [0.0])), view.t)
    index = np.searchsorted(moves, grid, side="right")
    v = held.levels[index[:-1]].tolist()
    h = np.diff(grid)
    motion = view.motion
    if isinstance(motion, Lag):
        w = _first_order(np.exp(-h / motion.T).tolist(), v, feedback, limits)
    elif isinstance(motion, Pair):
        rows = [entry.tolist() for entry in motion.transition(h)]
        w = _second_order(rows, v, feedback, limits)
    elif isinstance(motion, Integrator | LaggedIntegrator):
        return view.forced(held)
    else:
        return view.forced(held)
    result: FloatArray = np.array(w)[np.searchsorted(grid, view.t)]
    return result


def averaged(held: HeldInput, span_s: float) -> HeldInput:
    """Return an input with fewer moves: its mean over even intervals."""
    edges = np.linspace(held.times[0], max(span_s, float(held.times[-1])), MANY_MOVES)
    path = np.concatenate(([0.0], np.cumsum(held.levels[:-1] * np.diff(held.times))))
    index = np.searchsorted(held.times, edges, side="right") - 1
    reached = path[index] + held.levels[index] * (edges - held.times[index])
    means = np.diff(reached) / np.diff(edges)
    return HeldInput(edges[:-1], np.where(np.arange(means.size) == 0, 0.0, means))


def _first_order(
    decay: list[float], v: list[float], feedback: Callable[[float, float], float] | None, limits: tuple[float, float]
) -> list[float]:
    low, high = limits
    w = 0.0
    result = [w]
    for p, level in zip(decay, v, strict=True):
        f = feedback(level, w) if feedback is not None else 0.0
        tried = level + f + p * (w - level - f)
        if feedback is not None:
            f = 0.5 * (f + feedback(level, tried))
            tried = level + f + p * (w - level - f)
        w = high if tried > high else max(tried, low)
        result.append(w)
    return result


def _second_order(
    rows: list[list[float]],
    v: list[float],
    feedback: Callable[[float, float], float] | None,
    limits: tuple[float, float],
) -> list[float]:
    low, high = limits
    w = slope = 0.0
    result = [w]
    for p00, p01, p10, p11, level in zip(*rows, v, strict=True):
        f = feedback(level, w) if feedback is not None else 0.0
        off = w - level - f
        tried = level + f + p00 * off + p01 * slope
        if feedback is not None:
            f = 0.5 * (f + feedback(level, max(min(tried, WIDE), -WIDE)))
            off = w - level - f
            tried = level + f + p00 * off + p01 * slope
        slope = p10 * off + p11 * slope
        if tried > high:
            tried, slope = high, min(slope, 0.0)
        elif tried < low:
            tried, slope = low, max(slope, 0.0)
        w = max(min(tried, WIDE), -WIDE)
        result.append(w)
    return result
