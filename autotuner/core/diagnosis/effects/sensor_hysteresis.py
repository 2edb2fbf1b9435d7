"""Hysteresis of the sensor: play between the PV and its reading, of a float, a pneumatic gauge, a worn linkage.

    z_k = min(max(z_(k-1), y_k - a), y_k + b),   a + b = w,   z_0 = y_0
    creeping    z_(k-1) -> y_k + (z_(k-1) - y_k) e^(-h/T) first,   a = b

`y` PV, `z` reading, `w` width of the play; `a` of it lies ahead of the first motion upwards; `h` time between samples,
`T` time constant of the creep. The reading stands still after each reversal of the PV until that has moved by `w`, or
creeps towards it. (Play operator: Krasnosel'skii and Pokrovskii, Systems with Hysteresis, 1989.) Play of the actuator
delays the motion of the process; this one only hides it.
"""

from __future__ import annotations

import math
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effects.actuator.friction import played
from autotuner.core.diagnosis.extended.effect import Effect, Place, Searched

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from autotuner.core.diagnosis.extended.effect import View
    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

    Read = Callable[[FloatArray, FloatArray, float, float], FloatArray]

NARROWEST, WIDEST = 0.005, 0.8
"""Width of the play over the PV that the swing of the output makes in the end: below, noise hides it."""
WIDTHS, AHEAD = (0.03, 0.08, 0.2, 0.4), (0.0, 0.5, 1.0)
"""Widths, and shares of them ahead of the first motion upwards, to begin from."""
QUICKEST, SLOWEST, CREEPS = 0.002, 0.5, (0.02, 0.1)
"""Time constant of a creep, in records: quicker, nothing rests; slower, nothing creeps; and two to begin from."""
SLOWER = 1.5
"""Least time constant of a creep, over the longest of the process: quicker, it is a further lag of the row, whose play
has no end."""


def sensor_hysteresis(dataset: Dataset) -> tuple[Effect, Effect]:
    """Return the effect without and with creep; its width is searched for in PV over the gain of the process."""
    swing, span = dataset.swing, dataset.span_s

    def of(form: str, second: Searched, starts: Sequence[tuple[float, ...]], read: Read) -> Effect:
        def response(view: View, p: Sequence[float]) -> FloatArray:
            t = view.dataset.data.t  # the reading depends on all samples before
            pv = view.motion.forced(view.input, t - view.delay_s)[0][0]
            return read(t, pv, p[0] * swing, p[1])[np.searchsorted(t, view.t)]

        return Effect(
            "sensor_hysteresis",
            Place.SENSOR,
            (Searched("width", NARROWEST, WIDEST, 1e-4), second),
            starts,
            lambda p, _c, g: {"width": p[0] * swing * abs(g), **({"creep_s": math.exp(p[1])} if form else {})},
            form=form,
            response=response,
            takes_third=True,
            means=lambda p, _c, _g, shape: not form or math.exp(p[1]) > SLOWER * max(shape, default=0.0),
        )

    creep = Searched("log_creep", math.log(QUICKEST * span), math.log(SLOWEST * span), 1e-4)
    creeping = [(width, math.log(share * span)) for width in WIDTHS[1:] for share in CREEPS]
    return (
        of("", Searched("ahead", 0.0, 1.0, 1e-3), list(product(WIDTHS, AHEAD)), _at_rest),
        of("creeping", creep, creeping, lambda t, pv, width, log_s: reading_that_creeps(t, pv, width, math.exp(log_s))),
    )


def _at_rest(_t: FloatArray, pv: FloatArray, width: float, ahead: float) -> FloatArray:
    return reading_with_play(pv, width, ahead)


def reading_with_play(pv: FloatArray, width: float, ahead: float) -> FloatArray:
    """Return the reading of a PV.

    Parameters
    ----------
    pv : array of float, shape (N,)
        The PV.
    width : float
        Width of the play, PV.
    ahead : float
        Share of it that lies ahead of the first motion upwards.
    """
    start = float(pv[0])
    seat = (ahead - 0.5) * width
    result: FloatArray = played(pv - start, width, seat) - seat + start
    return result


def reading_that_creeps(t: FloatArray, pv: FloatArray, width: float, creep_s: float) -> FloatArray:
    """Return the reading of a PV that creeps towards it within a play.

    Parameters
    ----------
    t, pv : array of float, shape (N,)
        Times, s, and the PV.
    width : float
        Width of the play, PV.
    creep_s : float
        Time constant of the creep, s.
    """
    start = float(pv[0])
    result: FloatArray = played(pv - start, width, 0.0, np.exp(-np.diff(t, prepend=t[0]) / creep_s)) + start
    return result
