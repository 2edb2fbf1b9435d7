"""Forms that no textbook has: a load that follows a smooth curve of time, loads and jumps that end again.

    load     G[sum_j c_j B_j(t)]            B-splines over the fitted part, constant after it
    pulse    + c G[step(t - ts) - step(t - ts - d)],   and the same on the reading
    ramp     + c G[min((t - ts)/d, 1)]
    settles  + c G[1 - e^{-(t - ts)/T}]

A free load is called by the shape that it takes: a load step where nearly all of its change comes at once, a drift
where it goes one way, a periodic disturbance where it comes back several times, and ambient otherwise. The search
takes a textbook form in its place where that is as good, because it has fewer numbers. (Splines: de Boor, A Practical
Guide to Splines, 2001.)
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
import scipy

from autotuner.core.diagnosis.effects.declared import lagged
from autotuner.core.diagnosis.extended.effect import Effect, Place, Searched, View
from autotuner.core.model.zoh_input import HeldInput

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

    _Held = tuple[FloatArray, FloatArray]
    """Times and levels of an input that is held in between."""

SPLINES, SPLINES_AFTER = (6, 11), 4
"""Numbers of splines of a free load over the fitted part, and over the selection part."""
PIECES = 120
"""Steps in which a curve of time is written."""
AT_ONCE, NEARLY_ALL = 0.25, 0.8
"""Share of the record within which this share of a load's change comes where it is a step."""
ONE_WAY = 0.85
"""Way from beginning to end over the range from which a load goes one way."""
OFTEN, LARGE = 6, 0.3
"""Reversals from which a load is periodic, and the smallest return of each as a share of its range."""
COINCIDENCE, FEW_MOVES = 0.1, 10
"""Share of the record within this distance of a move of the output, above which a coincidence is chance; and the most
moves for which a response is not separated from other events."""
MOMENTS, LASTING = (0.05, 0.15, 0.25, 0.35, 0.45, 0.55, 0.65, 0.75), (0.08, 0.2)
"""Starts of moments and durations, as shares of the record."""
SHARES: FloatArray = (np.arange(40, dtype=np.float64) + 0.5) / 40.0
"""Middles of the equal steps in which a load that ramps is written, as shares of it."""


def free_forms(dataset: Dataset) -> tuple[Effect, ...]:
    """Return the forms, with starts from the length of the fitted part."""
    loads = tuple(_free_load(dataset, count) for count in SPLINES)
    return (*loads, _pulse(dataset), _ramp(dataset), _settling(dataset), _there_and_back(dataset))


def _free_load(dataset: Dataset, count: int) -> Effect:
    until = dataset.fitted_until_s
    times = np.linspace(0.0, until, PIECES, endpoint=False)
    curves = _splines(times / until, count)
    loads = HeldInput(times, curves - curves[:, :1])

    def columns(view: View, _p: Sequence[float]) -> list[FloatArray]:
        return list(view.forced(loads, delayed=False))

    def sizes(_p: Sequence[float], c: Sequence[float], g: float) -> Mapping[str, float]:
        return {"range": float(np.ptp(np.array(c) @ curves)) / abs(g)}

    return Effect(
        "ambient",
        Place.DISTURBANCE,
        (),
        [()],
        sizes,
        form=f"free, {count} splines",
        columns=columns,
        price=2.0,
        group="slow",
        unseen_after=True,
        reads_as=lambda c: shape_of(np.array(c) @ curves),
    )


