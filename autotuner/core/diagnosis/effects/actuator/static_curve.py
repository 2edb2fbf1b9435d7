"""Position of an actuator at each output, as a curve without a formula, where no textbook form fits.

    x = u + sum_j c_j s_j(u)        s_j cardinal natural splines, 1 at one knot and 0 at the others

The end knots have none: constant and slope are those of offset and gain. Where the output has few levels, these are
the knots, and the curve is a position for each level. Steps of unequal size are then identical, and no record
distinguishes the two: each is a form here. The reported sizes are those of the cubic through rest that is closest.
(Natural splines: de Boor, A Practical Guide to Splines, 2001.)
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy

from autotuner.core.diagnosis.effects.actuator.levels import SAME
from autotuner.core.diagnosis.extended.effect import Effect, Place
from autotuner.core.model.zoh_input import HeldInput

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from autotuner.core.diagnosis.extended.effect import View
    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

FEW, KNOTS = 7, 7
"""Levels up to which each is a knot, and knots where there are more."""
VISITS = 2
"""Moves for each knot that confirm its position."""
BACK = 0.03
"""Largest return of a position while the output continues, as a share of the range: measurement error."""
LATER = 0.1
"""Penalty that selects the smooth curve where steps of unequal size fit equally: the curve is simpler."""


def static_curves(dataset: Dataset) -> list[Effect]:
    """Return the curve, and steps of unequal size where levels are few; nothing where the output moves too rarely."""
    held = dataset.data.held
    early = held.times < dataset.fitted_until_s
    _, at = np.unique(np.round(held.levels[early] / (SAME * dataset.swing)), return_index=True)
    which = held.levels[early][at]
    few, most = which.size <= FEW, int(np.count_nonzero(early)) // VISITS
    knots = which if few else np.linspace(which[0], which[-1], min(KNOTS, most))
    if not 3 <= knots.size <= most:
        return []
    return [_curve(knots), *([_steps(knots)] if few else [])]


def _curve(knots: FloatArray) -> Effect:
    def sizes(_p: Sequence[float], c: Sequence[float], g: float) -> Mapping[str, float]:
        x = _positions(knots, c, g)
        powers = np.column_stack([knots**n for n in (1, 2, 3)])
        slope, square, third = np.linalg.lstsq(powers, x - np.interp(0.0, knots, x), rcond=None)[0].tolist()
        return {"curvature": square, "third": third, "slope_at_rest": slope}

    return Effect(
        "static_nonlinearity",
        Place.ACTUATOR,
        (),
        [()],
        sizes,
        form=f"free, {knots.size} knots",
        columns=_columns(knots),
        order=4,
        group="curve",
        means=lambda _p, c, g, _shape: _goes_one_way(knots, c, g) and _turns(knots, c, g) <= 1,
    )


def _steps(knots: FloatArray) -> Effect:
    """Return steps: the output is off by half a step at most."""
    return Effect(
        "output_quantisation",
        Place.ACTUATOR,
        (),
        [()],
        lambda _p, c, g: {"step": 2.0 * max(abs(x) for x in c) / abs(g)},
        form="unequal",
        columns=_columns(knots),
        order=4,
        price=LATER,
        group="curve",
        means=lambda _p, c, g, _shape: _goes_one_way(knots, c, g),
    )


class _columns:  # noqa: N801 - a function with the splines in it
    """The response to each of the splines."""

    def __init__(self, knots: FloatArray) -> None:
        self.knots = knots
        self.splines = scipy.interpolate.CubicSpline(knots, np.eye(knots.size)[:, 1:-1], bc_type="natural")

    def __call__(self, view: View, _p: Sequence[float]) -> list[FloatArray]:
        inside = np.clip(view.position.levels, *self.knots[[0, -1]])
        return [view.forced(HeldInput(view.position.times, x - x[0])) for x in self.splines(inside).T]


def _positions(knots: FloatArray, c: Sequence[float], gain: float) -> FloatArray:
    return knots + np.concatenate(([0.0], np.array(c) / gain, [0.0]))


def _goes_one_way(knots: FloatArray, c: Sequence[float], gain: float) -> bool:
    x = _positions(knots, c, gain)
    return bool(np.all(np.diff(x) > -BACK * (knots[-1] - knots[0])))


def _turns(knots: FloatArray, c: Sequence[float], gain: float) -> int:
    """Return how often a curve goes over from bending one way to bending the other."""
    bends = np.diff(np.diff(_positions(knots, c, gain)) / np.diff(knots))
    return int(np.count_nonzero(np.diff(np.sign(bends))))
