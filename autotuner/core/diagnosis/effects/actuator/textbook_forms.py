"""Effects of the actuator other than friction and limits.

    rate_limit           |x'| <= rate,   or -falling rate <= x' <= rate
                         x' = (u - x)/lag, within -rate and rate: a positioner of limited speed
                         x' = rate tanh((u - x)/(rate lag)): the same without a corner
    output_quantisation  x = origin + step round((u - origin)/step)
    actuator_hold        x takes over u every `period` only
    static_nonlinearity  x = u + c2 u^2 (+ c3 u^3)
    direction_gain       x = u + (r - 1) max(u - u0, 0);   the corner rounded:  max(v, 0) -> (v + sqrt(v^2 + s^2) - s)/2

`u`, `x` output units as deviation from the first output. What enters linearly (c2, c3, r - 1) is a column.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effects.actuator.characteristics import characteristics
from autotuner.core.diagnosis.effects.actuator.levels import steps_alike
from autotuner.core.diagnosis.effects.actuator.saturation import map_levels, saturations, soft_limits
from autotuner.core.diagnosis.extended.effect import Effect, Place, Searched, View
from autotuner.core.model.zoh_input import HeldInput, numbered

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

    Columns = Callable[[View, Sequence[float]], list[FloatArray]]
    Starts = Sequence[tuple[float, ...]]
    Moved = Callable[[HeldInput, Sequence[float], Dataset], HeldInput]
    Part = Callable[[FloatArray, Sequence[float]], FloatArray]
    Ramp = tuple[float, float, float, float, int, float]
    """Begin, position there, duration and rise of the first step, number of steps, and the ratio of a rise to the one
    before."""

ORIGIN_LEFT = 0.25
"""Uncertainty of the origin of the steps, in steps; over the range of the output, the step size differs by as much."""
PHASE_LEFT = 0.3
"""Uncertainty of the phase of the updates, in update periods, that delays no further move; over the record, the
period may differ by as much."""
KINKS = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
"""Levels at which the gain may change, in swings above the lowest."""
TWICE = math.log(2.0)
PIECES = 12
"""Steps in which a ramp of the position is written between two samples or moves."""
WIDEST_BAND = 0.5
"""Way to the command, in swings, within which a positioner is not limited: with more, few moves are; it is a lag."""
ARRIVED, OF_A_LAG = 5.0, 24
"""Lags after which a position has arrived, with 0.7 % of the way left, and steps in which that is written."""
MOST_BANDS = 500.0
"""Ways to the command, over the band of a soft limit, from which they are alike: their sinh overflows at 710."""


def actuator_effects(
    dataset: Dataset, grids: Sequence[tuple[float, float]], steps: Mapping[str, Sequence[tuple[float, float]]]
) -> tuple[Effect, ...]:
    """Return the effects; `grids` are likely (period, phase) of updates, `steps` (step, origin) of known levels."""
    valves = characteristics(dataset)
    return (
        *saturations(dataset, valves),
        rate_limit(dataset),
        rate_limit(dataset, unequal=True),
        positioner(dataset),
        *(quantisation(dataset, form, of_form) for form, of_form in steps.items() if of_form),
        *((updated_every(dataset, grids),) if grids else ()),
        *_curves(dataset, valves),
        *_direction_gains(dataset, valves),
    )


def rate_limit(dataset: Dataset, *, unequal: bool = False) -> Effect:
    """Return an actuator that moves by a limited rate, or by one for each direction."""
    swing, span = dataset.swing, dataset.span_s
    slowest, fastest = math.log(0.5 / span), math.log(3.0 / dataset.data.interval_s)
    names = ("rate", "falling_rate") if unequal else ("rate",)
    alike = [(-math.log(share * span),) for share in (0.003, 0.007, 0.015, 0.03, 0.06, 0.12)]
    rates = [-math.log(share * span) for share in (0.003, 0.01, 0.03, 0.1)]
    apart = [(rate + up, rate + down) for rate in rates for up, down in ((TWICE, 0.0), (0.0, TWICE))]
    return Effect(
        "rate_limit",
        Place.ACTUATOR,
        tuple(Searched(f"log_{name}", slowest, fastest, 1e-4) for name in names),
        apart if unequal else alike,
        lambda p, _c, _g: {f"{name}_per_s": math.exp(x) * swing for name, x in zip(names, p, strict=True)},
        form="unequal" if unequal else "",
        position=lambda held, p, _: rate_limited(held, *(math.exp(x) * swing for x in p), finest_s=dataset.finest_s),
        order=2,
        price=2.0 if unequal else 0.0,
        group="timing",
    )


def rate_limited(held: HeldInput, rising: float, falling: float | None = None, *, finest_s: float = 0.0) -> HeldInput:
    """Return a position that moves by so much a second at most, its ramps written as small steps about their middle.

    Of a ramp within less than a sample, two steps of `finest_s` are enough: the PV is not read in between.
    """
    ramps: list[Ramp] = []
    x = 0.0
    for t, end, target in held.holds():
        way = target - x
        if way == 0.0:
            continue
        rate = rising if way > 0.0 or falling is None else falling
        lasts = abs(way) / rate  # nothing, for a way that is no more than rounding
        share = 1.0 if lasts <= end - t else (end - t) / lasts
        covered = share * lasts
        most = math.ceil(covered / finest_s) if finest_s else PIECES
        pieces = max(min(int(PIECES * min(1.0, share + 0.2)), most), 2)
        rise = way * share / pieces
        ramps.append((t, x, covered / pieces, rise, pieces, 1.0))
        x += rise * pieces
    return _in_steps(held.times[0], ramps)


def _in_steps(start_s: float, ramps: Sequence[Ramp]) -> HeldInput:
    """Return a position that is at 0 from its start, and moves by ramps, each in steps about their middle."""
    begins, positions, durations, rises, pieces, ratios = np.array(ramps).reshape(-1, 6).T
    counts = pieces.astype(int)
    step = numbered(counts)
    ratio = np.repeat(ratios, counts)
    straight = ratio == 1.0
    rises_so_far = np.where(straight, step + 1.0, (1.0 - ratio ** (step + 1)) / np.where(straight, 1.0, 1.0 - ratio))
    times = np.repeat(begins, counts) + (step + 0.5) * np.repeat(durations, counts)
    levels = np.repeat(positions, counts) + rises_so_far * np.repeat(rises, counts)
    return HeldInput(np.append(start_s, times), np.append(0.0, levels))


def positioner(dataset: Dataset) -> Effect:
    """Return an actuator that follows its command like a lag, by a limited rate."""
    swing, span, plain = dataset.swing, dataset.span_s, rate_limit(dataset)

    def moved(by: Callable[[HeldInput, float, float], HeldInput]) -> Moved:
        return lambda held, p, _: by(held, math.exp(p[0]) * swing, math.exp(p[1] - p[0]))

    hard = replace(
        plain,
        searched=(*plain.searched, Searched("log_band", math.log(0.02), math.log(WIDEST_BAND), 1e-3)),
        starts=[(-math.log(share * span), math.log(band)) for share in (0.003, 0.01, 0.03, 0.1) for band in (0.1, 0.4)],
        sizes=lambda p, c, g: {**plain.sizes(p[:1], c, g), "lag_s": math.exp(p[1] - p[0])},
        form="with a lag",
        position=moved(positioned),
        price=2.0,
    )
    return replace(hard, other_forms=(replace(hard, form="soft", position=moved(softly_positioned)),))


def positioned(held: HeldInput, rate: float, lag_s: float) -> HeldInput:
    """Return a position that approaches its command like a lag, by so much a second at most, in small steps."""
    ramps: list[Ramp] = []
    x, arrived_s = 0.0, ARRIVED * lag_s
    for t, end, target in held.holds():
        way = target - x
        ramp_s = min(max(abs(way) / rate - lag_s, 0.0), end - t)
        if ramp_s > 0.0:
            pieces = math.ceil(PIECES * ramp_s * rate / abs(way))
            rise = math.copysign(rate, way) * ramp_s / pieces
            ramps.append((t, x, ramp_s / pieces, rise, pieces, 1.0))
            x += rise * pieces
        left, rest_s = target - x, min(end - t - ramp_s, arrived_s)
        if left and rest_s > 0.0:
            pieces = math.ceil(OF_A_LAG * rest_s / arrived_s)
            lasts = rest_s / pieces
            ramps.append((t + ramp_s, x, lasts, -math.expm1(-lasts / lag_s) * left, pieces, math.exp(-lasts / lag_s)))
            x = target - left * math.exp(-rest_s / lag_s)
    return _in_steps(held.times[0], ramps)


def softly_positioned(held: HeldInput, rate: float, lag_s: float) -> HeldInput:
    """Return a position that approaches its command by a rate which falls with the way left, in small steps.

    `sinh(e/b) = sinh(e0/b) e^{-t/lag}` is the way left after a time `t`, with `b = rate lag`, of which `e0` were left.
    """
    ramps: list[Ramp] = []
    x, band = 0.0, rate * lag_s
    for t, end, target in held.holds():
        way = target - x
        lasts = min(end - t, abs(way) / rate + ARRIVED * lag_s)
        if way == 0.0 or lasts <= 0.0:
            continue
        pieces = min(math.ceil(OF_A_LAG * lasts / (ARRIVED * lag_s)), OF_A_LAG + PIECES)
        since = np.linspace(0.0, lasts, pieces + 1)
        bands = np.clip(way / band, -MOST_BANDS, MOST_BANDS)
        left = band * np.arcsinh(np.sinh(bands) * np.exp(-since / lag_s))
        at, rises = target - left, -np.diff(left)
        ramps += [
            (t + begin, here, lasts / pieces, rise, 1, 1.0)
            for begin, here, rise in zip(since[:-1].tolist(), at[:-1].tolist(), rises.tolist(), strict=True)
        ]
        x = float(at[-1])
    return _in_steps(held.times[0], ramps)


def quantisation(dataset: Dataset, form: str, steps: Sequence[tuple[float, float]]) -> Effect:
    """Return an actuator with discrete steps; `steps` are likely (step, swings; origin, steps)."""
    swing = dataset.swing

    def grid(held: HeldInput, p: Sequence[float], _: Dataset) -> HeldInput:
        step, origin = p[0] * swing, p[1] * p[0] * swing
        return map_levels(held, lambda u: origin + step * np.round((u - origin) / step))

    return Effect(
        "output_quantisation",
        Place.ACTUATOR,
        (Searched("step", 0.01, 0.8, 0.0, profiled=True), Searched("origin", -0.5, 0.5, 0.0)),
        list(steps),
        lambda p, _c, _g: {"step": p[0] * swing},
        form=form,
        position=grid,
        alike=lambda p, until_s: steps_alike(dataset, form, p[0], until_s),
        blur=lambda p: {"step": ORIGIN_LEFT * p[0] ** 2 * swing},
    )


def updated_every(dataset: Dataset, grids: Sequence[tuple[float, float]]) -> Effect:
    """Return an actuator that takes over its command on a grid; `grids` are likely (period, phase)."""
    interval = dataset.data.interval_s
    return Effect(
        "actuator_hold",
        Place.ACTUATOR,
        (
            Searched("log_period", math.log(1.2 * interval), math.log(dataset.span_s / 5.0), 1e-5),
            Searched("phase", -1.0, 2.0, 0.0),  # moves with the dead time: only tried
        ),
        [(math.log(period), phase) for period, phase in grids],
        lambda p, _c, _g: {"period_s": math.exp(p[0])},
        position=lambda held, p, _: taken_over(held, math.exp(p[0]), p[1]),
        group="timing",
        clocked=True,
        lateness_s=lambda p: math.exp(p[0]) / math.sqrt(12.0),
        blur=lambda p: {"period_s": PHASE_LEFT * math.exp(2.0 * p[0]) / dataset.span_s},
    )


def taken_over(held: HeldInput, period: float, phase: float) -> HeldInput:
    """Return an input whose changes take effect at the next update, at `period (k + phase)`."""
    # A change counts from its own instant; the grace keeps updates that coincide with a change together with it.
    later = period * (np.ceil((held.times - held.times[0]) / period - phase - 1e-6) + phase) + held.times[0]
    later = np.maximum(later, held.times)
    later[0] = held.times[0]
    last = np.append(np.diff(later) > 1e-9, np.array([True]))
    last[0] = True
    return HeldInput(later[last], np.where(np.arange(last.size) == 0, 0.0, held.levels)[last])


def _curves(dataset: Dataset, valves: tuple[Effect, ...]) -> tuple[Effect, ...]:
    swing = dataset.swing

    def columns(powers: Sequence[int]) -> Columns:
        rows = np.array(powers)[:, None]
        return lambda view, _p: list(view.forced(map_levels(view.position, lambda u: swing * (u / swing) ** rows)))

    def curve(form: str, powers: Sequence[int]) -> Effect:
        return Effect(
            "static_nonlinearity",
            Place.ACTUATOR,
            (),
            [()],
            lambda _p, c, g: {name: x / g for name, x in zip(("curvature", "third"), c, strict=False)},
            form=form,
            columns=columns(powers),
            order=4,
            group="curve",
        )

    # A power law has the fourth power next, a curve that bends alike on either side the fifth.
    forms = (("square", (2,), (3,), valves), ("cubic", (2, 3), (4, 5), (*valves, *soft_limits(dataset))))
    return tuple(
        replace(
            curve(form, powers),
            next_terms=tuple(curve(form, (*powers, power)) for power in following),
            other_forms=other_forms,
        )
        for form, powers, following, other_forms in forms
    )


def _direction_gains(dataset: Dataset, valves: tuple[Effect, ...]) -> tuple[Effect, ...]:
    """Return a gain that differs above the first output: at a corner, at a rounded one, and above another output."""
    swing, low = dataset.swing, float(dataset.data.held.levels.min())
    kink = dataset.output0 + low
    kinks: Starts = [(share,) for share in KINKS]
    ways: tuple[tuple[str, tuple[Searched, ...], Starts, float, Part], ...] = (
        ("", (), [()], 0.0, lambda u, _p: np.maximum(u, 0.0)),
        ("bend", (Searched("width", 0.005, 0.5, 1e-4),), [(0.05,), (0.2,)], 2.0, lambda u, p: _bent(u, p[0] * swing)),
        ("kink elsewhere", (Searched("kink", 0.05, 0.95, 1e-3),), kinks, math.log(len(KINKS)),
         lambda u, p: np.maximum(u - (low + p[0] * swing), 0.0)),
    )  # fmt: skip

    def columns(above: Part) -> Columns:
        return lambda view, p: [view.forced(map_levels(view.position, lambda u: above(u, p)))]

    def sizes(form: str, p: Sequence[float], c: Sequence[float], g: float) -> Mapping[str, float]:
        return {"ratio": 1.0 + c[0] / g, **({"kink": kink + p[0] * swing} if form == "kink elsewhere" else {})}

    return tuple(
        Effect(
            "direction_gain",
            Place.ACTUATOR,
            searched,
            starts,
            partial(sizes, form),
            form=form,
            columns=columns(above),
            order=4,
            price=price,
            group="curve",
            means=lambda _p, c, g, _shape: c[0] / g > -1.0,
            other_forms=valves if form == "bend" else (),
        )
        for form, searched, starts, price, above in ways
    )


def _bent(u: FloatArray, width: float) -> FloatArray:
    bent: FloatArray = 0.5 * (u + np.hypot(u, width) - width)
    return bent
