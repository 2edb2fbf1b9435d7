"""Losses that do not grow in proportion to the PV.

    w = G[v - (h(w) - w)],   h(w) = L ((1 + w/L)^p - 1)/p = w + b w^2 + ...,   L = (p - 1)/(2 b)

with `w` the response of the process of unit gain as deviation from rest, `v` its input, `L` the level, or temperature,
above where the loss ends, over the gain: p = 1/2 free outflow (Torricelli), 4 radiation (Stefan, Boltzmann), 2 what any
other loss is to second order (free convection, p = 1.25 to 1.33).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.catalogue.stepping import with_loss
from autotuner.core.diagnosis.effect import Effect, Place, Searched, View

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from autotuner.core.arrays import FloatArray
    from autotuner.core.diagnosis.case import Case

    Curve = Callable[[FloatArray], FloatArray]

FORMS = {"": 2.0, "outflow": 0.5, "radiation": 4.0}
EMPTY = 0.02
"""Least level, over that at rest."""
SMALLEST = 1e-9


def losses(case: Case) -> tuple[Effect, ...]:
    """Return the loss in each form."""
    return tuple(_loss(case, form, power) for form, power in FORMS.items())


def _loss(case: Case, form: str, power: float) -> Effect:
    swing = case.swing

    def response(view: View, p: Sequence[float]) -> FloatArray:
        b = p[0] / swing
        if abs(b) < SMALLEST / swing:
            return view.forced(view.input)
        return with_loss(view, *excess(b, power))

    return Effect(
        "nonlinear_loss",
        Place.PROCESS,
        (Searched("loss", -3.0, 3.0, 1e-4),),
        [(-0.5,), (-0.2,), (0.2,), (0.5,), (1.0,)],
        lambda p, _c, g: {"loss_per_pv": p[0] / (swing * g)},
        form=form,
        response=response,
        order=5,
    )


def excess(b: float, power: float) -> tuple[Curve, Curve]:
    """Return `w - h(w)`, which is added to the input, and its slope."""
    level = (power - 1.0) / (2.0 * b)

    def filled(w: FloatArray) -> FloatArray:
        result: FloatArray = np.maximum(1.0 + w / level, EMPTY)
        return result

    def added(w: FloatArray) -> FloatArray:
        result: FloatArray = w - level * (filled(w) ** power - 1.0) / power
        return result

    def slope(w: FloatArray) -> FloatArray:
        result: FloatArray = 1.0 - filled(w) ** (power - 1.0)
        return result

    return added, slope
