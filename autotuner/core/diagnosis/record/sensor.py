"""Effects of the sensor on a record: spikes, a frozen value, quantisation.

    spikes   d_k = e_k - median of e over a window;   |d_k| > 6 robust sigma, of another kind than the noise's own tail;
             it comes and goes in jumps that no motion of the process makes
    grid     all values are multiples of one step;  or the PV is constant and moves by no less than one step
             (send on delta: what is sent is the PV itself, and what is repeated only says that it is near)

`e` residual of the process alone. (Hampel 1974; Widrow and Kollar, Quantization Noise, 2008.)
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import scipy

from autotuner.core.signals.noise import MAD_TO_SIGMA

if TYPE_CHECKING:
    from autotuner.core.model.arrays import BoolArray, FloatArray

WINDOW = 15
"""Samples of the running median; outliers of up to seven samples in a row are distinguished from the motion."""
BEYOND, BEYOND_MOVES = 6.0, 4.0
"""Size of a spike in robust sigmas, and of its jumps in large moves of the residual between two samples."""
BEYOND_MOTION = 1.5
"""Jumps of a spike in moves of the process: a model without a limit misses by as much as the process moves."""
COMES_BACK = 0.5
"""Jump that ends a run over the one that begins it, from which the reading comes back."""
MOST_SPIKES = 0.12
"""Share of the samples above which outliers are not isolated."""
AT_THE_END = 4
"""Samples between a jump and the end of the record up to which they count as a run of their own."""
OTHER_KIND = 9.0
"""Median size of the spikes, in robust sigmas, from which they are not the noise's own tail."""
HARMFUL = 0.15
"""Share that the spikes add to the mean square from which they are named."""
COARSE = 0.8
"""Noise of the grid over the other noise from which the grid is named."""
STANDING = 0.5
"""Share of repeated values from which a sensor is taken to report changes only."""
STANDING_BUT_MOVING = 0.2
"""The same where every value is the PV's own and no move is small: the PV moves at most samples."""
LEAST_MOVE, CLEAR_MOVE = 0.2, 0.5
"""Smallest move over the usual one from which moves are those of a sensor that reports changes; the second for that."""
OWN_VALUES = 0.8
"""Different values over changes of the reading from which a sensor sends what it measures: on a grid they repeat."""
FEWEST_NEW, FEWEST_ELSEWHERE = 20, 3
"""New readings of a sensor that repeats them from which a process is known by them: it has up to ten numbers. On the
part that is not fitted, they judge only."""
FROZEN = 8
"""Equal values in a row that are a frozen sensor, where hardly any value is repeated elsewhere."""
VISIBLE, MOST_JUMPS = 6.0, 4
"""Excess of a jump over the robust deviation of all differences, and the most jumps that are tried."""
NEIGHBOURS = 5
"""Moves between samples whose median is the slope of the PV beside a jump."""
FAR_BACK = 4.0
"""Jump at the end of a frozen run, in usual moves between two samples."""


@dataclass(frozen=True, slots=True)
class Grid:
    """A coarse sensor: `step` between values, PV; `half` how far the PV may be from a reading.

    `sends` says that the sensor sends what it measures, and repeats it until the PV has moved by a step: a reading that
    is new is the PV itself.
    """

    step: float
    half: float
    rounded: bool
    sends: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class SensorRecord:
    """Sensor of a record: samples that are not measurements, and its quantisation."""

    spikes: BoolArray
    frozen: BoolArray
    grid: Grid | None


def spikes_of(residual: FloatArray, sigma: float, motion: float = 0.0) -> BoolArray:
    """Return which samples are spikes or short bursts.

    Parameters
    ----------
    residual : array of float, shape (N,)
        Measured minus simulated PV.
    sigma : float
        Noise of the sensor, PV.
    motion : float
        Most that the process moves between two samples, PV.
    """
    if residual.size < WINDOW:
        return np.zeros(residual.size, dtype=np.bool_)
    off = np.abs(residual - scipy.ndimage.median_filter(residual, size=WINDOW, mode="mirror"))
    spread = max(MAD_TO_SIGMA * float(np.median(off)), 0.3 * sigma)
    moves = np.diff(residual)
    usual = float(np.quantile(np.abs(moves)[~_around_single(moves, BEYOND * spread)], 0.9))
    jump = max(BEYOND_MOVES * usual, BEYOND * spread, BEYOND_MOTION * motion)
    result = _between_jumps(moves, jump) & (off > BEYOND * spread)
    few = 0 < np.count_nonzero(result) <= MOST_SPIKES * residual.size
    if not few or float(np.median(off[result])) < OTHER_KIND * spread:
        return np.zeros(residual.size, dtype=np.bool_)
    return result


def _around_single(moves: FloatArray, least: float) -> BoolArray:
    """Return the moves there and back at single samples: of one sample in eight, they are one in four of all moves."""
    back = (moves[1:] * moves[:-1] < 0.0) & (np.minimum(np.abs(moves[1:]), np.abs(moves[:-1])) > least)
    result: BoolArray = np.append(back, False) | np.append(False, back)
    return result if not result.all() else ~result


