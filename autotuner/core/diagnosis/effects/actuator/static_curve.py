"""Position of an actuator at each output, as a curve without a formula, where no textbook form fits.

    x = u + sum_j c_j s_j(u)        s_j cardinal natural splines, 1 at one knot and 0 at the others

The end knots have none: constant and slope are those of offset and gain. Where the output has few levels, these are
the knots, and the curve is a position for each level. Steps of unequal size are then identical, and no record
distinguishes the two: each is a form here. An output of both signs (a motor, a Peltier element) may act alike in both
directions: an odd curve, x(-u) = -x(u), so that one direction shows the other. The reported sizes are those of the
cubic through rest that is closest. (Natural splines: de Boor, A Practical Guide to Splines, 2001.)
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import scipy

from autotuner.core.diagnosis.effects.actuator.characteristics import characteristics, closest_cubic
from autotuner.core.diagnosis.effects.actuator.levels import SAME
from autotuner.core.diagnosis.effects.actuator.saturation import map_levels, soft_limits
from autotuner.core.diagnosis.extended.effect import Effect, Place

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from autotuner.core.diagnosis.extended.effect import View
    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

FEW, KNOTS, HALF = 7, 7, 5
"""Levels up to which each is a knot, knots where there are more, and knots of half an odd curve."""
VISITS = 2
"""Moves for each knot that confirm its position."""
BACK = 0.03
"""Largest return of a position while the output continues, as a share of the range: measurement error."""
TURNS_OF_ODD = 3
"""Most turns of an odd curve: one at zero, and one in each half."""
STRAIGHT = 0.02
"""Share of the largest bend up to which a curve is straight: an odd one is so at zero, but for rounding."""
LATER = 0.1
"""Penalty that selects the smooth curve where steps of unequal size fit equally: the curve is simpler."""


def static_curves(dataset: Dataset) -> list[Effect]:
    """Return the curve, and steps of unequal size where levels are few; nothing where the output moves too rarely."""
    held = dataset.data.held
    early = held.times < dataset.fitted_until_s
    _, at = np.unique(np.round(held.levels[early] / (SAME * dataset.swing)), return_index=True)
    which = held.levels[early][at]
    odd = _odd_curve(which, -dataset.output0, int(np.count_nonzero(early)) // VISITS)
    few, most = which.size <= FEW, int(np.count_nonzero(early)) // VISITS
    knots = which if few else np.linspace(which[0], which[-1], min(KNOTS, most))
    if not 3 <= knots.size <= most:
        return odd
    basis = np.eye(knots.size)[:, 1:-1]
    free = replace(_curve(knots, basis, "free"), other_forms=(*characteristics(dataset), *soft_limits(dataset)))
    return [free, *([_steps(knots, basis)] if few else []), *odd]


def _odd_curve(levels: FloatArray, zero: float, most: int) -> list[Effect]:
    """Return the curve that is odd about an output of zero; nothing where the output has one sign, or moves rarely."""
    sizes = np.unique(np.abs(np.round(levels - zero, 9)))
    sizes = sizes[sizes > 0.0]
    half = sizes if sizes.size <= HALF else sizes[-1] * np.arange(1.0, HALF + 1.0) / HALF
    if not levels[0] < zero < levels[-1] or not 2 <= half.size <= most:
        return []
    knots = zero + np.concatenate((-half[::-1], [0.0], half))
    inner = np.eye(knots.size)[:, half.size + 1 : -1]
    return [_curve(knots, inner - inner[::-1], "free, odd", TURNS_OF_ODD)]


def _curve(knots: FloatArray, basis: FloatArray, form: str, turns: int = 1) -> Effect:
    def sizes(_p: Sequence[float], c: Sequence[float], g: float) -> Mapping[str, float]:
        return closest_cubic(knots, _positions(knots, basis, c, g))

    return Effect(
        "static_nonlinearity",
        Place.ACTUATOR,
        (),
        [()],
        sizes,
        form=f"{form}, {knots.size} knots",
        columns=_columns(knots, basis),
        order=4,
        group="curve",
        means=lambda _p, c, g, _shape: (
            _goes_one_way(knots, x := _positions(knots, basis, c, g)) and _turns(knots, x) <= turns
        ),
    )


def _steps(knots: FloatArray, basis: FloatArray) -> Effect:
    """Return steps: the output is off by half a step at most."""
    return Effect(
        "output_quantisation",
        Place.ACTUATOR,
        (),
        [()],
        lambda _p, c, g: {"step": 2.0 * max(abs(x) for x in c) / abs(g)},
        form="unequal",
        columns=_columns(knots, basis),
        order=4,
        price=LATER,
        group="curve",
        means=lambda _p, c, g, _shape: _goes_one_way(knots, _positions(knots, basis, c, g)),
    )


class _columns:  # noqa: N801 - a function with the splines in it
    """The response to each of the splines."""

    def __init__(self, knots: FloatArray, basis: FloatArray) -> None:
        self.knots = knots
        self.splines = scipy.interpolate.CubicSpline(knots, basis, bc_type="natural")

    def __call__(self, view: View, _p: Sequence[float]) -> list[FloatArray]:
        low, high = self.knots[[0, -1]]
        return list(view.forced(map_levels(view.position, lambda u: self.splines(np.clip(u, low, high)).T)))


def _positions(knots: FloatArray, basis: FloatArray, c: Sequence[float], gain: float) -> FloatArray:
    positions: FloatArray = knots + basis @ np.array(c) / gain
    return positions


def _goes_one_way(knots: FloatArray, x: FloatArray) -> bool:
    return bool(np.all(np.diff(x) > -BACK * (knots[-1] - knots[0])))


def _turns(knots: FloatArray, x: FloatArray) -> int:
    """Return how often a curve goes over from bending one way to bending the other."""
    bends = np.diff(np.diff(x) / np.diff(knots))
    clear = bends[np.abs(bends) > STRAIGHT * np.abs(bends).max()]
    return int(np.count_nonzero(np.diff(np.sign(clear))))
