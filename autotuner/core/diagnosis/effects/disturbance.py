"""Disturbances, and errors of the sensor that resemble them.

load_step             + c G[step at ts]             at the input of the process
drift                 + c max(t - ts, 0)            on the PV; or c1 t + c2 t^2 + c3 t^3, or c t^n
periodic_disturbance  (see `waves`)
measured_disturbance  + c d/(Td s + 1)              `d` a further column of the record
ambient               the same, for a column that is named so
bias_step             + c step at ts                on the PV
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effects.declared import lagged
from autotuner.core.diagnosis.effects.sawtooth import sawtooth
from autotuner.core.diagnosis.effects.waves import periodic_disturbances
from autotuner.core.diagnosis.extended.effect import Effect, Place, Searched, View
from autotuner.core.model.step_responses import Lag
from autotuner.core.model.zoh_input import HeldInput, accumulate, held_input

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

    Columns = Callable[[View, Sequence[float]], list[FloatArray]]
    Sizes = Callable[[Sequence[float], Sequence[float], float], Mapping[str, float]]
    Way = tuple[str, tuple[Searched, ...], Sequence[tuple[float, ...]], Columns]

STEP_OVER_NOISE = math.sqrt(12.0)
"""A step of rounding over the standard deviation of its error, which is uniform (Widrow and Kollar, 2008)."""
MOST_POWER = 5.0
"""Largest power of time along which a drift grows: beyond, it begins late."""
MOMENTS = 24
"""Moments at which a step is tried."""
FEW_MOVES = 60
"""Moves of a measured disturbance up to which it is tried at the input of the process, too."""
SAME_LEVEL = 1e-6
"""Difference of two levels of a measured disturbance, in its range, that counts as none."""
MOST_STEPS = 500
"""Steps in which a measured disturbance is written."""
AMBIENT = ("ambient", "amb", "ext", "outside", "room", "env")
"""Parts of a column's name by which it is taken for the surroundings."""


def disturbance_effects(
    dataset: Dataset, residuals: Sequence[FloatArray], jumps: Sequence[float]
) -> tuple[Effect, ...]:
    """Return the effects, with starts from residuals; `jumps` are likely moments of a jump of the reading, s."""
    return (
        _load_step(dataset),
        # Beside another effect the likeliest jumps of the process alone may be none.
        _bias_step(dataset, (np.linspace(0.02, 0.98, 2 * MOMENTS) * dataset.fitted_until_s).tolist()),
        *((_bias_step(dataset, jumps),) if jumps else ()),
        *_drifts(dataset),
        *periodic_disturbances(dataset, residuals),
        *sawtooth(dataset, residuals),
        *(
            e
            for name, values in dataset.extra.items()
            if np.isfinite(values).all() and np.ptp(values) > 0.0
            for e in _measured(dataset, name)
        ),
    )


def _moments(dataset: Dataset) -> list[tuple[float, ...]]:
    return [(float(share),) for share in np.linspace(0.02, 0.98, MOMENTS) * dataset.fitted_until_s / dataset.span_s]


def _load_step(dataset: Dataset) -> Effect:
    span = dataset.span_s

    def columns(view: View, p: Sequence[float]) -> list[FloatArray]:
        step = HeldInput(np.array([0.0, p[0] * span]), np.array([0.0, 1.0]))
        return [np.where(view.t < p[0] * span, 0.0, view.forced(step, delayed=False))]

    return Effect(
        "load_step",
        Place.DISTURBANCE,
        (Searched("moment", 0.005, 0.995, 1e-5),),
        _moments(dataset),
        lambda p, c, g: {"at_s": p[0] * span, "size": c[0] / g},
        columns=columns,
        price=math.log(MOMENTS),
        group="step",
    )


