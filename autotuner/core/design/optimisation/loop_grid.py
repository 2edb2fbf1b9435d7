"""The grids of one process on which a search evaluates its controllers.

Everything that does not depend on the controller is computed once: frequencies, process response with the exact dead
time, times, and the matrix from frequency to time.

    e(t) after a unit load step:       E = G / (s (1 + L))
    e(t) after a unit set-point step:  E = (1 - G (Kp b + Ki/s)/(1 + L)) / s

Both responses start one dead time after the step, so the dead time is omitted from the transform.

From a frequency response to the time response, as one matrix.

    y(t) = (2/pi) integral of Re Y(jw) cos(w t) dw over w from 0 to infinity

for a stable `Y` without poles on the axis. `Re Y` is taken as straight between the frequencies of the grid (constant
below the first), which makes the integral exact (Filon): with `F'' = cos(w t)`, each hat function contributes a second
divided difference of `F = (1 - cos(w t))/t^2 = 2 sin^2(w t/2)/t^2`. The matrix depends on the two grids alone, so a
search that evaluates hundreds of controllers pays for the cosines once.

`w` rad/s, `t` s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.design.gains import PidGains, controller_response
from autotuner.core.model.process import frequency_response, sum_of_lags

if TYPE_CHECKING:
    from autotuner.core.model.arrays import ComplexArray, FloatArray
    from autotuner.core.model.process import ProcessModel

FREQUENCIES_PER_DECADE = 80
"""Frequencies of the search grid per decade: the height of a peak of a damping ratio of 0.3 is exact to 0.1 %."""
TIMES_PER_DECADE = 50
"""Times of a step response per decade; the response is smooth in the logarithm of the time."""
SHORTEST_SHARE = 1e-4
"""The shortest dead time that counts, as a share of the lags: no PID loop is that fast."""
WEIGHTS = np.linspace(0.0, 1.0, 21)
ALLOWED_OVERSHOOT = 0.05
"""Share of the step, for choosing the set-point weight."""
NEXT_TO = 0.01
"""Overshoot above the smallest possible one, share of the step, that a larger set-point weight may cost."""
TURN_STEP_RAD, SMALLEST_TURN_RAD, LARGEST_TURN_RAD = 0.15, 40.0, 60.0
"""Even steps of the dead time's phase, followed until the lags have taken over."""


@dataclass(frozen=True, slots=True, eq=False)
class LoopGrid:
    """One process on its grids.

    Attributes
    ----------
    model : ProcessModel
        The process.
    w : array of float, shape (N,)
        Frequencies, rad/s.
    process : array of complex, shape (N,)
        `G(jw)` with dead time.
    undelayed : array of complex, shape (N,)
        `G(jw)` without dead time.
    t : array of float, shape (M,)
        Times after the first response, s.
    matrix : array of float, shape (M, N)
        From `Re Y(jw)` to `y(t)`.
    weights : array of float, shape (M,)
        Weights of the integral over `t`.
    """

    model: ProcessModel
    w: FloatArray
    process: ComplexArray
    undelayed: ComplexArray
    t: FloatArray
    matrix: FloatArray
    weights: FloatArray

    def controller(self, gains: PidGains) -> ComplexArray:
        """Return `C(jw) F(jw)` at the frequencies, shape (N,)."""
        return gains.Kp * _of_unit_gain(self, gains.Ti, gains.Td, gains.Tf, gains.N)

    def load_error(self, gains: PidGains) -> FloatArray:
        """Return the PV at `t` after a unit step of load at the process input, shape (M,)."""
        spectrum = self.undelayed / (1j * self.w * (1.0 + self.controller(gains) * self.process))
        error: FloatArray = self.matrix @ spectrum.real
        return error

    def set_point_error(self, gains: PidGains) -> tuple[FloatArray, FloatArray]:
        """Return `e0`, `p` (shape (M,) each): the error after a unit set-point step with weight `b` is `e0 - b p`."""
        s = 1j * self.w
        closed = self.undelayed / (1.0 + self.controller(gains) * self.process)
        spectra = np.stack(((1.0 - closed * gains.Ki / s) / s, closed * gains.Kp / s))
        e0, p = (self.matrix @ spectra.real.T).T
        return e0, p

    def overshoot(self, gains: PidGains) -> float:
        """Return the largest excess of the PV over a unit set-point step; 0 without overshoot."""
        e0, p = self.set_point_error(gains)
        return max(0.0, float(np.max(gains.b * p - e0)))

    def set_point_weight(self, gains: PidGains) -> float:
        """Return the largest weight `b` with a small overshoot, or close to the smallest of any weight."""
        e0, p = self.set_point_error(gains)
        excess = np.max(np.outer(p, WEIGHTS) - e0[:, None], axis=0)
        allowed = max(ALLOWED_OVERSHOOT, float(np.min(excess)) + NEXT_TO)
        return float(WEIGHTS[np.flatnonzero(excess <= allowed)[-1]])

    def integral_of(self, error: FloatArray) -> float:
        """Return the integral of `|error|` over `t`."""
        return float(self.weights @ np.abs(error))


