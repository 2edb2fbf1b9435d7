"""Initial guesses of the search: a coarse scan of shapes and dead times, because both have local minima.

For every shape of a grid the response is computed once and read off at many dead times together; the linear part is
solved for all of them at once. The best dead time of each shape is a candidate, and the best candidates are starts.

The grid is geometric: time constants from about one sample to a few recordings, damping from ringing to one lag far
longer than the other. A process that rings many times between the points of the grid is found by a regression of every
k-th sample instead:

    y_i+2 = a y_i+1 + b y_i + c u_i+1 + d u_i + e,   poles of z^2 - a z - b = e^{s k h}   (Ljung, System Identification)
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.estimation.backgrounds import background_columns, score
from autotuner.core.model.structures import FOPDT, PURE_INTEGRATOR, SECOND_ORDER

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.estimation.backgrounds import Background
    from autotuner.core.estimation.data import Data, GainPrior
    from autotuner.core.model.arrays import BoolArray, FloatArray
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.model.structures import Structure

SAMPLES = 220
"""Most samples that the scan uses."""
TIMES, PAIR_TIMES = 14, 10
DELAYS = 22
"""Dead times of the scan: with 21 steps in the logarithm over a factor 500, each is 1.36 times the one before."""
DAMPINGS = (0.15, 0.35, 0.7, 1.2, 3.0)
THIRD_DAMPINGS, THIRD_LAGS = (0.5, 1.0, 2.0), (0.15, 0.6)
"""Damping of the pair and the third lag, over the pair's time, of the scan of third-order processes."""
LONGEST_TIME = 3.0
"""Longest time constant of the scan, in lengths of the record: a longer one is an integrator to it."""
STRIDES, FEWEST_REGRESSED = (1, 2, 4, 8), 50
"""Samples between those of a regression, and how many of these it needs."""
LONGEST_DELAY = 0.4
"""Longest time constant and dead time tried, in lengths of the recording."""
LONG, SHORT = 10.0, 0.1
"""Lag that approximates an integrator, over all other times; second lag of a process that has none, over the shorter of
lag and dead time."""
VANISHED = 1e-100
"""Length of a column under which it has decayed to nothing."""
RIDGE = 1e-10
"""Regularisation of the normal equations for dependent columns; far below the differences between guesses."""


@dataclass(frozen=True, slots=True)
class Start:
    """An initial guess of the search, and its score; measured disturbances with their own dead times, s."""

    shape: tuple[float, ...]
    delay_s: float
    score: float
    others_s: tuple[float, ...] = ()


def starts_from(model: ProcessModel | None, structure: Structure) -> tuple[Start, ...]:
    """Return a known model as the start for a structure of at most two lags, its own or a near one; else none.

    With fewer lags than the model, half of the second lag goes to the first and half to the dead time (half rule;
    Skogestad, J. Process Control 13, 2003). With more, the second is short. An integrator and a long lag replace each
    other.
    """
    a0, n, m = (-1.0, 0.0, 0.0) if model is None else model.rational().a[:3]
    if model is None or a0 < 0.0 or structure not in {FOPDT, SECOND_ORDER, PURE_INTEGRATOR}:
        return ()
    D, second = model.D, m / n
    first = n if a0 > 0.0 else LONG * (second + D)
    if not first > 0.0:
        return ()
    if structure is SECOND_ORDER:
        return (Start((first, max(second, SHORT * (min(first, second + D) or first))), D, 0.0),)
    late = second / 2.0
    return (Start((max(first - late, first / 2.0),)[: len(structure.shape)], D + late, 0.0),)


def scans(
    data: Data,
    structure: Structure,
    background: Background,
    priors: Sequence[GainPrior],
    more: Sequence[tuple[float, ...]] = (),
) -> list[list[Start]]:
    """Return for each prior one start for each shape of the grid and some more, the best first.

    Parameters
    ----------
    data : Data
        The recording; it is thinned here.
    structure : Structure
        What is to be fitted.
    background : tuple of str
        Names of the background's columns.
    priors : sequence of GainPrior
        Prior knowledge of the static gain: several differ in its sign only, and share the responses.
    more : sequence of tuple of float
        Further shapes.
    """
    thin, delays = data.thinned(SAMPLES), delays_of(data)
    guesses: list[list[Start]] = [[] for _ in priors]
    for shape in (*_shapes(data, structure), *more):
        data.require_time()
        scores, gains = _scores(thin, structure, shape, delays, background, priors[0].known)
        for prior, found in zip(priors, guesses, strict=True):
            allowed = np.where(_allowed(gains, prior), scores, np.inf)
            best = int(np.argmin(allowed))
            found.append(Start(tuple(shape), float(delays[best]), float(allowed[best])))
    return [sorted(found, key=lambda start: start.score) for found in guesses]


