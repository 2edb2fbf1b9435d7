"""A process that answers to its own PV, step by step.

    w = G[v + f(v, w)],   w clipped to limits

Between two times the linear part moves exactly (`e^{A h}`); `f` is taken at both ends, and is their mean (Heun) or,
where it is smooth, a straight line between them, so the error falls with the square of the step. The steps are the
samples wanted and the moments at which the input changes.

A smooth `f(w)` needs no walk: the course is found by Newton's method, each step of it a band system,

    w_k+1 = v + P (w_k - v) + A f(w_k) + B f(w_k+1),   f(w) ~ f(w*) + f'(w*) (w - w*)
    B = (1/h) int_0^h S(t) dt,   A = S(h) - B,   S the answer to a step

(quasilinearisation; Bellman and Kalaba, 1965). A loss of the last store alone, of time constant `T2`, is a lag in
parallel with the linear response:   w = G[v] + z,   T2 z' = f(w) - z.

A process that rises `r` times as quickly as it falls is linear on either way, and moves exactly over every step:

    T w' = r (v - w)  while w < v,  T w' = v - w  else;   of a pair  m w'' + n w' = r (v - w),  m w'' + n w' = v - w
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.model.arrays import SMALLEST_DIVISOR
from autotuner.core.model.step_responses import Lag, Pair, PairAndLag
from autotuner.core.model.zoh_input import HeldInput, accumulate, accumulate_states, numbered

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from autotuner.core.diagnosis.extended.effect import View
    from autotuner.core.model.arrays import FloatArray

    Row = tuple[float, float, float, float]

WIDE = 1e6
"""Bound of a simulated state, in swings of the PV: a trial that diverges stays finite, and fits badly."""
LONGEST_STEP = 1.0 / 8.0
"""Longest step of a smooth loss, in lags of the process or radians: a strong loss makes it some four times as quick."""
NEWTON_STEPS, CLOSE = 7, 1e-5
"""Steps of Newton's method, and the change over the size of the response at which it has arrived."""
MOST_STEPS = 5000
"""Steps beyond which none is divided: it would take minutes for a long record of a quick process."""
MANY_MOVES, MANY_TO_SOLVE = 300, 20_000
"""Moves beyond which an input is averaged: where the course is walked step by step, and where it is solved at once."""


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
    if not isinstance(view.motion, Lag | Pair):
        return view.forced(view.input)
    grid, levels, h = _grid(view)
    w = _limited(_rows(view.motion, h), levels.tolist(), feedback, limits)
    result: FloatArray = np.array(w)[np.searchsorted(grid, view.t)]
    return result


def two_speeds(view: View, r: float) -> FloatArray:
    """Return the response of the process of unit gain that rises `r` times as quickly as it falls."""
    motion = view.motion
    if not isinstance(motion, Lag | Pair):
        return view.forced(view.input)
    grid, levels, h = _grid(view)
    rising = Lag(motion.T / r) if isinstance(motion, Lag) else Pair(motion.m / r, motion.n / r)
    w = slope = 0.0
    course = [w]
    for slow, quick, level in zip(_rows(motion, h), _rows(rising, h), levels.tolist(), strict=True):
        off = w - level
        p00, p01, p10, p11 = quick if off < 0.0 else slow
        w, slope = level + p00 * off + p01 * slope, p10 * off + p11 * slope
        course.append(w)
    result: FloatArray = np.array(course)[np.searchsorted(grid, view.t)]
    return result


def _rows(motion: Lag | Pair, h: FloatArray) -> list[Row]:
    """Return `e^{A h}` of each step, row by row; that of a lag has no slope."""
    if isinstance(motion, Lag):
        return [(p, 0.0, 0.0, 0.0) for p in np.exp(-h / motion.T).tolist()]
    return list(zip(*(entry.tolist() for entry in motion.transition(h)), strict=True))


def with_loss(
    view: View, f: Callable[[FloatArray], FloatArray], slope: Callable[[FloatArray], FloatArray]
) -> FloatArray:
    """Return the response of the process of unit gain when `f(w)`, a smooth curve, is added to its input."""
    motion = view.motion
    if not isinstance(motion, Lag | Pair):
        return view.forced(view.input)
    slowest_s = motion.T if isinstance(motion, Lag) else max(motion.n, math.sqrt(motion.m))
    grid, v, h = _grid(view, MANY_TO_SOLVE, LONGEST_STEP * slowest_s)
    solve = _lag_course(motion, v, h) if isinstance(motion, Lag) else _pair_course(motion, v, h)
    w = _newton(solve, f, slope, solve(np.zeros(grid.size), np.zeros(grid.size)))
    if w is None:
        with np.errstate(over="ignore", invalid="ignore"):
            return stepped(view, lambda _v, x: float(f(np.array(x))))
    result: FloatArray = w[np.searchsorted(grid, view.t)]
    return result