def _between_jumps(moves: FloatArray, jump: float) -> BoolArray:
    """Return the samples of short runs between two jumps: a misfit has corners, but no such runs.

    The last jump returns the reading: an offset that fades while a controller responds has none.
    """
    size = moves.size + 1
    inside = np.zeros(size, dtype=np.bool_)
    edges = np.flatnonzero(np.abs(moves) > jump).tolist()
    for group in _close_together(edges):
        whole = moves[group[0] : group[-1] + 1]
        largest = float(np.abs(moves[group]).max())
        returns = abs(float(whole.sum())) < COMES_BACK * largest <= abs(moves[group[-1]])
        for a, b in pairwise(group):
            there_and_back = moves[a] * moves[b] < 0.0 and _ratio(moves[a], moves[b]) > COMES_BACK
            if returns or there_and_back:
                inside[a + 1 : b + 1] = True
    if edges and size - 1 - edges[-1] <= AT_THE_END:
        inside[edges[-1] + 1 :] = True  # the record ends before the reading comes back
    inside[0] |= 0 in edges and 1 not in edges  # or begins with a wild reading
    return inside


def _close_together(edges: list[int]) -> list[list[int]]:
    """Return jumps in groups in which each follows the one before within the longest run."""
    groups: list[list[int]] = []
    for edge in edges:
        if groups and edge - groups[-1][-1] <= WINDOW // 2:
            groups[-1].append(edge)
        else:
            groups.append([edge])
    return groups


def _ratio(a: float, b: float) -> float:
    small, large = sorted((abs(a), abs(b)))
    return small / large


def frozen(pv: FloatArray, moved: int) -> BoolArray:
    """Return the samples at which the sensor is frozen for long, after the output moved, and then jumps back."""
    same = np.concatenate(([False], np.diff(pv) == 0.0))
    if same.mean() > STANDING / 2.0:
        return np.zeros(pv.size, dtype=np.bool_)
    edges = np.flatnonzero(np.diff(np.concatenate(([0], same.astype(int), [0]))))
    result = np.zeros(pv.size, dtype=np.bool_)
    moves = np.abs(np.diff(pv))
    usual = float(np.median(moves[moves > 0.0])) if moves.any() else 0.0
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        jumps = end < pv.size and abs(pv[end] - pv[end - 1]) > FAR_BACK * usual
        if start > moved and end - start >= FROZEN and jumps and not _is_a_limit(pv, start, end):
            result[start:end] = True
    return result


def visible_jumps(t: FloatArray, pv: FloatArray, floor: float) -> list[tuple[float, float]]:
    """Return times, s, and sizes, PV, of possible jumps of the reading, detected without a process.

    Parameters
    ----------
    t, pv : array of float, shape (N,)
        Samples that are measurements.
    floor : float
        Least deviation that counts, PV.
    """
    if pv.size < WINDOW:
        return []
    d = np.diff(pv)
    odd = d[1:-1] - (d[:-2] + d[2:]) / 2.0
    back = comes_back(d)[1:-1]
    usual = max(MAD_TO_SIGMA * float(np.median(np.abs(odd))), floor)
    size = np.abs(odd)
    beside = np.maximum(np.append(size[1:], 0.0), np.append(0.0, size[:-1]))  # a jump is odd for its neighbours, too
    clear = np.flatnonzero((size > VISIBLE * usual) & (size >= beside) & ~back)
    clear = np.sort(clear[np.argsort(-np.abs(odd[clear]), kind="stable")[:MOST_JUMPS]])
    return [(float(t[k + 1] + t[k + 2]) / 2.0, float(odd[k])) for k in clear]


def comes_back(moves: FloatArray) -> BoolArray:
    """Return which moves of the PV between two samples are taken back at once: a wild reading, and no jump.

    The slope of the PV is no part of them: it is the median of five moves, of which a wild reading makes two.
    """
    own = moves - scipy.ndimage.median_filter(moves, size=NEIGHBOURS, mode="nearest")
    beside = np.concatenate((own[:1], own, own[-1:]))
    result: BoolArray = np.minimum(np.abs(own + beside[:-2]), np.abs(own + beside[2:])) < COMES_BACK * np.abs(own)
    return result


def _is_a_limit(pv: FloatArray, start: int, end: int) -> bool:
    """Return whether a constant run lies at the end of the PV's range, where the PV also was at another time."""
    value = pv[start]
    elsewhere = np.count_nonzero(pv[:start] == value) - 1 + np.count_nonzero(pv[end:] == value)
    return bool(value in {pv.min(), pv.max()} and elsewhere > 1)


def grid_of(pv: FloatArray) -> Grid | None:
    """Return the grid of a coarse sensor, or None."""
    values = np.unique(pv)
    if values.size < 3 or values.size > 0.7 * pv.size:
        return _on_change(pv)
    steps = np.diff(values)
    step = float(steps.min())
    whole = steps / step
    if np.abs(whole - np.round(whole)).max() < 0.02 and step > 1e-9 * abs(values[-1]):
        return Grid(step, step / 2.0, rounded=True)
    return _on_change(pv)


def _on_change(pv: FloatArray) -> Grid | None:
    moves = np.abs(np.diff(pv))
    moved = moves[moves > 0.0]
    repeated = float(np.mean(moves == 0.0))
    if not moved.size or repeated < STANDING_BUT_MOVING:
        return None
    step, usual = float(np.quantile(moved, 0.03)), float(np.median(moved))
    sends = np.unique(pv).size > max(OWN_VALUES * moved.size, 2.0)
    is_clear = sends and step > CLEAR_MOVE * usual
    known = is_clear or (repeated >= STANDING and step > LEAST_MOVE * usual)
    return Grid(step, step, rounded=False, sends=sends) if known else None


def new_readings(pv: FloatArray) -> BoolArray:
    """Return the samples at which a reading is not that of the sample before."""
    result: BoolArray = np.append(True, np.diff(pv) != 0.0)
    return result
