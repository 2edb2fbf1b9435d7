"""Whether the PV of a loop waits while the output travels: the usual evidence of a valve that sticks.

    tau        quickest time in which the PV makes most of its range: how long it takes where it moves
    waiting    travel of the output, until tau before its end, in all stretches of at least 3 tau in which the PV rests,
               over all its travel
    following  correlation of the PV's moves with those of the output, from each tenth of the output's range to the next

A valve that sticks lets the PV rest far longer than the process needs to answer, while the integral action moves the
output on; then the PV jumps to another level (the parallelogram of output and PV; the waiting times of Yamashita, ISA
Transactions 45, 2006, and of Kano, Maruta, Kugemoto, Shimizu, DYCOPS 2004). Where the PV follows every move of
the output, nothing sticks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import scipy

from autotuner.core.signals.noise import noise_sigma

if TYPE_CHECKING:
    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import BoolArray, FloatArray

MOST, REST = 0.6, 0.15
"""Share of the PV's range that is most of it, and up to which the PV rests."""
NOISES = 3.0
"""What noise adds to that, in its standard deviations."""
LONG, FEWEST = 3, 6
"""Length of a rest, in times in which the PV moves, and its fewest samples."""
TRAVEL = 0.2
"""Share of the output's range that passes during a rest that counts as waiting."""
MANY, SMALL = 30, 0.05
"""Moves of the output, and their median in its range, from which a controller makes them, frequent or not."""
TRAVELS = 5
"""Most travels that are given."""
OUTLIERS = 5
"""Samples of the running median."""
MOSTLY, ALWAYS = 0.6, 0.9
"""Waiting from which a valve sticks, where the PV waits twice; and once, before it jumps."""
LEVELS = 0.3
"""How far apart the levels of two rests lie, in the PV's range."""
TENTH, FOLLOWS, FEW = 0.08, 0.8, 10
"""Share of the output's range from which to which moves are compared, their correlation from which the PV follows, and
the fewest of them."""


@dataclass(frozen=True, slots=True)
class Waiting:
    """What output and PV show of a valve.

    Attributes
    ----------
    sticks : bool
        Whether the PV waits while the output travels, and jumps.
    follows : bool
        Whether the PV follows every move of the output.
    travels : tuple of float
        How far the output moves while the PV waits, output units; of many waits some.
    largest_step : float
        Largest step that the actuator may have, output units: a larger one would swallow moves that the PV follows.
    """

    sticks: bool
    follows: bool
    travels: tuple[float, ...] = ()
    largest_step: float = math.inf


@lru_cache(maxsize=8)
def waiting_of(dataset: Dataset) -> Waiting:
    """Return what output and PV show of a valve; nothing where no controller moves the output."""
    held = dataset.data.held
    if dataset.tuned or not (dataset.in_loop or _creeps(held.steps[1:], dataset.swing)):
        return Waiting(sticks=False, follows=False)
    output = held.at(dataset.data.t)
    good = dataset.fitted | dataset.held_out
    u, y = (scipy.ndimage.median_filter(x[good], OUTLIERS, mode="nearest") for x in (output, dataset.data.pv))
    return waiting(u, y, noise_sigma(dataset.data.pv[good]))


def _creeps(moves: FloatArray, swing: float) -> bool:
    """Return whether the output moves in many small steps, as a controller's does in a compressed record."""
    return moves.size >= MANY and float(np.median(np.abs(moves))) < SMALL * swing


def waiting(output: FloatArray, pv: FloatArray, noise: float) -> Waiting:
    """Return what a smooth output and PV show of a valve.

    Parameters
    ----------
    output, pv : array of float, shape (N,)
        Without single outliers.
    noise : float
        Standard deviation of the PV's noise, PV.
    """
    low, high = np.percentile(pv, (1.0, 99.0))
    travels = _waits(output, pv, float(high - low), noise)
    follows = _follows(output, pv)
    return Waiting(bool(travels), follows, tuple(travels), TENTH * float(np.ptp(output)) if follows else math.inf)


def _waits(u: FloatArray, y: FloatArray, motion: float, noise: float) -> list[float]:
    """Return how far the output moves while the PV waits; nothing where it does not, or not enough."""
    tau = _quickest(y, MOST * motion)
    window = max(LONG * tau, FEWEST)
    travelled = float(np.ptp(u))
    if not 0 < window < y.size // 2 or travelled == 0.0:
        return []
    at = np.arange(y.size - window)
    reach = np.lib.stride_tricks.sliding_window_view(y, window)[: at.size]
    rests = _runs(np.ptp(reach, axis=1) < REST * motion + NOISES * noise, window)
    passed = np.array([abs(float(u[end - 1 - tau] - u[begin])) for begin, end in rests])
    levels = np.array([float(np.mean(y[begin:end])) for begin, end in rests])
    path = float(np.sum(np.abs(np.diff(scipy.ndimage.uniform_filter1d(u, max(tau, 3))))))
    share, waited = float(passed.sum()) / path if path else 0.0, levels[passed >= TRAVEL * travelled]
    apart = waited.size > 1 and float(np.ptp(waited)) > LEVELS * motion
    if not ((share > MOSTLY and apart) or (share > ALWAYS and waited.size > 0)):
        return []
    whole = [abs(float(u[end - 1] - u[begin])) for begin, end in rests]
    long = sorted(w for w, short in zip(whole, passed, strict=True) if short >= TRAVEL * travelled)
    result: list[float] = np.quantile(long, np.linspace(0.0, 1.0, min(len(long), TRAVELS))).tolist()
    return result


def _quickest(y: FloatArray, move: float) -> int:
    """Return in how few samples the PV makes a move; 0 where it does not within a third of the record."""
    shortest, longest = 1, y.size // 3
    if move <= 0.0 or not _moves_within(y, longest, move):
        return 0
    while shortest < longest:
        middle = (shortest + longest) // 2
        shortest, longest = (shortest, middle) if _moves_within(y, middle, move) else (middle + 1, longest)
    return shortest


def _moves_within(y: FloatArray, samples: int, move: float) -> bool:
    size = samples + 1
    highest, lowest = (
        f(y, size, mode="nearest") for f in (scipy.ndimage.maximum_filter1d, scipy.ndimage.minimum_filter1d)
    )
    return bool(np.max(highest - lowest) >= move)


def _runs(rests: BoolArray, window: int) -> list[tuple[int, int]]:
    """Return begin and end of each stretch that windows at rest cover."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], rests.astype(int), [0]))))
    return [(int(begin), int(end) - 1 + window) for begin, end in zip(edges[::2], edges[1::2], strict=True)]


def _follows(u: FloatArray, y: FloatArray) -> bool:
    step, at = TENTH * float(np.ptp(u)), [0]
    for k in range(1, u.size):
        if step > 0.0 and abs(u[k] - u[at[-1]]) >= step:
            at.append(k)
    du, dy = np.diff(u[at]), np.diff(y[at])
    scale = float(np.sqrt((du @ du) * (dy @ dy)))
    return du.size >= FEW and scale > 0.0 and abs(float(du @ dy)) > FOLLOWS * scale
