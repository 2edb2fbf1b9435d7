"""An actuator that ends before the output does.

    hard   x = min(max(u, low), high)
    soft   the corner rounded over a width s:  low + s ln(1 + e^{(u - low)/s}) and its mirror
    smooth x = m + s tanh((u - m)/s),  m = (low + high)/2,  s = (high - low)/2

`u`, `x` output units as deviation from the first output; limits are searched as shares of the swing from its ends.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.effect import Effect, Place, Searched
from autotuner.core.model.arrays import SMALLEST_DIVISOR
from autotuner.core.model.zoh_input import HeldInput

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

CORNER = 0.05
"""Width of a rounded corner at the start of the search, in swings."""
SHARES = (0.05, 0.12, 0.2, 0.3, 0.42, 0.58, 0.75)
"""Limits to begin from, in swings; in a loop most of the output's range may lie beyond one."""
SIDES = ("low", "high")
FARTHEST = -2.0
"""How far beyond the output a smooth limit may lie, in swings: there the other one alone bends a curve."""
WIDTH = Searched("width", 0.005, 0.5, 1e-4)
"""Width of a rounded corner, in swings."""


def saturations(dataset: Dataset, other_forms: tuple[Effect, ...] = ()) -> tuple[Effect, ...]:
    """Return limits above, below, on both sides, and rounded ones on both sides; `other_forms` are of the last.

    Smooth ones are tried in place of those on both sides.
    """
    one, two = [(share,) for share in SHARES], [(0.1, 0.1), (0.25, 0.25), (0.1, 0.3), (0.3, 0.1)]
    rounded_off = [(0.1, 0.1, CORNER), (0.2, 0.2, 2 * CORNER), (0.0, 0.2, CORNER), (0.2, 0.0, CORNER)]
    both = _limits(dataset, "both", _of(SIDES, 0.6), two)
    soft = _limits(dataset, "soft", (*_of(SIDES, 0.6), WIDTH), rounded_off, rounded)
    return (
        _limits(dataset, "high", _of(("high",), 0.9), one),
        _limits(dataset, "low", _of(("low",), 0.9), one),
        replace(both, other_forms=(smooth_limits(dataset),)),
        replace(soft, other_forms=other_forms),
    )


def soft_limits(dataset: Dataset) -> list[Effect]:
    """Return one rounded limit, above or below: curves that are searched where no hard limit explains the record."""
    starts = [(share, 2 * CORNER) for share in SHARES]
    return [_limits(dataset, f"{side}, soft", (*_of((side,), 0.9), WIDTH), starts, rounded) for side in SIDES]


def smooth_limits(dataset: Dataset) -> Effect:
    """Return limits that are approached all the way, like those of an amplifier: they may lie beyond the output."""
    inside = tuple(Searched(side, FARTHEST, 0.6, 1e-4) for side in SIDES)
    return _limits(dataset, "smooth", inside, [(0.1, 0.1), (-0.2, -0.2), (0.1, -0.3), (-0.3, 0.1)], approached)


def _of(sides: Sequence[str], most: float) -> tuple[Searched, ...]:
    """Return limits that lie by shares of the swing inside of the output's range."""
    return tuple(Searched(side, 0.0, most, 1e-4) for side in sides)


def map_levels(held: HeldInput, curve: Callable[[FloatArray], FloatArray]) -> HeldInput:
    """Return an input whose levels pass a static curve, or several of them."""
    levels = curve(held.levels)
    return HeldInput(held.times, levels - levels[..., :1])


def hard(u: FloatArray, low: float, high: float) -> FloatArray:
    """Return a limiter; infinite where it has no limit on a side."""
    return np.clip(u, low, max(high, low))


def _limits(
    dataset: Dataset,
    form: str,
    searched: tuple[Searched, ...],
    starts: Sequence[tuple[float, ...]],
    limiter: Callable[..., FloatArray] = hard,
) -> Effect:
    """Return limits that stay where they are in another part of the record, whatever the output does there."""
    swing, levels = dataset.swing, dataset.data.held.levels
    lowest, highest = float(levels.min()), float(levels.max())
    sides = [one.name for one in searched if one.name in SIDES]

    def ends(p: Sequence[float]) -> dict[str, float]:
        known = dict(zip(sides, p, strict=False))
        within = {"low": lowest + known.get("low", 0.0) * swing, "high": highest - known.get("high", 0.0) * swing}
        return {side: end for side, end in within.items() if side in sides}

    def position(held: HeldInput, p: Sequence[float], _: Dataset) -> HeldInput:
        limits = ends(p)
        low, high = limits.get("low", -math.inf), limits.get("high", math.inf)
        return map_levels(held, lambda u: limiter(u, low, high, *(width * swing for width in p[len(sides) :])))

    def sizes(p: Sequence[float], _c: Sequence[float], _g: float) -> Mapping[str, float]:
        return {side: dataset.output0 + end for side, end in ends(p).items()}

    return Effect(
        "saturation",
        Place.ACTUATOR,
        searched,
        starts,
        sizes,
        form=form,
        position=position,
        order=1,
        group="curve",
    )


def rounded(u: FloatArray, low: float, high: float, width: float) -> FloatArray:
    """Return a limiter whose corners are rounded over `width`; infinite where it has no limit on a side."""
    up = low + width * np.logaddexp(0.0, (u - low) / width) if math.isfinite(low) else u
    result: FloatArray = high - width * np.logaddexp(0.0, (high - up) / width) if math.isfinite(high) else up
    return result


def approached(u: FloatArray, low: float, high: float) -> FloatArray:
    """Return a limiter without corners, of slope 1 in the middle."""
    middle, half = (low + high) / 2.0, max(high - low, SMALLEST_DIVISOR) / 2.0
    result: FloatArray = middle + half * np.tanh((u - middle) / half)
    return result
