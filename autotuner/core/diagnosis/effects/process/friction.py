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
    begins = np.append(0.0, moves[(moves > 0.0) & (moves < view.t[-1])])
    force = held.levels[np.searchsorted(moves, begins, side="right")] + constant
    velocity, position = _course(begins, force, motion.T, axis, view.t)
    return position if isinstance(motion, LaggedIntegrator) else velocity


def _course(
    begins: FloatArray, force: FloatArray, T: float, axis: _Axis, t: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return velocity and position at some times, by the forces and the times from which on each of them acts."""
    pieces = []
    v, x, c = axis.velocity, 0.0, axis.coulomb
    viscous = {way: axis.viscous(way) for way in (1.0, -1.0)}
    lengths = np.diff(begins, append=max(t[-1], begins[-1]))
    for start, left, f in zip(begins.tolist(), lengths.tolist(), force.tolist(), strict=True):
        now, ends = start, start + left
        while now < ends:
            v, towards, lag, lasts = _until_stop(v, f, c, T, viscous)
            pieces.append((now, v, x, towards, lag))
            lasts = min(lasts, ends - now)
            fading = math.exp(-lasts / lag)
            stops = now + lasts < ends
            x += towards * lasts + (v - towards) * lag * (1.0 - fading)
            v = 0.0 if stops else towards + (v - towards) * fading
            now += lasts
    at, first, x0, towards, lag = np.array(pieces or [(0.0, v, x, 0.0, T)]).T
    which = np.maximum(np.searchsorted(at, t, side="right") - 1, 0)
    since, off = t - at[which], (first - towards)[which]
    fading = np.exp(-since / lag[which])
    return (
        towards[which] + off * fading,
        x0[which] + towards[which] * since + off * lag[which] * (1.0 - fading),
    )


def _until_stop(
    v: float, f: float, c: float, T: float, viscous: Mapping[float, float]
) -> tuple[float, float, float, float]:
    """Return under a force the velocity, the one that it tends to and in which time, and after which time it stops."""
    if abs(v) < NEGLIGIBLE and abs(f) <= c:
        return 0.0, 0.0, T, math.inf
    way = math.copysign(1.0, v if abs(v) >= NEGLIGIBLE else f)
    towards, lag = (f - c * way) / viscous[way], T / viscous[way]
    stops = v * way > 0.0 and towards * way < 0.0
    return v, towards, lag, lag * math.log((towards - v) / towards) if stops else math.inf
