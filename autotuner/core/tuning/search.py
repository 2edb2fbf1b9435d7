"""What a controller of given times can do on a process: its largest gain inside all limits, and the error that is left.

    variance of the output per variance of white noise = h/pi integral of |R(jw)|^2 dw from 0 to pi/h

Rules of this file: the gain is never searched where a closed form gives it; a controller that cannot keep the limits is
None, not a bad number.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import scipy

from autotuner.core.process import frequency_response
from autotuner.core.tuning.gain_limits import largest_gain
from autotuner.core.tuning.gains import PidGains, controller_response
from autotuner.core.tuning.nyquist import encircles_nothing, path_ends
from autotuner.core.tuning.requirements import Purpose, Requirements

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.arrays import ComplexArray, FloatArray
    from autotuner.core.process import ProcessModel
    from autotuner.core.tuning.loop_grid import LoopGrid
    from autotuner.core.tuning.requirements import Noise

NOT_POSSIBLE = 50.0
"""Logarithm of the error of a controller that cannot keep the limits."""
UNRESOLVED = 0.1
"""Error right after a set-point step that is this far from 1 lies outside the grids: the loop is too slow."""


class Search:
    """One design problem: the process, further processes that the controller must suit, and the requirements."""

    def __init__(
        self, grid: LoopGrid, others: Sequence[ProcessModel], requirements: Requirements, reserve: float
    ) -> None:
        self.grid = grid
        self.reserve = reserve
        self.Ms, self.Mt = (1.0 + (M - 1.0) * reserve for M in (requirements.Ms, requirements.Mt))
        self.models = (grid.model, *others)
        self.responses = np.stack([grid.process, *(frequency_response(m, grid.w) for m in others)])
        self.requirements = requirements
        self.sign = math.copysign(1.0, grid.model.K)
        noise = requirements.noise
        self.noise_weights = noise_weights(grid.w, noise.sample_time_s) if noise else np.zeros_like(grid.w)

    def without_noise(self) -> Search:
        """Return the same problem without the noise limit."""
        return Search(self.grid, self.models[1:], replace(self.requirements, noise=None), self.reserve)

    def gains_at(self, shape: PidGains) -> PidGains | None:
        """Return `shape` (made for `Kp = 1`) with the largest gain inside all limits, or None."""
        unit = self.sign * controller_response(shape, self.grid.w)

        def stable(k: float) -> bool:
            ends = path_ends(self.grid.model, replace(shape, Kp=self.sign * k))
            return encircles_nothing(ends, k * unit * self.grid.process)

        k = largest_gain(unit * self.responses, self.Ms, self.Mt, stable)
        if k is not None and self.requirements.noise is not None:
            k = self._quiet_gain(k, unit)
        return None if k is None else replace(shape, Kp=self.sign * k)

    def stabilises_all(self, gains: PidGains) -> bool:
        """Return whether the loop is stable for every process; those beside the first are not looked at in a search."""
        controller = controller_response(gains, self.grid.w)
        return all(
            encircles_nothing(path_ends(model, gains), controller * response)
            for model, response in zip(self.models, self.responses, strict=True)
        )

    def cost(self, shape: PidGains) -> float:
        """Return the logarithm of the integrated error of the best controller of that shape."""
        gains = self.gains_at(shape)
        error = math.inf if gains is None else self.error_of(gains)
        return math.log(error) if math.isfinite(error) else NOT_POSSIBLE

    def error_of(self, gains: PidGains) -> float:
        """Return the integrated error that the requirements ask to be small; never under its closed-form bound."""
        if self.requirements.purpose is Purpose.LOAD:
            return self.load_iae(gains)
        e0, p = self.grid.set_point_error(gains)
        if abs(e0[0] - p[0] - 1.0) > UNRESOLVED:
            return math.inf
        return self.grid.model.D + self.grid.integral_of(e0 - p)

    def load_iae(self, gains: PidGains) -> float:
        """Return the integral of the absolute error after a unit load step; at least `Ti/|Kp|`, the integral error."""
        if gains.Ki == 0.0:
            return math.inf
        return max(self.grid.integral_of(self.grid.load_error(gains)), 1.0 / abs(gains.Ki))

    def _quiet_gain(self, k: float, unit: ComplexArray) -> float | None:
        """Return the largest gain up to `k` whose jitter is allowed and that keeps the limits, or None."""
        noise = self.requirements.noise
        assert noise is not None  # noqa: S101 - only asked with a noise limit
        allowed = (noise.jitter / noise.sigma) ** 2

        def excess(gain: float) -> float:
            through = gain * unit / (1.0 + gain * unit * self.grid.process)
            return float(self.noise_weights @ np.abs(through) ** 2) / allowed - 1.0

        if allowed == 0.0 or not excess(0.0) < 0.0:  # smaller than a number can be: no gain at all is as quiet
            return None
        if excess(k) <= 0.0:
            return k
        quiet = float(scipy.optimize.brentq(excess, 0.0, k, xtol=1e-5 * k, rtol=1e-4))
        return quiet if quiet > 0.0 and self._keeps(quiet, unit) else None

    def _keeps(self, k: float, unit: ComplexArray) -> bool:
        loop = k * unit * self.responses
        distance = np.abs(1.0 + loop)
        return bool(np.all(distance * self.Ms >= 1.0) and np.all(np.abs(loop) <= self.Mt * distance))


def noise_weights(w: FloatArray, sample_time_s: float) -> FloatArray:
    """Return weights `c` so that `c @ |R|^2` is the variance of the output per variance of white noise.

    `h/pi` times the integral of `|R|^2` from 0 to the Nyquist frequency `pi/h`.
    """
    h = sample_time_s
    edges = np.minimum(w, math.pi / h)
    steps = np.diff(edges)
    weights = np.zeros_like(w)
    weights[:-1] += steps / 2.0
    weights[1:] += steps / 2.0
    weights[0] += edges[0]
    scaled: FloatArray = weights * h / math.pi
    return scaled


def jitter_of(grid: LoopGrid, gains: PidGains, noise: Noise) -> float:
    """Return the standard deviation of the output that noise causes, output units.

    Parameters
    ----------
    grid : LoopGrid
        The process.
    gains : PidGains
        A controller that stabilises it.
    noise : Noise
        What was measured of it.
    """
    controller = controller_response(gains, grid.w)
    through = controller / (1.0 + controller * grid.process)
    return noise.sigma * math.sqrt(float(noise_weights(grid.w, noise.sample_time_s) @ np.abs(through) ** 2))
