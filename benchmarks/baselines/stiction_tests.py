"""Four published tests for a sticking valve in an oscillating loop, as comparators.

All take an oscillation of output `u` and PV `y` and need no model. `Z` is what the record shows of it: half cycles
between the sign changes of a signal about its straight line.

    cross-correlation   r(tau) of u and y:  odd for a valve that sticks, even for a disturbance or tight tuning
                        D_tau = |t_l - t_r|/(t_l + t_r),   D_rho = ||r(0)| - |r_opt||/(|r(0)| + |r_opt|)
                        both above 2/3: sticks, both below 1/3: does not
                        (Horch, Control Engineering Practice 7, 1999, 1221)
    area ratio          R = area from zero to the peak over that from the peak to zero:  above 1 sticks, 1 for a sine
                        (Singhal, Salsbury, J. Process Control 15, 2005, 371)
    curve fit           S = E_sine/(E_sine + E_triangle) of the output:  from 0.6 on sticks, up to 0.4 does not
                        (He, Wang, Pottmann, Qin, Ind. Eng. Chem. Res. 46, 2007, 4549)
    relay fit           S = (E_sine - E_other)/(E_sine + E_other) of the PV, the other being the better of a triangle
                        and the response of a lag to a relay:  above 0.21 sticks, below 0 does not
                        (Rossi, Scali, J. Process Control 15, 2005, 505)

`t_l`, `t_r` are the lags of the zeros of `r` on either side of lag 0, `r_opt` its extreme between them; `E` are mean
squares, roots of them for the relay fit. The area ratio is judged by two standard errors of its mean over the half
cycles. The tests of the literature are for processes that settle. Written from the formulas of the papers.
"""

from __future__ import annotations

import math
from enum import StrEnum
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

Array = np.ndarray
"""Samples in even steps."""
FEWEST, SHORTEST = 6, 4
"""Half cycles that a test needs, and the fewest samples of one."""
REGULAR = 1.0
"""Mean over three standard deviations of the periods from which an oscillation is regular (Thornhill, Huang, Zhang,
J. Process Control 13, 2003, 91)."""
HYSTERESIS = 0.3
"""Distance from zero, in standard deviations, that a change of sign needs."""
ODD, EVEN = 2.0 / 3.0, 1.0 / 3.0
TRIANGULAR, SINUSOIDAL = 0.6, 0.4
RELAY, SINE = 0.21, 0.0
LAGS = np.geomspace(0.03, 5.0, 14)
"""Time constants of the response to a relay that are tried, in half cycles."""


class Verdict(StrEnum):
    """Result of a test."""

    STICKS = "sticks"
    FREE = "does not stick"
    OPEN = "undecided"


def straightened(x: Array) -> Array:
    """Return a signal about its straight line."""
    k = np.arange(x.size)
    return x - np.polyval(np.polyfit(k, x, 1), k)


