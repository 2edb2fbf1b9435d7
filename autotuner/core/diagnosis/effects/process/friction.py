"""Dry friction on the process itself: an axis, a damper, a cylinder.

    T v' = u + b - c sgn(v) - v      while it moves,     v = 0  while it rests and |u + b| <= c

`v` velocity over the gain, `u` force, `c` Coulomb friction (also the static level), `b` a constant force (weight, an
offset of the drive), all in output units; the viscous part is the lag's own. The PV is `v`, or its integral where the
process integrates. Between two changes of the force every part of the motion is an exponential, and the time at which
it stops has a closed form:

    v(t) = v_e + (v_0 - v_e) e^{-t/T},   v_e = u + b - c sgn(v_0),   stops at  T ln((v_e - v_0)/v_e)

(Armstrong-Helouvry, Dupont and Canudas de Wit, Automatica 30, 1994; Karnopp, ASME J. Dyn. Syst. 107, 1985.)
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.effect import Effect, Place, Searched, View
from autotuner.core.model.step_responses import Lag, LaggedIntegrator

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

STARTS = (0.05, 0.15, 0.35)
"""Coulomb friction to start from, in swings of the output."""
MOST_CONSTANT = 2.0
"""Largest constant force, in swings."""
NEGLIGIBLE = 1e-12
"""Velocity, in swings, that counts as rest."""


def process_friction(dataset: Dataset) -> Effect:
    """Return the effect, for a process that is a lag or integrates one."""
    swing = dataset.swing
    # Inputs are deviations from the first output: a force that is not zero there is a constant.
    constants = {0.0, min(max(dataset.output0 / swing, -MOST_CONSTANT), MOST_CONSTANT)}

    def response(view: View, p: Sequence[float]) -> FloatArray:
        return _moved(view, p[0] * swing, p[1] * swing)

    return Effect(
        "process_friction",
        Place.PROCESS,
        (Searched("coulomb", 0.0, 1.0, 1e-4), Searched("constant", -MOST_CONSTANT, MOST_CONSTANT, 1e-4)),
        [(c, b) for c in STARTS for b in sorted(constants)],
        lambda p, _c, _g: {"coulomb": p[0] * swing, "constant": p[1] * swing},
        form="Coulomb and viscous",
        response=response,
        order=5,
        group="friction",
    )


def _moved(view: View, coulomb: float, constant: float) -> FloatArray:
    """Return velocity, or position where the process integrates, at the view's times."""
    motion = view.motion
    if not isinstance(motion, Lag | LaggedIntegrator):
        return view.forced(view.input)
    held = view.input
    moves = held.times[1:] + view.delay_s
    grid = np.union1d(np.concatenate((moves[moves < view.t[-1]], [0.0])), view.t)
    force = held.levels[np.searchsorted(moves, grid, side="right")[:-1]] + constant
    velocity, position = _course(np.diff(grid).tolist(), force.tolist(), motion.T, coulomb)
    course = position if isinstance(motion, LaggedIntegrator) else velocity
    result: FloatArray = np.array(course)[np.searchsorted(grid, view.t)]
    return result


def _course(steps: list[float], force: list[float], T: float, coulomb: float) -> tuple[list[float], list[float]]:
    """Return velocity and position at the ends of steps, from rest."""
    v = x = 0.0
    velocities, positions = [v], [x]
    for h, f in zip(steps, force, strict=True):
        v, x, left = _until_stop(v, x, h, f, T, coulomb)
        if left > 0.0:
            v, x, _ = _until_stop(0.0, x, left, f, T, coulomb)
        velocities.append(v)
        positions.append(x)
    return velocities, positions


def _until_stop(v: float, x: float, h: float, f: float, T: float, coulomb: float) -> tuple[float, float, float]:
    """Return velocity, position and the time left after a step, or after the part of it that ends at rest."""
    if abs(v) < NEGLIGIBLE and abs(f) <= coulomb:
        return 0.0, x, 0.0
    way = math.copysign(1.0, v if abs(v) >= NEGLIGIBLE else f)
    end = f - coulomb * way
    lasts = h
    if v * way > 0.0 and end * way < 0.0:
        lasts = min(h, T * math.log((end - v) / end))
    fading = math.exp(-lasts / T)
    x += end * lasts + (v - end) * T * (1.0 - fading)
    v = end + (v - end) * fading
    stopped = lasts < h
    return (0.0 if stopped else v), x, h - lasts
