"""Inherent characteristics of valves and dampers: static curves by one or two numbers.

    power              x = (a/n) ((1 + u/a)^n - 1)        `a` the first output, from zero of the scale
    equal percentage   x = (e^{k u} - 1)/k                k < 0: quick opening
    S-shaped           x = (1 + (m/s)^2) s (atan((u - m)/s) + atan(m/s))        about `m`, over a width `s`

`u` the output as deviation from the first one, `x` the position; each has slope 1 at rest. (Smith and Corripio,
Principles and Practice of Automatic Process Control, 1997, chapter 5: linear, equal percentage and quick opening.) The
sizes of each are those of the cubic through rest that is closest over the range of the output.
"""

from __future__ import annotations

import math
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effects.actuator.saturation import map_levels, smooth_limits
from autotuner.core.diagnosis.extended.effect import Effect, Place, Searched

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

    Curve = Callable[[FloatArray, Sequence[float]], FloatArray]

MIDDLES, SPREADS = (0.3, 0.5, 0.7), (0.3, 0.8)
"""Middle of an S-shaped curve above the lowest output, and its width, to begin from, in swings."""
POWERS, RANGES = ((0.6,), (1.8,)), ((-1.0,), (1.0,))
"""Powers, and changes of `ln` of the gain over the swing, to begin from."""
STRAIGHT = 1e-9
"""Change of `ln` of the gain over the swing under which a curve is straight to the rounding of a double."""
MANY = 101
"""Outputs at which a curve is compared with a cubic."""
ROUNDING = 1e-9
"""Share of the slope up to which a bend over the range is rounding: an odd curve about zero has none."""


def characteristics(dataset: Dataset) -> tuple[Effect, ...]:
    """Return the curves, and limits without a corner; a power of the output only where that stays above zero."""
    swing, rest = dataset.swing, dataset.output0
    low = float(dataset.data.held.levels.min())

    def power(u: FloatArray, p: Sequence[float]) -> FloatArray:
        position: FloatArray = rest / p[0] * (np.maximum(1.0 + u / rest, 0.0) ** p[0] - 1.0)
        return position

    def equal_percentage(u: FloatArray, p: Sequence[float]) -> FloatArray:
        return u if abs(p[0]) < STRAIGHT else np.expm1(p[0] / swing * u) * swing / p[0]

    def s_shaped(u: FloatArray, p: Sequence[float]) -> FloatArray:
        middle, width = low + p[0] * swing, p[1] * swing
        slope = 1.0 + (middle / width) ** 2
        position: FloatArray = slope * width * (np.arctan((u - middle) / width) + math.atan(middle / width))
        return position

    about = (Searched("middle", -0.5, 1.5, 1e-4), Searched("spread", 0.1, 5.0, 1e-4))
    above_zero = rest > 0.0 and rest + low > 0.0
    return (
        *([_curve(dataset, "power", (Searched("n", 0.2, 5.0, 1e-4),), power, POWERS)] if above_zero else []),
        _curve(dataset, "equal percentage", (Searched("range", -5.0, 5.0, 1e-4),), equal_percentage, RANGES),
        _curve(dataset, "S-shaped", about, s_shaped, list(product(MIDDLES, SPREADS))),
        smooth_limits(dataset),
    )


def _curve(
    dataset: Dataset, form: str, searched: tuple[Searched, ...], curve: Curve, starts: Sequence[tuple[float, ...]]
) -> Effect:
    levels = dataset.data.held.levels
    across = np.linspace(float(levels.min()), float(levels.max()), MANY)
    return Effect(
        "static_nonlinearity",
        Place.ACTUATOR,
        searched,
        starts,
        lambda p, _c, _g: closest_cubic(across, curve(across, p)),
        form=form,
        position=lambda held, p, _: map_levels(held, lambda u: curve(u, p)),
        order=4,
        group="curve",
    )


def closest_cubic(u: FloatArray, x: FloatArray) -> dict[str, float]:
    """Return the sizes of the cubic through rest that is closest to the positions at some outputs."""
    powers = np.column_stack([u**n for n in (1, 2, 3)])
    slope, square, third = np.linalg.lstsq(powers, x - np.interp(0.0, u, x), rcond=None)[0].tolist()
    rounding = ROUNDING * abs(slope) / float(np.abs(u).max())
    return {"curvature": square if abs(square) > rounding else 0.0, "third": third, "slope_at_rest": slope}