def half_cycles(x: Array) -> list[Array]:
    """Return the stretches between sign changes, each taken as positive; none where they are few or irregular."""
    least = HYSTERESIS * float(np.std(x))
    signs = np.where(x > least, 1, np.where(x < -least, -1, 0))
    clear = np.flatnonzero(signs)
    turns = clear[1:][np.diff(signs[clear]) != 0]
    # The last sample of the old sign before each.
    starts = [int(np.flatnonzero(x[:k] * x[k] <= 0.0)[-1]) + 1 for k in turns]
    found = [x[a:b] * np.sign(x[(a + b) // 2]) for a, b in pairwise(starts)]
    found = [half for half in found if half.size >= SHORTEST]
    cycles = np.diff(starts[::2])  # of two halves: a valve may stay longer on one side
    if len(found) < FEWEST or cycles.mean() < REGULAR * 3.0 * cycles.std():
        return []
    return found


def cross_correlation(u: Array, y: Array) -> Verdict:
    """Judge by the symmetry of the cross-correlation of output and PV."""
    u, y = straightened(u), straightened(y)
    if not half_cycles(u) or not half_cycles(y):
        return Verdict.OPEN
    r = np.correlate(y, u, "full") / (u.size * np.std(u) * np.std(y))
    middle = u.size - 1
    left, right = _first_zero(r[middle::-1]), _first_zero(r[middle:])
    between = r[middle - math.ceil(left) : middle + math.ceil(right) + 1]
    best, now = float(np.max(np.abs(between))), abs(float(r[middle]))
    by_time = abs(left - right) / max(left + right, 1e-12)
    by_size = abs(now - best) / (now + best)
    if min(by_time, by_size) > ODD:
        return Verdict.STICKS
    return Verdict.FREE if max(by_time, by_size) < EVEN else Verdict.OPEN


def _first_zero(r: Array) -> float:
    """Return the lag at which a correlation changes its sign, in samples."""
    changes = np.flatnonzero(r[:-1] * r[1:] <= 0.0)
    if not changes.size:
        return float(r.size - 1)
    k = int(changes[0])
    return k + (float(r[k] / (r[k] - r[k + 1])) if r[k] != r[k + 1] else 0.0)


def area_ratio(_u: Array, y: Array) -> Verdict:
    """Judge by the areas of the PV before and after its peaks."""
    halves = half_cycles(straightened(y))
    peaks = [int(np.argmax(half)) for half in halves]
    ratios = [
        float(half[: k + 1].sum() - half[k] / 2.0) / max(float(half[k:].sum() - half[k] / 2.0), 1e-12)
        for half, k in zip(halves, peaks, strict=True)
    ]
    if not ratios:
        return Verdict.OPEN
    logs = np.log(np.maximum(ratios, 1e-12))
    return Verdict.STICKS if logs.mean() > 2.0 * logs.std(ddof=1) / math.sqrt(logs.size) else Verdict.FREE


def curve_fit(u: Array, _y: Array) -> Verdict:
    """Judge by sines and triangles through the half cycles of the output."""
    halves = half_cycles(straightened(u))
    if not halves:
        return Verdict.OPEN
    sine, triangle = (
        float(np.mean([_error(half, shapes(half.size)) for half in halves])) for shapes in (_sine, _triangles)
    )
    index = sine / max(sine + triangle, 1e-300)
    return Verdict.STICKS if index >= TRIANGULAR else Verdict.FREE if index <= SINUSOIDAL else Verdict.OPEN


def relay_fit(_u: Array, y: Array) -> Verdict:
    """Judge by sines, triangles and responses to a relay through the half cycles of the PV."""
    halves = half_cycles(straightened(y))
    if not halves:
        return Verdict.OPEN
    sine, triangle, relay = (
        float(np.mean([math.sqrt(_error(half, shapes(half.size))) for half in halves]))
        for shapes in (_sine, _symmetric_triangle, _relay_responses)
    )
    other = min(triangle, relay)
    index = (sine - other) / max(sine + other, 1e-300)
    return Verdict.STICKS if index > RELAY else Verdict.FREE if index < SINE else Verdict.OPEN


def _error(half: Array, shapes: list[Array]) -> float:
    """Return the mean square that the best of some shapes leaves, each with its best size."""
    return min(float(np.mean((half - shape * (half @ shape) / (shape @ shape)) ** 2)) for shape in shapes)


def _sine(size: int) -> list[Array]:
    return [np.sin(math.pi * (np.arange(size) + 0.5) / size)]


def _triangles(size: int) -> list[Array]:
    """Return triangles with their peaks at any sample but the first and the last."""
    k = np.arange(size) + 0.5
    return [np.minimum(k / (peak + 0.5), (size - k) / (size - peak - 0.5)) for peak in range(1, size - 1)]


def _symmetric_triangle(size: int) -> list[Array]:
    k = np.arange(size) + 0.5
    return [np.minimum(k, size - k)]


def _relay_responses(size: int) -> list[Array]:
    """Return half cycles of a lag `T` under a relay: they rise until `T ln((e^(1/T) + 1)/2)`, then fall to zero."""
    k, shapes = (np.arange(size) + 0.5) / size, []
    for T in LAGS:
        peak = 1.0 + T * math.log((1.0 + math.exp(-1.0 / T)) / 2.0)  # T ln((e^(1/T) + 1)/2), without overflow
        top = -math.expm1(-peak / T)
        falling = -1.0 + (top + 1.0) * np.exp(-np.maximum(k - peak, 0.0) / T)
        shapes.append(np.where(k < peak, -np.expm1(-k / T), falling))
    return shapes


TESTS: dict[str, Callable[[Array, Array], Verdict]] = {
    "cross-correlation": cross_correlation,
    "area ratio": area_ratio,
    "curve fit": curve_fit,
    "relay fit": relay_fit,
}
"""By name, in the order of their years."""
