"""Recycle: a share of what leaves the process comes back to its input later, again and again.

    w(t) = G[v(t) + r w(t - R)],   0 < r < 1
    through a tank:   w = G[v + r e^{-(1 - c) R s}/(c R s + 1) w]

with `w` the response of the process of unit gain as deviation from rest, `v` its input, `r` the share, `R` the time
until it is back and `c` the part of that in the tank (Denn and Lavie, Dynamics of plants with recycle, Chem. Eng. J.
24, 1982). The static gain is `1/(1 - r)` times that of the process alone, and a step is followed by a smaller one every
`R`.

What comes back is smooth. It enters as a line between the points of an even grid, and all points follow from one
recursion: with `Z(q) = B/A S(q)` the response to it, and `S = r F/L (W0 + Z)` what is back,

    Z (A L - r B F) = r B F W0,   F = (1 - f) q^-n + f q^-(n + 1),   (1 - c) R = (n + f) h

and `F` also has the numerator, `L` the denominator of the tank; a third lag is in `B/A` in the same way.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.effect import Effect, Place, Searched, View
from autotuner.core.model.step_responses import Lag, Pair, PairAndLag
from autotuner.core.model.zoh_input import recurrence

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

MOST_BACK = 0.9
"""Largest share: with all of it the process would integrate."""
POINTS = 1000
"""Points of the grid over a record."""
SHARES, TIMES = (0.3, 0.6), (0.02, 0.04, 0.08, 0.16)
"""Starts of the share, and of the time over the length of the record."""
IN_TANK, MOST_IN_TANK = 0.3, 0.6
"""Start and bound of the part of the return time in a tank: with nearly all of it there, it is a slow mode."""


def recycle(dataset: Dataset) -> tuple[Effect, ...]:
    """Return the effect through a pipe, and through a pipe and a tank, with starts from the length of the record."""
    span_s = dataset.span_s
    low, high = math.log(2.0 * span_s / POINTS), math.log(span_s / 3.0)
    share, after = Searched("share", 0.0, MOST_BACK, 1e-4), Searched("log_return", low, high, 1e-4)
    starts = [(size, math.log(part * span_s)) for size in SHARES for part in TIMES]

    def response(view: View, p: Sequence[float]) -> FloatArray:
        return _returning(view, p[0], math.exp(p[1]), *p[2:])

    def sizes(p: Sequence[float], _c: Sequence[float], _g: float) -> Mapping[str, float]:
        return {"share": p[0], "return_time_s": math.exp(p[1])}

    pipe = Effect(
        "recycle", Place.PROCESS, (share, after), starts, sizes, response=response, group="soak", takes_third=True
    )
    in_tank = Searched("in_tank", 0.0, MOST_IN_TANK, 1e-3)
    tank = replace(
        pipe, form="through a tank", searched=(share, after, in_tank), starts=[(*start, IN_TANK) for start in starts]
    )
    return pipe, tank


def _returning(view: View, share: float, after_s: float, in_tank: float = 0.0) -> FloatArray:
    """Return the response of the process of unit gain with a share of it back after some time."""
    motion = view.motion
    if not isinstance(motion, Lag | Pair | PairAndLag):
        return view.forced(view.input)
    grid, h = np.linspace(0.0, float(view.t[-1]), POINTS + 1, retstep=True)
    straight = motion.forced(view.input, grid - view.delay_s)[0][0]
    row: list[Lag | Pair] = [Lag(in_tank * after_s)] if in_tank > 0.0 else []
    row += [Pair(motion.m, motion.n), Lag(motion.T)] if isinstance(motion, PairAndLag) else [motion]
    b = a = np.ones(1)
    for numerator, denominator in (_of_lines(part, float(h)) for part in row):
        b, a = np.convolve(b, numerator), np.convolve(a, denominator)
    late = (1.0 - in_tank) * after_s / h
    n = int(late)
    back = np.concatenate((np.zeros(n), np.convolve(b, share * np.array([1.0 - late + n, late - n]))))
    ahead = np.pad(a, (0, max(back.size - a.size, 0)))
    ahead[: back.size] -= back
    returned = recurrence(ahead, np.convolve(back, straight)[: grid.size])
    result: FloatArray = view.forced(view.input) + np.interp(view.t, grid, returned)
    return result


def _of_lines(motion: Lag | Pair, h: float) -> tuple[FloatArray, FloatArray]:
    """Return the recursion of the process for an input that is a line between points `h` apart.

    Where the input rises by `s` a second, the process settles at `u - n s`, and what is off moves freely.
    """
    if isinstance(motion, Lag):
        p, rise = math.exp(-h / motion.T), motion.T / h
        return np.array([1.0 - rise * (1.0 - p), rise * (1.0 - p) - p]), np.array([1.0, -p])
    p00, p01, p10, p11 = (float(entry[0]) for entry in motion.transition(np.array([h])))
    rise = motion.n / h
    later = np.array([1.0 - rise + p00 * rise - p01 / h, (1.0 - p11) / h + p10 * rise])
    first = np.array([-p00, -p10]) - later + np.array([1.0, 0.0])
    b = [later[0], first[0] - p11 * later[0] + p01 * later[1], p01 * first[1] - p11 * first[0]]
    return np.array(b), np.array([1.0, -(p00 + p11), p00 * p11 - p01 * p10])
