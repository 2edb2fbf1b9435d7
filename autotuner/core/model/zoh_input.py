"""The zero-order hold: a recorded output as the few times at which it changed.

    u(t) = u[0] + levels[i]   for times[i] <= t < times[i + 1],   times[0] = t[0], levels[0] = 0

All levels are deviations from the first output, which is assumed to have been held for ever. A relay record of
thousands of samples has ten changes, and the cost of a response grows with the changes, not with the samples.

`x_k = p_k x_{k-1} + g_k` is a lower triangular band system with ones on the diagonal, which LAPACK solves in one sweep
(`tbtrs`), exactly and in `O(C)`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np
import scipy

from autotuner.core.model.arrays import FloatArray, IntArray  # noqa: TC001 - part of the public signature

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence


@dataclass(frozen=True, eq=False)
class HeldInput:
    """An output that is constant between its changes, or several that change at the same times.

    Attributes
    ----------
    times : array of float, shape (C,)
        Start, then the moments of change, s.
    levels : array of float, shape (C,) or (K, C)
        Output from each of them on, as deviation from the first; `levels[..., 0]` is 0.
    slack_s : array of float, shape (C,), or None
        How long before its time each change may have happened, s; None when the times are exact.
    """

    times: FloatArray
    levels: FloatArray
    slack_s: FloatArray | None = None

    @cached_property
    def steps(self) -> FloatArray:
        """Change at each of the times; the first is 0."""
        return _less_before(self.levels, 0.0)

    @cached_property
    def spans_s(self) -> FloatArray:
        """Time from the change before to each of the times, s; the first is 0."""
        return _less_before(self.times, self.times[0])

    def holds(self) -> Iterator[tuple[float, float, float]]:
        """Yield the begin and end, s, and the level of each hold; the last one has no end."""
        begins = self.times.tolist()
        return zip(begins, [*begins[1:], math.inf], self.levels.tolist(), strict=True)

    def at(self, when: FloatArray) -> FloatArray:
        """Return the output at each time of `when`, as deviation from the first; before the start 0."""
        level: FloatArray = self.levels[..., self.locate(when)[0]]
        return level

    def shifted(self, by_s: FloatArray) -> HeldInput:
        """Return the same levels with every change but the start that much later, s."""
        return HeldInput(np.concatenate((self.times[:1], self.times[1:] + by_s)), self.levels, self.slack_s)

    def without_repeats(self) -> HeldInput:
        """Return the same input, of exact times, without those at which no level changes."""
        moves = np.atleast_2d(self.steps)[:, 1:].any(axis=0)
        kept = np.append(np.array([True]), moves)
        return HeldInput(self.times[kept], self.levels[..., kept])

    def locate(self, when: FloatArray) -> tuple[IntArray, FloatArray]:
        """Return, for each time of `when`, the change before it and the time since it, s; before the start 0 s."""
        index = np.maximum(np.searchsorted(self.times, when, side="right") - 1, 0)
        return index, np.maximum(when - self.times[index], 0.0)


def _less_before(values: FloatArray, first: float) -> FloatArray:
    """Return `np.diff(values, prepend=first)`, which takes ten times as long for so few values."""
    result = values.copy()
    result[..., 1:] -= values[..., :-1]
    result[..., 0] -= first
    return result


def held_input(t: FloatArray, output: FloatArray) -> HeldInput:
    """Return the changes of a recorded output; each may have happened as early as just after the sample before.

    Parameters
    ----------
    t, output : array of float, shape (N,)
        Times, s, and the output held from each of them on.
    """
    changes = np.flatnonzero(np.diff(output)) + 1
    rows = np.concatenate(([0], changes))
    slack = np.concatenate(([0.0], t[changes] - t[changes - 1]))
    return HeldInput(t[rows], output[rows] - output[0], slack)


def smooth_input(t: FloatArray, output: FloatArray) -> HeldInput:
    """Return an output that moves on a cubic spline through its samples, as its means over halves of each interval.

    Parameters
    ----------
    t, output : array of float, shape (N,)
        Times, s, and the output at each of them.
    """
    area = scipy.interpolate.CubicSpline(t, output - output[0]).antiderivative()
    edges = np.append(np.column_stack((t[:-1], (t[:-1] + t[1:]) / 2.0)).ravel(), t[-1])
    means = np.diff(area(edges)) / np.diff(edges)
    return HeldInput(np.concatenate((t[:1], edges)), np.concatenate(([0.0], means, [output[-1] - output[0]])))


@lru_cache(maxsize=8)
def unit_step(start_s: float) -> HeldInput:
    """Return an output that rises by 1 at the start of the recording. Cached, with its steps and spans."""
    return HeldInput(np.array([start_s, start_s]), np.array([0.0, 1.0]))


def accumulate(p: FloatArray, g: FloatArray) -> FloatArray:
    """Return `x_k = p_k x_{k-1} + g_k`, `x_{-1} = 0`, along the last axis of `g`; `p[0]` does not count."""
    band = np.empty((2, p.size), order="F")
    band[0] = 1.0
    band[1, :-1] = -p[1:]
    return _swept(band, g, p.size)


def accumulate_states(P: Sequence[Sequence[FloatArray]] | FloatArray, g: FloatArray) -> FloatArray:
    """Return `x_k = P_k x_{k-1} + g_k`, `x_{-1} = 0`, with states of any size; `P_0` does not count.

    Parameters
    ----------
    P : rows of S arrays of float, shape (C,)
        Transitions: each entry of the matrix at all steps.
    g : array of float, shape (..., C, S)
        What is added at each step.

    Returns
    -------
    array of float, shape (..., C, S)
    """
    steps, size = g.shape[-2:]
    band = np.zeros((2 * size, steps * size), order="F")
    band[0] = 1.0
    for row in range(size):
        for column in range(size):
            band[size + row - column, column : (steps - 1) * size : size] = -P[row][column][1:]
    return _swept(band, g, steps * size)


def numbered(counts: IntArray) -> IntArray:
    """Return 0, 1, ..., n - 1 for each of some counts n, all in a row."""
    result: IntArray = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return result


def recurrence(c: FloatArray, g: FloatArray) -> FloatArray:
    """Return `x_k = g_k - sum_j c_j x_{k-j}` for `j` from 1 on, `x` 0 before; `c_0` does not count."""
    return _swept(np.asfortranarray(np.tile(c[:, None], g.size)), g, g.size)


def _swept(band: FloatArray, g: FloatArray, length: int) -> FloatArray:
    """Return the solutions of a lower triangular band system for each `length` of right sides, in their shape."""
    if not g.size:
        return g.copy()  # LAPACK's wrapper writes beyond an array without right sides
    x: FloatArray = scipy.linalg.lapack.dtbtrs(band, g.reshape(-1, length).T, uplo="L", diag="U")[0]
    return x.T.reshape(g.shape)
