"""Dry friction on the process itself: an axis, a damper, a cylinder.

    T v' = u + b - c sgn(v) - a v    while it moves,     v = 0  while it rests and |u + b| <= c
    a = q^(sgn(v)/2)

`v` velocity over the gain, `u` force, `c` Coulomb friction (also the static level), `b` a constant force (weight, an
offset of the drive), all in output units; the viscous part is the lag's own, and `q` that of the way up over that of
the way down. Different Coulomb friction of the two ways is the same as a constant force while the axis moves. The PV
is `v`, or its integral where the process integrates. Between two changes of the force every part of the motion is an
exponential, and the time at which it stops has a closed form:

    v(t) = v_e + (v_0 - v_e) e^{-at/T},   a v_e = u + b - c sgn(v_0),   stops at  T/a ln((v_e - v_0)/v_e)

(Armstrong-Helouvry, Dupont and Canudas de Wit, Automatica 30, 1994; Karnopp, ASME J. Dyn. Syst. 107, 1985.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.effect import Effect, Place, Searched, View
from autotuner.core.model.step_responses import Lag, LaggedIntegrator

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from autotuner.core.diagnosis.record.dataset import Dataset
    from autotuner.core.model.arrays import FloatArray

STARTS = (0.05, 0.15, 0.35)
"""Coulomb friction to start from, in swings of the output."""
MOST_CONSTANT = 2.0
"""Largest constant force, in swings."""
NEGLIGIBLE = 1e-12
"""Velocity, in swings, that counts as rest."""
LARGEST_LOG_RATIO = 1.5
"""Bound of the logarithm of the ratio of viscous frictions: 4.5 to 1 is more than bearings and seals show."""
ALIKE, BY_DIRECTION = "Coulomb and viscous", "viscous by direction"
"""Names of the forms."""


def process_friction(dataset: Dataset, *, by_direction: bool = False) -> Effect:
    """Return the effect, for a process that is a lag or integrates one.

    Parameters
    ----------
    dataset : Dataset
        The recording. Of one that does not begin at rest, the first velocity is searched for, too.
    by_direction : bool
        Whether the viscous friction has a value of its own for each direction.
    """
    swing = dataset.swing
    # Inputs are deviations from the first output: a force that is not zero there is a constant.
    constants = {0.0, min(max(dataset.output0 / swing, -MOST_CONSTANT), MOST_CONSTANT)}
    searched = [Searched("coulomb", 0.0, 1.0, 1e-4), Searched("constant", -MOST_CONSTANT, MOST_CONSTANT, 1e-4)]
    if by_direction:
        searched.append(Searched("log_viscous_ratio", -LARGEST_LOG_RATIO, LARGEST_LOG_RATIO, 1e-4))
    if not dataset.settled_first:
        searched.append(Searched("velocity", -1.0, 1.0, 1e-4))
    names = [s.name for s in searched]

    def response(view: View, p: Sequence[float]) -> FloatArray:
        q = dict(zip(names, p, strict=True))
        axis = _Axis(q["coulomb"] * swing, q.get("log_viscous_ratio", 0.0), q.get("velocity", 0.0) * swing)
        return _moved(view, axis, q["constant"] * swing)

    def sizes(p: Sequence[float], _c: Sequence[float], _g: float) -> Mapping[str, float]:
        ratio = {"viscous_up_over_down": math.exp(p[2])} if by_direction else {}
        return {"coulomb": p[0] * swing, "constant": p[1] * swing, **ratio}

    return Effect(
        "process_friction",
        Place.PROCESS,
        tuple(searched),
        [(c, b, *(0.0 for _ in searched[2:])) for c in STARTS for b in sorted(constants)],
        sizes,
        form=BY_DIRECTION if by_direction else ALIKE,
        response=response,
        order=5,
        group="friction",
    )


@dataclass(frozen=True, slots=True)
class _Axis:
    """Friction, output units, the logarithm of its ratio of directions, and the first velocity over the gain."""

    coulomb: float
    log_ratio: float = 0.0
    velocity: float = 0.0

    def viscous(self, way: float) -> float:
        """Return the viscous friction of a direction over that of the geometric mean."""
        return math.exp(self.log_ratio / 2.0 * way)


def _moved(view: View, axis: _Axis, constant: float) -> FloatArray:
    """Return velocity, or position where the process integrates, at the view's times."""
    motion = view.motion
    if not isinstance(motion, Lag | LaggedIntegrator):
        return view.forced(view.input)
    held = view.input
    moves = held.times[1:] + view.delay_s
    grid = np.union1d(np.concatenate((moves[moves < view.t[-1]], [0.0])), view.t)
    force = held.levels[np.searchsorted(moves, grid, side="right")[:-1]] + constant
    velocity, position = _course(np.diff(grid).tolist(), force.tolist(), motion.T, axis)
    course = position if isinstance(motion, LaggedIntegrator) else velocity
    result: FloatArray = np.array(course)[np.searchsorted(grid, view.t)]
    return result


def _course(steps: list[float], force: list[float], T: float, axis: _Axis) -> tuple[list[float], list[float]]:
    """Return velocity and position at the ends of steps."""
    v, x = axis.velocity, 0.0
    velocities, positions = [v], [x]
    ways = (T, axis.coulomb, axis.viscous(1.0), axis.viscous(-1.0))
    for h, f in zip(steps, force, strict=True):
        v, x, left = _until_stop(v, x, h, f, ways)
        if left > 0.0:
            v, x, _ = _until_stop(0.0, x, left, f, ways)
        velocities.append(v)
        positions.append(x)
    return velocities, positions


def _until_stop(
    v: float, x: float, h: float, f: float, ways: tuple[float, float, float, float]
) -> tuple[float, float, float]:
    """Return velocity, position and the time left after a step, or after the part of it that ends at rest."""
    T, coulomb, up, down = ways
    if abs(v) < NEGLIGIBLE and abs(f) <= coulomb:
        return 0.0, x, 0.0
    way = math.copysign(1.0, v if abs(v) >= NEGLIGIBLE else f)
    viscous = up if way > 0.0 else down
    end, T, lasts = (f - coulomb * way) / viscous, T / viscous, h
    if v * way > 0.0 and end * way < 0.0:
        lasts = min(h, T * math.log((end - v) / end))
    fading = math.exp(-lasts / T)
    x += end * lasts + (v - end) * T * (1.0 - fading)
    v = end + (v - end) * fading
    stopped = lasts < h
    return (0.0 if stopped else v), x, h - lasts
