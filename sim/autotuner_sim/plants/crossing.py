"""When a PV passes a level, and how far it goes: roots and ends of its monotone pieces, to the last digit but one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner_sim.plants.motion import Motion, State

_RELATIVE = 4.0 * np.finfo(np.float64).eps
"""Relative tolerance of a root: the smallest that `brentq` accepts."""
_ABSOLUTE = 1e-300
"""Absolute tolerance of a root: only underflow."""
_ITERATIONS = 2000
"""Enough to halve any bracket down to `_ABSOLUTE`, for a root next to 0."""


def find_root(function: Callable[[float], float], low: float, high: float) -> float:
    """Return the zero of `function` between two arguments at which it has opposite signs."""
    return float(scipy.optimize.brentq(function, low, high, xtol=_ABSOLUTE, rtol=_RELATIVE, maxiter=_ITERATIONS))


def first_crossing(
    motion: Motion,
    state: State,
    u: float,
    level: float,
    direction: int,
    span: float,
    *,
    at_start: float | None = None,
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
        Time span of the search, s.
    at_start : float, optional
        How far beyond the level the PV is at moment 0, where that is known better than by its rounded state.
    """

    def beyond(s: float) -> float:
        return direction * (motion.output(motion.move(state, u, s)) - level)

    if (beyond(0.0) if at_start is None else at_start) > 0.0:
        return 0.0
    low = 0.0
    for right in (*motion.turning_points(state, u, span), span):
        if beyond(right) > 0.0:
            return find_root(beyond, low, right) if beyond(low) < 0.0 else low
        low = right
    return None


def extremes(motion: Motion, state: State, u: float, span: float) -> tuple[float, float]:
    """Return the lowest and the highest PV over `span` seconds of input `u`."""
    moments = (0.0, *motion.turning_points(state, u, span), span)
    values = [motion.output(motion.move(state, u, s)) for s in moments]
    return min(values), max(values)