def ringing_shapes(t: FloatArray, output: FloatArray, pv: FloatArray) -> list[tuple[float, float]]:
    """Return `n` and `m/n` of processes that ring, by regression of evenly spaced samples."""
    found = []
    for stride in STRIDES:
        y, u, h = pv[::stride], output[::stride], stride * float(np.median(np.diff(t)))
        if y.size < FEWEST_REGRESSED:
            break
        columns = np.column_stack((y[1:-1], y[:-2], u[1:-1], u[:-2], np.ones(y.size - 2)))
        a, b, *_ = np.linalg.lstsq(columns, y[2:], rcond=None)[0].tolist()
        poles = np.roots([1.0, -a, -b])
        if np.iscomplexobj(poles) and 0.0 < abs(poles[0]) < 1.0:
            s = np.log(poles[0]) / h
            found.append((-2.0 * s.real / abs(s) ** 2, -0.5 / s.real))
    return found


def _shapes(data: Data, structure: Structure) -> list[tuple[float, ...]]:
    interval = data.span_s / (data.t.size - 1)
    if not structure.shape:
        return [()]
    count = TIMES if len(structure.shape) == 1 else PAIR_TIMES
    times = np.geomspace(interval, LONGEST_TIME * data.span_s, count).tolist()
    if len(structure.shape) == 1:
        return [(time,) for time in times]
    if len(structure.shape) == 2:
        return [(2.0 * z * time, time / (2.0 * z)) for time, z in itertools.product(times, DAMPINGS)]
    grid = itertools.product(times, THIRD_DAMPINGS, THIRD_LAGS)
    return [(2.0 * z * time, time / (2.0 * z), share * time) for time, z, share in grid]


def delays_of(data: Data) -> FloatArray:
    """Return the dead times that are tried, s."""
    interval = data.span_s / (data.t.size - 1)
    longest = LONGEST_DELAY * data.span_s
    return np.concatenate(
        ([0.0], np.geomspace(min(max(interval, longest / 500.0), longest / 2.0), longest, DELAYS - 1))
    )


def _scores(
    data: Data,
    structure: Structure,
    shape: Sequence[float],
    delays: FloatArray,
    background: Background,
    known_gain: float | None,
) -> tuple[FloatArray, FloatArray]:
    """Return the score at each of the delays, and the gains there, shape (number of delays, number of gains)."""
    motion = structure.motion(shape, data.span_s)
    shifted_times = data.t - delays[:, None]
    columns = list(motion.forced(data.held, shifted_times)[0])
    target = np.broadcast_to(data.pv, shifted_times.shape)
    if known_gain is not None:
        target = target - known_gain * columns.pop(0)
    columns += [
        np.broadcast_to(column, shifted_times.shape)
        for column, _ in background_columns(data, motion, background, shifted_times)
    ]
    columns += [motion.forced(other, shifted_times)[0][0] for other in data.others]
    weight = data.weight * ((shifted_times >= 0.0) if "state" in background else 1.0)
    phi = np.stack(columns, axis=1) * np.expand_dims(weight, -2)
    target = target * weight
    size = np.sqrt(np.einsum("dln,dln->dl", phi, phi))[..., None]
    phi = np.where(size > VANISHED, phi / np.maximum(size, VANISHED), 0.0)
    gram = phi @ phi.transpose(0, 2, 1) + RIDGE * np.eye(phi.shape[1])
    moment = np.einsum("dln,dn->dl", phi, target)
    solved = np.linalg.solve(gram, moment[..., None])[..., 0]
    residual = target - np.einsum("dl,dln->dn", solved, phi)
    used = np.count_nonzero(np.broadcast_to(weight, residual.shape), axis=1)
    return score(np.einsum("dn,dn->d", residual, residual), used, data), solved[:, : structure.gains]


def _allowed(gains: FloatArray, prior: GainPrior) -> BoolArray:
    """Return which gains of the scan agree with what is known of them."""
    if prior.known is not None:
        return np.ones(len(gains), dtype=np.bool_)
    allowed: BoolArray = gains[:, 0] * prior.sign >= 0.0
    # A zero on the other side is another process, with more dead time, and leads the search away from this one.
    return allowed if gains.shape[1] == 1 else allowed & (gains[:, 0] * gains[:, 1] <= 0.0)