def free_load_after(view: View) -> FloatArray:
    """Return the responses to loads of free shape that begin at the end of the fitted part, shape (N, splines)."""
    dataset = view.dataset
    times = np.linspace(dataset.fitted_until_s, dataset.span_s, PIECES // 2, endpoint=False)
    curves = _splines((times - times[0]) / (dataset.span_s - times[0]), SPLINES_AFTER)
    loads = HeldInput(np.append(0.0, times), np.column_stack((np.zeros(curves.shape[0]), curves)))
    return view.forced(loads, delayed=False).T


def _splines(x: FloatArray, count: int) -> FloatArray:
    """Return cubic B-splines over 0 to 1 without the first, which an offset takes the place of, shape (count, N)."""
    inner = np.linspace(0.0, 1.0, count - 1)
    knots = np.concatenate((np.zeros(3), inner, np.ones(3)))
    result: FloatArray = scipy.interpolate.BSpline.design_matrix(x, knots, 3).toarray().T[1:]
    return result


def shape_of(curve: FloatArray) -> str:
    """Return the name of a load of this course."""
    whole = float(np.ptp(curve))
    if whole <= 0.0:
        return "ambient"
    width = int(AT_ONCE * curve.size)
    within = np.abs(curve[width:] - curve[:-width])
    if abs(float(curve[-1] - curve[0])) >= ONE_WAY * whole:
        return "load_step" if float(within.max()) >= NEARLY_ALL * whole else "drift"
    return "periodic_disturbance" if _turns(curve, LARGE * whole) >= OFTEN else "ambient"


def _turns(curve: FloatArray, least: float) -> int:
    """Return how often a curve turns and goes back by `least` at least."""
    turns, way, extreme = 0, 0.0, float(curve[0])
    for value in curve.tolist():
        if (value - extreme) * way >= 0.0 and (way or abs(value - extreme) < least):
            extreme = value if way else extreme
        elif abs(value - extreme) >= least:
            turns, way, extreme = turns + (way != 0.0), math.copysign(1.0, value - extreme), value
    return turns


def moment_of(dataset: Dataset, moments: Sequence[float] = MOMENTS) -> tuple[Searched, list[float]]:
    """Return the moment of an event, in spans of the record, and its starts, given as shares of the fitted part."""
    share = dataset.fitted_until_s / dataset.span_s
    return Searched("moment", 0.005, 0.995, 1e-4), [share * m for m in moments]


def by_chance(dataset: Dataset, at_s: float) -> bool:
    """Return whether something that begins at a time may do so by chance: not right after one of a few moves.

    An event after a move of the output is a response to it, and neither a load nor a change of gain.
    """
    moves = dataset.data.held.times[1:]
    before = moves[moves <= at_s + dataset.data.interval_s]
    if not 0 < before.size <= moves.size <= FEW_MOVES:
        return True
    since = max(at_s - float(before[-1]), 0.0) + dataset.data.interval_s
    gaps = np.diff(np.append(moves, max(dataset.span_s, float(moves[-1]))))
    return float(np.minimum(gaps, since).sum()) > COINCIDENCE * dataset.span_s


def _lasting(dataset: Dataset) -> tuple[tuple[Searched, ...], list[tuple[float, ...]]]:
    moment, starts = moment_of(dataset)
    return (moment, Searched("lasts", 0.01, 0.9, 1e-4)), [(s, d) for s in starts for d in LASTING]


def _lasting_load(dataset: Dataset, form: str, duration: str, shape: Callable[[float, float], _Held]) -> Effect:
    """Return a load of a shape: its times in spans of the record, and its levels, by begin and duration in spans."""
    span = dataset.span_s
    searched, starts = _lasting(dataset)

    def columns(view: View, p: Sequence[float]) -> list[FloatArray]:
        times, levels = shape(p[0], p[1])
        return [view.forced(HeldInput(times * span, levels), delayed=False)]

    return Effect(
        "load_step",
        Place.DISTURBANCE,
        searched,
        starts,
        lambda p, c, g: {"size": c[0] / g, "at_s": p[0] * span, duration: p[1] * span},
        form=form,
        columns=columns,
        price=math.log(20.0),
        group="step",
        means=lambda p, _c, _g, _shape: by_chance(dataset, p[0] * span),
    )


def _pulse(dataset: Dataset) -> Effect:
    def shape(begins: float, lasts: float) -> _Held:
        return np.array([0.0, begins, begins + lasts]), np.array([0.0, 1.0, 0.0])

    def means(p: Sequence[float], _c: Sequence[float], _gain: float, _shape: Sequence[float]) -> bool:
        # The response to a move does not end, unless with the next one.
        return any(by_chance(dataset, share * dataset.span_s) for share in (p[0], p[0] + p[1]))

    return replace(_lasting_load(dataset, "ends again", "lasts_s", shape), means=means)


def _ramp(dataset: Dataset) -> Effect:
    def shape(begins: float, lasts: float) -> _Held:
        return np.concatenate(([0.0], begins + lasts * SHARES)), np.concatenate(([0.0], SHARES + SHARES[0]))

    return _lasting_load(dataset, "ramp", "rises_over_s", shape)


def _settling(dataset: Dataset) -> Effect:
    def shape(begins: float, lasts: float) -> _Held:
        held = lagged(HeldInput(np.array([0.0, begins]), np.array([0.0, 1.0])), lasts)
        return held.times, held.levels

    return _lasting_load(dataset, "settling", "time_constant_s", shape)


def _there_and_back(dataset: Dataset) -> Effect:
    span, interval = dataset.span_s, dataset.data.interval_s
    searched, starts = _lasting(dataset)
    at = [moment / span for moment, _ in dataset.visible_jumps]
    starts += [(begins, ends - begins) for begins, ends in combinations(at, 2)]

    def columns(view: View, p: Sequence[float]) -> list[FloatArray]:
        begins, ends = ((p[0] + more) * span for more in (0.0, p[1]))
        # Ramps over one sample, so that the search has a slope to go by.
        edges = (np.clip((view.t - at) / interval + 0.5, 0.0, 1.0) for at in (begins, ends))
        return [next(edges) - next(edges)]

    return Effect(
        "bias_step",
        Place.SENSOR,
        searched,
        starts,
        lambda p, c, _g: {"size": c[0], "at_s": p[0] * span, "lasts_s": p[1] * span},
        form="there and back",
        columns=columns,
        price=math.log(20.0),
        group="jump",
        blur=lambda _p: {"at_s": 0.5 * interval, "lasts_s": interval},
    )