def load_at_the_input(dataset: Dataset) -> Effect:
    """Return a load step that a process which answers to its own PV feels, too; its size is searched for."""
    span, swing = dataset.span_s, dataset.swing
    return Effect(
        "load_step",
        Place.DISTURBANCE,
        (Searched("moment", 0.005, 0.995, 1e-5), Searched("size", -3.0, 3.0, 1e-4)),
        [],
        lambda p, _c, _g: {"at_s": p[0] * span, "size": p[1] * swing},
        form="at the input",
        load=lambda p, _: HeldInput(np.array([0.0, p[0] * span]), np.array([0.0, p[1] * swing])),
        price=math.log(MOMENTS),
        group="step",
    )


def _bias_step(dataset: Dataset, moments: Sequence[float]) -> Effect:
    """Return a jump of the reading; one as small as a step of a rounded reading is rounding, of two steady values."""
    span, interval = dataset.span_s, dataset.data.interval_s

    def columns(view: View, p: Sequence[float]) -> list[FloatArray]:
        # A ramp over one sample, so that the search has a slope to go by.
        return [np.clip((view.t - p[0] * span) / interval + 0.5, 0.0, 1.0)]

    return Effect(
        "bias_step",
        Place.SENSOR,
        (Searched("moment", 0.005, 0.995, 0.5 / max(dataset.data.t.size, 2), profiled=True),),
        [(at_s / span,) for at_s in moments],
        lambda p, c, _g: {"at_s": p[0] * span, "size": c[0]},
        columns=columns,
        price=math.log(2 * MOMENTS),
        group="jump",
        means=lambda _p, c, _g, _shape: abs(c[0]) > STEP_OVER_NOISE * dataset.grid_noise,
        blur=lambda _p: {"at_s": 0.5 * interval},
    )


def _drifts(dataset: Dataset) -> tuple[Effect, ...]:
    """Return a straight drift, one that begins in the record, and one that settles."""
    span = dataset.span_s
    start = Searched("start", 0.0, 0.9, 1e-4)
    settle = (Searched("log_time", math.log(0.02), math.log(3.0), 1e-4), replace(start, low=-0.5))
    ways: tuple[tuple[str, tuple[Searched, ...], Sequence[tuple[float, ...]], Columns, Sizes], ...] = (
        ("", (), [()], lambda view, _p: [view.t / span], lambda _p, c, _g: {"pv_per_s": c[0] / span}),
        (
            "late",
            (start,),
            [(0.1,), (0.3,), (0.5,), (0.7,)],
            lambda view, p: [np.maximum(view.t / span - p[0], 0.0)],
            lambda p, c, _g: {"pv_per_s": c[0] / span, "from_s": p[0] * span},
        ),
        (
            "settling",
            settle,
            [(math.log(time), begin) for time in (0.1, 0.4) for begin in (0.0, 0.3)],
            lambda view, p: [-np.expm1(-np.maximum(view.t / span - p[1], 0.0) / math.exp(p[0]))],
            lambda p, c, _g: {"pv_in_all": c[0], "time_constant_s": math.exp(p[0]) * span, "from_s": p[1] * span},
        ),
    )
    return tuple(
        Effect(
            "drift",
            Place.DISTURBANCE,
            searched,
            starts,
            sizes,
            form=form,
            columns=columns,
            price=2.0 if form else 0.0,
            group="slow",
        )
        for form, searched, starts, columns, sizes in ways
    )


def curved_drift(dataset: Dataset) -> Effect:
    """Return a drift along a cubic of time; it follows many things, and is tried in the place of another course."""
    span = dataset.span_s

    def cubic(x: FloatArray | float) -> FloatArray:
        return np.array([x, np.square(x), np.power(x, 3)])

    return Effect(
        "drift",
        Place.DISTURBANCE,
        (),
        [()],
        lambda _p, c, _g: {"pv_in_all": float(np.dot(c, cubic(dataset.fitted_until_s / span)))},
        form="curved",
        columns=lambda view, _p: list(cubic(view.t / span)),
        price=2.0,
        group="slow",
        other_forms=(_accelerating_drift(dataset),),
    )