def with_loss_at_the_end(
    view: View,
    f: Callable[[FloatArray], FloatArray],
    slope: Callable[[FloatArray], FloatArray],
    *,
    slow_last: bool,
) -> FloatArray:
    """Return the response of two or three lags of unit gain when `f(w)` is added to the input of the last one.

    Parameters
    ----------
    view : View
        Process, input and times; any other process has no loss. The lags of a pair that just rings count as `n/2` and
        `2 m/n`, so that a search passes from one to the other.
    f, slope : callable
        A smooth curve and its slope.
    slow_last : bool
        Whether the slowest of the lags comes last, else the quickest.
    """
    motion = view.motion
    if not isinstance(motion, Pair | PairAndLag):
        return view.forced(view.input)
    slow_s = (motion.n + math.sqrt(max(motion.n**2 - 4.0 * motion.m, 0.0))) / 2.0
    last_s = slow_s if slow_last else motion.m / slow_s
    if isinstance(motion, PairAndLag):
        last_s = max(last_s, motion.T) if slow_last else min(last_s, motion.T)
    grid, v, h = _grid(view, MANY_TO_SOLVE, LONGEST_STEP * slow_s)
    straight = motion.forced(view.input, grid - view.delay_s)[0][0]
    part = _lag_course(Lag(last_s), np.zeros_like(v), h)

    def solve(f0: FloatArray, f1: FloatArray) -> FloatArray:
        added: FloatArray = straight + part(f0 + f1 * straight, f1)
        return added

    w = _newton(solve, f, slope, straight)
    result: FloatArray = (straight if w is None else w)[np.searchsorted(grid, view.t)]
    return result


def _newton(
    solve: Callable[[FloatArray, FloatArray], FloatArray],
    f: Callable[[FloatArray], FloatArray],
    slope: Callable[[FloatArray], FloatArray],
    w: FloatArray,
) -> FloatArray | None:
    """Return the course on which `f` equals its linearisation, started at `w`; None without convergence."""
    size = float(np.abs(w).max()) + SMALLEST_DIVISOR
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for _ in range(NEWTON_STEPS):
            steep = slope(w)
            following = solve(f(w) - steep * w, steep)
            change = float(np.abs(following - w).max())
            w = following
            if not change < WIDE:
                return None
            if change < CLOSE * size:
                return w
    return None


def _grid(view: View, many: int = MANY_MOVES, longest_s: float = math.inf) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the steps of the input, which is averaged where it moves often.

    Steps longer than `longest_s` are divided, unless that makes too many.
    """
    held = view.input
    held = averaged(held, view.dataset.span_s) if held.times.size > many else held
    grid, levels, h = steps_of(view, held)
    parts = np.ceil(h / longest_s)
    if not grid.size < parts.sum() + 1 < MOST_STEPS:
        return grid, levels, h
    parts = parts.astype(np.intp)
    since_s = numbered(parts) / np.repeat(parts, parts) * np.repeat(h, parts)
    finer = np.append(np.repeat(grid[:-1], parts) + since_s, grid[-1])
    return finer, np.repeat(levels, parts), np.diff(finer)


def steps_of(view: View, held: HeldInput, also: Sequence[float] = ()) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the times of the steps: samples, moves of an input and some others; the input over each; their lengths."""
    moves = held.times[1:] + view.delay_s
    grid = np.union1d(np.concatenate((moves[moves < view.t[-1]], [0.0], also)), view.t)
    return grid, held.levels[np.searchsorted(moves, grid, side="right")[:-1]], np.diff(grid)


def _lag_course(motion: Lag, v: FloatArray, h: FloatArray) -> Callable[[FloatArray, FloatArray], FloatArray]:
    p = np.exp(-h / motion.T)
    later = 1.0 - (1.0 - p) * motion.T / h
    first = 1.0 - p - later

    def solve(f0: FloatArray, f1: FloatArray) -> FloatArray:
        ahead = 1.0 - later * f1[1:]
        kept = (p + first * f1[:-1]) / ahead
        added = ((1.0 - p) * v + first * f0[:-1] + later * f0[1:]) / ahead
        return accumulate(np.concatenate(([0.0], kept)), np.concatenate(([0.0], added)))

    return solve


def _pair_course(motion: Pair, v: FloatArray, h: FloatArray) -> Callable[[FloatArray, FloatArray], FloatArray]:
    p00, p01, p10, p11 = motion.transition(h)
    rise, speed = 1.0 - p00, -p10  # of the answer to a step
    later, later_speed = 1.0 - (motion.n * rise + motion.m * speed) / h, rise / h
    first, first_speed = rise - later, speed - later_speed

    def solve(f0: FloatArray, f1: FloatArray) -> FloatArray:
        ahead = 1.0 - later * f1[1:]
        a, b = (p00 + first * f1[:-1]) / ahead, p01 / ahead
        c = (rise * v + first * f0[:-1] + later * f0[1:]) / ahead
        forth = later_speed * f1[1:]
        P, shift = np.zeros((2, 2, h.size + 1)), np.zeros((h.size + 1, 2))
        P[0, 0, 1:], P[0, 1, 1:] = a, b
        P[1, 0, 1:], P[1, 1, 1:] = p10 + first_speed * f1[:-1] + forth * a, p11 + forth * b
        shift[1:, 0] = c
        shift[1:, 1] = speed * v + first_speed * f0[:-1] + later_speed * f0[1:] + forth * c
        result: FloatArray = accumulate_states(P, shift)[:, 0]
        return result

    return solve


def averaged(held: HeldInput, span_s: float) -> HeldInput:
    """Return an input with fewer moves: its mean over even intervals."""
    edges = np.linspace(held.times[0], max(span_s, float(held.times[-1])), MANY_MOVES)
    path = np.concatenate(([0.0], np.cumsum(held.levels[:-1] * np.diff(held.times))))
    index = np.searchsorted(held.times, edges, side="right") - 1
    reached = path[index] + held.levels[index] * (edges - held.times[index])
    means = np.diff(reached) / np.diff(edges)
    return HeldInput(edges[:-1], np.where(np.arange(means.size) == 0, 0.0, means))


def _limited(
    rows: list[Row],
    v: list[float],
    feedback: Callable[[float, float], float] | None,
    limits: tuple[float, float],
) -> list[float]:
    low, high = limits
    w = slope = 0.0
    result = [w]
    for (p00, p01, p10, p11), level in zip(rows, v, strict=True):
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
