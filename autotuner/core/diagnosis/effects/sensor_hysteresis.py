"""Hysteresis of the sensor: play between the PV and its reading, of a float, a pneumatic gauge, a worn linkage.

    z_k = min(max(z_(k-1), y_k - a), y_k + b),   a + b = w,   z_0 = y_0

`y` PV, `z` reading, `w` width of the play; `a` of it lies ahead of the first motion upwards. The reading stands still
after each reversal of the PV until that has moved by `w`. (Play operator: Krasnosel'skii and Pokrovskii, Systems with
Hysteresis, 1989.) Play of the actuator delays the motion of the process; this one only hides it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.effects.actuator.friction import backlash
from autotuner.core.diagnosis.extended.effect import Effect, Place, Searched
from autotuner.core.model.zoh_input import HeldInput

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.extended.effect import View
    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

NARROWEST, WIDEST = 0.005, 0.8
"""Width of the play over the PV that the swing of the output makes in the end: below, noise hides it."""
WIDTHS, AHEAD = (0.03, 0.08, 0.2, 0.4), (0.0, 0.5, 1.0)
"""Widths, and shares of them ahead of the first motion upwards, to begin from."""


def sensor_hysteresis(dataset: Dataset) -> Effect:
    """Return the effect; its width is searched for in PV over the gain of the process."""
    swing = dataset.swing

    def response(view: View, p: Sequence[float]) -> FloatArray:
        t = view.dataset.data.t  # the reading depends on all samples before
        pv = view.motion.forced(view.input, t - view.delay_s)[0][0]
        return reading_with_play(pv, p[0] * swing, p[1])[np.searchsorted(t, view.t)]

    return Effect(
        "sensor_hysteresis",
        Place.SENSOR,
        (Searched("width", NARROWEST, WIDEST, 1e-4), Searched("ahead", 0.0, 1.0, 1e-3)),
        [(width, ahead) for width in WIDTHS for ahead in AHEAD],
        lambda p, _c, g: {"width": p[0] * swing * abs(g)},
        response=response,
    )


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
    seen = backlash(HeldInput(np.arange(pv.size, dtype=np.float64), pv - start), width, ahead - 0.5)
    return seen.levels + start