def _accelerating_drift(dataset: Dataset) -> Effect:
    """Return a drift along a power of time; it has fewer numbers than a cubic, and predicts more."""
    span, until = dataset.span_s, dataset.fitted_until_s / dataset.span_s
    return Effect(
        "drift",
        Place.DISTURBANCE,
        (Searched("power", 1.0, MOST_POWER, 1e-4),),
        [(2.0,), (3.0,)],
        lambda p, c, _g: {"pv_in_all": c[0] * until ** p[0], "power": p[0]},
        form="accelerating",
        columns=lambda view, p: [np.power(view.t / span, p[0])],
        price=2.0,
        group="slow",
    )


@lru_cache(maxsize=16)
def _between(dataset: Dataset, name: str) -> HeldInput:
    """Return a measured disturbance as steps half-way between its samples, few enough to be quick."""
    t, values = dataset.data.t, dataset.extra[name]
    edges = np.unique(np.linspace(0, t.size - 1, min(t.size, MOST_STEPS)).astype(int))
    path = np.concatenate(([0.0], np.cumsum((values[1:] + values[:-1]) / 2.0 * np.diff(t))))
    means = np.diff(path[edges]) / np.diff(t[edges])
    grain = SAME_LEVEL * (float(np.ptp(values)) or 1.0)
    means = np.round(means / grain) * grain  # rounding makes no moves
    return held_input(t[edges], np.append(means, values[-1]))


def behind_a_lag(t: FloatArray, values: FloatArray, lag_s: float) -> FloatArray:
    """Return the response of a lag of unit gain to a polyline, as deviation from its start.

    `z_k+1 = d_k+1 - s T + (z_k - d_k + s T) e^{-h/T}`, `s` the slope between the two samples.
    """
    h, d = np.diff(t), values - values[0]
    kept = np.exp(-h / lag_s)
    late = lag_s * np.diff(d) / h
    added = d[1:] - late - (d[:-1] - late) * kept
    return accumulate(np.concatenate(([0.0], kept)), np.concatenate(([0.0], added)))


def _measured(dataset: Dataset, name: str) -> tuple[Effect, ...]:
    """Return a disturbance that reaches the PV through its own lag, and one that also passes the process.

    The latter has no lag beside the process's own (a neighbour's temperature), or, where it moves now and then, one (a
    neighbour's heater).
    """
    outside = _between(dataset, name)
    ambient = any(part in name.lower() for part in AMBIENT)
    span = dataset.span_s

    def beside(view: View, p: Sequence[float]) -> list[FloatArray]:
        lag, t = Lag(math.exp(p[0])), view.dataset.data.t
        answer = np.interp(view.t, t, behind_a_lag(t, view.dataset.extra[name], lag.T))
        return [answer, *(() if dataset.settled_first else lag.free(view.t))]

    def through(view: View, p: Sequence[float]) -> list[FloatArray]:
        entering = lagged(_between(view.dataset, name), math.exp(p[0]), finest_s=dataset.finest_s)
        return [view.forced(entering, delayed=False)]

    def into(view: View, _p: Sequence[float]) -> list[FloatArray]:
        return [view.forced(_between(view.dataset, name), delayed=False)]

    lag = (Searched("log_lag", math.log(dataset.data.interval_s / 10.0), math.log(2.0 * span), 1e-4),)
    starts = [(math.log(share * span),) for share in (0.002, 0.02, 0.1, 0.4)]
    ways: list[Way] = [("", lag, starts, beside)]
    if outside.times.size <= FEW_MOVES:
        ways.append(("through the process", lag, starts, through))
    if not dataset.tuned:
        ways.append(("into the process", (), [()], into))
    return tuple(
        Effect(
            "ambient" if ambient else "measured_disturbance",
            Place.DISTURBANCE,
            searched,
            begin,
            lambda p, c, _g: {"gain": c[0], **({"lag_s": math.exp(p[0])} if len(p) else {})},
            form=f"{name} {way}".strip(),
            columns=columns,
            group=f"column {name}",
            measured=True,
        )
        for way, searched, begin, columns in ways
    )
