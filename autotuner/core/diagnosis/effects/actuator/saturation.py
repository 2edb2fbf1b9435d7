"""An actuator that ends before the output does.

    hard   x = min(max(u, low), high)
    soft   the corner rounded over a width s:  low + s ln(1 + e^{(u - low)/s}) and its mirror

`u`, `x` output units as deviation from the first output; limits are searched as shares of the swing from its ends.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.effect import Effect, Place, Searched
from autotuner.core.model.zoh_input import HeldInput

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

CORNER = 0.05
"""Width of a rounded corner at the start of the search, in swings."""
SHARES = (0.05, 0.12, 0.2, 0.3, 0.42)
LOW, HIGH = 0, 1
SIDES = ("low", "high")


def saturations(dataset: Dataset) -> tuple[Effect, ...]:
    """Return limits above, below, on both sides, and rounded ones."""
    return _one_sided(dataset, HIGH), _one_sided(dataset, LOW), _both_sided(dataset), _soft(dataset)


def map_levels(held: HeldInput, curve: Callable[[FloatArray], FloatArray]) -> HeldInput:
    """Return an input whose levels pass a static curve."""
    levels = curve(held.levels)
    return HeldInput(held.times, levels - levels[0])


def _ends(dataset: Dataset, low: float, high: float) -> tuple[float, float]:
    """Return the limits that lie by shares of the swing inside of the output's range."""
    levels = dataset.data.held.levels
    return float(levels.min()) + low * dataset.swing, float(levels.max()) - high * dataset.swing


def clipped(held: HeldInput, p: Sequence[float], dataset: Dataset) -> HeldInput:
    """Return an input between limits; `p` shares below and above."""
    low, high = _ends(dataset, p[0], p[1])
    return map_levels(held, lambda u: np.clip(u, low, max(high, low)))


def _one_sided(dataset: Dataset, side: int) -> Effect:
    def both(p: Sequence[float]) -> tuple[float, float]:
        return (p[0], 0.0) if side == LOW else (0.0, p[0])

    return Effect(
        "saturation",
        Place.ACTUATOR,
        (Searched(SIDES[side], 0.0, 0.9, 1e-4),),
        [(share,) for share in SHARES],
        lambda p, _c, _g: {SIDES[side]: dataset.output0 + _ends(dataset, *both(p))[side]},
        form=SIDES[side],
        position=lambda held, p, dataset: clipped(held, both(p), dataset),
        order=1,
        group="curve",
    )


def _sizes(dataset: Dataset) -> Callable[[Sequence[float], Sequence[float], float], Mapping[str, float]]:
    def sizes(p: Sequence[float], _c: Sequence[float], _g: float) -> Mapping[str, float]:
        return {name: dataset.output0 + end for name, end in zip(SIDES, _ends(dataset, p[0], p[1]), strict=True)}

    return sizes


TWO = (Searched("low", 0.0, 0.6, 1e-4), Searched("high", 0.0, 0.6, 1e-4))


def _both_sided(dataset: Dataset) -> Effect:
    return Effect(
        "saturation",
        Place.ACTUATOR,
        TWO,
        [(0.1, 0.1), (0.25, 0.25), (0.1, 0.3), (0.3, 0.1)],
        _sizes(dataset),
        form="both",
        position=clipped,
        order=1,
        group="curve",
    )


def _soft(dataset: Dataset) -> Effect:
    def position(held: HeldInput, p: Sequence[float], dataset: Dataset) -> HeldInput:
        low, high = _ends(dataset, p[0], p[1])
        return map_levels(held, lambda u: rounded(u, low, high, p[2] * dataset.swing))

    return Effect(
        "saturation",
        Place.ACTUATOR,
        (*TWO, Searched("width", 0.005, 0.5, 1e-4)),
        [(0.1, 0.1, CORNER), (0.2, 0.2, 2 * CORNER), (0.0, 0.2, CORNER), (0.2, 0.0, CORNER)],
        _sizes(dataset),
        form="soft",
        position=position,
        order=1,
        group="curve",
    )


def rounded(u: FloatArray, low: float, high: float, width: float) -> FloatArray:
    """Return a limiter whose corners are rounded over `width`."""
    up = low + width * np.logaddexp(0.0, (u - low) / width)
    result: FloatArray = high - width * np.logaddexp(0.0, (high - up) / width)
    return result