@lru_cache(maxsize=2)
def _of_unit_gain(grid: LoopGrid, Ti: float, Td: float, Tf: float, N: float) -> ComplexArray:
    """Return the response of a controller; cached, because a search needs it for its gain, then for its errors."""
    return controller_response(PidGains(1.0, Ti, Td, Tf, N=N), grid.w)


def loop_grid(model: ProcessModel) -> LoopGrid:
    """Return the grids of a process with dead time."""
    shortest, longest = _time_scales(model)
    low, high = 1e-3 / longest, 1e3 / shortest
    w = np.geomspace(low, high, math.ceil(FREQUENCIES_PER_DECADE * math.log10(high / low)))
    to_the_lags = 3.0 * shortest / max(longest - model.D, shortest / LARGEST_TURN_RAD)
    even = np.arange(1, round(max(SMALLEST_TURN_RAD, to_the_lags) / TURN_STEP_RAD)) * TURN_STEP_RAD / shortest
    w = np.unique(np.concatenate((w, even)))
    first, last = 1e-2 * shortest, 1e2 * longest
    t = np.geomspace(first, last, math.ceil(TIMES_PER_DECADE * math.log10(last / first)))
    process = frequency_response(model, w)
    undelayed = process * np.exp(1j * w * model.D)
    return LoopGrid(model, w, process, undelayed, t, cosine_matrix(w, t), integral_weights(t))


def _time_scales(model: ProcessModel) -> tuple[float, float]:
    """Return the shortest and the longest time that the loop of a process can show, s."""
    lags = sum_of_lags(model)
    return max(model.D, SHORTEST_SHARE * lags), lags + model.D


def cosine_matrix(w: FloatArray, t: FloatArray) -> FloatArray:
    """Return the matrix that takes `Re Y(jw)` to `y(t)`.

    Parameters
    ----------
    w : array of float, shape (N,)
        Frequencies, rad/s, increasing, above 0.
    t : array of float, shape (M,)
        Times, s, above 0.

    Returns
    -------
    array of float, shape (M, N)
    """
    angle = np.outer(t, w)
    twice = 2.0 * np.sin(angle / 2.0) ** 2 / t[:, None] ** 2
    slope = np.diff(twice, axis=1) / np.diff(w)
    once = np.sin(angle[:, -1]) / t
    matrix = np.empty_like(angle)
    matrix[:, 0] = slope[:, 0]
    matrix[:, 1:-1] = slope[:, 1:] - slope[:, :-1]
    matrix[:, -1] = once - slope[:, -1]
    return matrix * (2.0 / math.pi)


def integral_weights(t: FloatArray) -> FloatArray:
    """Return the weights of the trapezoidal rule from 0 to the last time, for a function that is 0 at 0."""
    edges = np.concatenate(([0.0], t, t[-1:]))
    weights: FloatArray = (edges[2:] - edges[:-2]) / 2.0
    return weights
