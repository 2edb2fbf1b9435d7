"""When a PV passes a level: the root of a monotone piece, to the last digit but one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import brentq

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner_sim.motion import Motion, State

_ROOT_TOLERANCE = 4.0 * np.finfo(np.float64).eps


def find_root(function: Callable[[float], float], low: float, high: float) -> float:
    """Return the zero of `function` between two arguments at which it has opposite signs."""
    return float(brentq(function, low, high, xtol=1e-300, rtol=_ROOT_TOLERANCE))


def first_crossing(
    motion: Motion,
    state: State,
    u: float,
    level: float,
    direction: int,
    span: float,
    *,
    at_threshold: bool = False,
) -> float | None:
    """Return the first moment in [0, span) from which the PV is beyond `level`, s, or None.

    Parameters
    ----------
    motion : Motion
        The plant.
    state : tuple of float
        Its state at moment 0.
    u : float
        Its constant input.
    level : float
        The PV to pass.
    direction : int
        1 when beyond means above, -1 when it means below.
    span : float
        How far to look, s.
    at_threshold : bool
        The PV is exactly at the level at moment 0.
    """

    def beyond(s: float) -> float:
        return direction * (motion.output(motion.move(state, u, s)) - level)

    left, at_left = 0.0, 0.0 if at_threshold else beyond(0.0)
    if at_left > 0.0:
        return 0.0
    for right in (*motion.turning_points(state, u, span), span):
        at_right = beyond(right)
        if at_right > 0.0:
            return left if at_left == 0.0 else find_root(beyond, left, right)
        left, at_left = right, at_right
    return None
