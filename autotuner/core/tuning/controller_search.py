"""The search for the times of a controller: a coarse grid in ultimate periods, then simplexes from its best points.

The gain is no variable: for given times the limits give it (`autotuner.core.tuning.search`). First `Ti` and `Td`
are searched without a limit of the noise, with the filter tied to `Td`; then, from there, the filter as well.

Rules of this file: variables are logarithms of times; nothing is random; the simpler controller wins a tie.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy

from autotuner.core.process import frequency_response
from autotuner.core.tuning.gains import PidGains
from autotuner.core.tuning.nyquist import frequency_grid
from autotuner.core.tuning.requirements import Controller, Requirements
from autotuner.core.tuning.search import NOT_POSSIBLE, Search

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.core.arrays import FloatArray

TI_STARTS = np.geomspace(0.03, 10.0, 8)
TD_STARTS = np.geomspace(0.01, 1.0, 6)
TF_STARTS = np.geomspace(0.003, 0.3, 4)
LONGEST, SHORTEST = 300.0, 0.001
"""Times of the controller in ultimate periods."""
SLOWER_STARTS = (1.0, 2.0, 4.0, 8.0)
FILTER_STARTS = (0.03, 0.1, 0.4, 1.5)
"""Where the search for a filter starts: the best times without it, stretched, `Tf` as a share of `Td` or `Ti/4`."""
DEAD_TIME_START = (0.26, 0.17, 0.13)
"""Where the best PID controller of a pure dead time lies, in ultimate periods."""
LARGEST_FILTER_RATIO = 100.0
"""`Td / Tf` (or `Ti / (4 Tf)`) with a noise limit."""
SIMPLEX_STARTS = 2
SIMPLEX_STEP, NEIGHBOUR_STEP = 0.4, 0.15
"""First edge of a simplex, in logarithms of times; smaller next to a known answer."""
WORTH_A_DERIVATIVE = 0.99
"""Derivative action is left out when it does not bring the error under this share of the PI controller's."""
CHECK_STEP_RAD = 0.03
"""Steps of the dead time's phase in the last check, where the peaks of a sensitivity are narrow."""
CHECK_RESERVE = 0.999
"""Share of `M - 1` that the last check uses, for what its frequencies miss between them."""


def best_controller(search: Search, Pu: float, start: PidGains | None = None) -> PidGains | None:
    """Return the best controller of the parts allowed, or None when none keeps the limits.

    Parameters
    ----------
    search : Search
        The problem.
    Pu : float
        Ultimate period, s: the scale of the times.
    start : PidGains, optional
        The answer to a similar problem; its parts are kept and only its neighbourhood is searched.
    """
    if search.requirements.controller is Controller.P:
        return _checked(search, PidGains(1.0))
    if start is not None:
        return _searched(search, _Axes(search.requirements, Pu, derivative=start.Td > 0.0), start)
    pi = _searched(search, _Axes(search.requirements, Pu, derivative=False))
    if search.requirements.controller is Controller.PI:
        return pi
    pid = _searched(search, _Axes(search.requirements, Pu, derivative=True))
    if pi is None or pid is None:
        return pid or pi
    return pid if search.error_of(pid) < WORTH_A_DERIVATIVE * search.error_of(pi) else pi


@dataclass(frozen=True, slots=True)
class _Axes:
    """The times that are searched, as logarithms: `Ti`, then `Td` (if any), then `Tf` (if searched)."""

    requirements: Requirements
    Pu: float
    derivative: bool

    @property
    def filter_matters(self) -> bool:
        """Whether the filter is searched as well, or follows from `Td`."""
        return self.requirements.noise is not None or (
            self.derivative and math.isfinite(self.requirements.filter_ratio)
        )

    def everywhere(self, *, with_filter: bool) -> FloatArray:
        """Return the coarse grid over the times, shape (n, number of times)."""
        axes = [TI_STARTS] + [TD_STARTS] * self.derivative + [TF_STARTS] * with_filter
        points = np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")], axis=1)
        return np.log(points * self.Pu)

    def with_filter(self, best: FloatArray) -> FloatArray:
        """Return starts with a filter, next to the best point without one and stretched in time, shape (n, 2 or 3)."""
        stretches = SLOWER_STARTS if self.requirements.noise else SLOWER_STARTS[:1]
        times = np.exp(best) * np.array(stretches)[:, None]
        reference = times[:, 1:] if self.derivative else times / 4.0
        starts = [np.hstack((times, share * reference)) for share in FILTER_STARTS]
        if self.derivative:
            starts.append(np.array([DEAD_TIME_START]) * self.Pu)
        logarithms: FloatArray = np.log(np.vstack(starts))
        return logarithms

    def at(self, gains: PidGains) -> FloatArray:
        """Return the one start at the times of a controller, shape (1, n)."""
        times = [gains.Ti] + [gains.Td] * self.derivative + [gains.Tf] * self.filter_matters
        start: FloatArray = np.log(np.array([times]))
        return start

    def shape(self, x: FloatArray) -> PidGains:
        """Return the controller with `Kp = 1` at the logarithms of its times."""
        times = [float(time) for time in np.exp(np.clip(x, math.log(SHORTEST * self.Pu), math.log(LONGEST * self.Pu)))]
        Ti = times[0]
        Td = min(times[1], self.requirements.derivative_ratio * Ti) if self.derivative else 0.0
        ratio = self.requirements.filter_ratio if self.requirements.noise is None else LARGEST_FILTER_RATIO
        shortest = Td / ratio if self.derivative or self.requirements.noise is None else Ti / 4.0 / ratio
        searched = times[-1] if x.size > 1 + self.derivative else 0.0
        return PidGains(1.0, Ti, Td, max(searched, shortest))


def _searched(search: Search, axes: _Axes, start: PidGains | None = None) -> PidGains | None:
    """Return the best PI or PID controller: first without limit on the noise, then with the filter as a third time."""
    best: FloatArray | None
    if start is not None:
        best = _minimum(search, axes, axes.at(start), NEIGHBOUR_STEP)
    else:
        best = _minimum(search.without_noise(), axes, axes.everywhere(with_filter=False))
        if best is not None and axes.filter_matters:
            best = _minimum(search, axes, axes.with_filter(best))
            best = _minimum(search, axes, axes.everywhere(with_filter=True)) if best is None else best
    return None if best is None else _checked(search, axes.shape(best))


def _minimum(search: Search, axes: _Axes, starts: FloatArray, step: float = SIMPLEX_STEP) -> FloatArray | None:
    """Return the logarithms of the best times: simplexes from the best of the starts."""

    def cost(x: FloatArray) -> float:
        return search.cost(axes.shape(x))

    costs = np.array([cost(x) for x in starts])
    if costs.min() >= NOT_POSSIBLE:
        return None
    found = [_simplex(cost, starts[i], step) for i in np.argsort(costs, kind="stable")[:SIMPLEX_STARTS]]
    return min(found, key=lambda pair: pair[0])[1]


def _simplex(cost: Callable[[FloatArray], float], start: FloatArray, step: float) -> tuple[float, FloatArray]:
    corners = np.vstack((start, start + step * np.eye(start.size)))
    result = scipy.optimize.minimize(
        cost, start, method="Nelder-Mead", options={"initial_simplex": corners, "xatol": 1e-3, "fatol": 1e-5}
    )
    return float(result.fun), result.x


def _checked(search: Search, shape: PidGains) -> PidGains | None:
    """Return the shape with its largest gain on a grid that is refined for this controller."""
    rough = search.gains_at(shape)
    if rough is None:
        return None
    w = frequency_grid(search.grid.model, rough, CHECK_STEP_RAD)
    fine = replace(search.grid, w=w, process=frequency_response(search.grid.model, w))
    last = Search(fine, search.models[1:], search.requirements, CHECK_RESERVE)
    gains = last.gains_at(shape) or rough
    return gains if last.stabilises_all(gains) else None
