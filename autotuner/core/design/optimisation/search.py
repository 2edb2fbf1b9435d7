"""Optimum of a controller with given times on a process: its largest gain inside all limits, and the remaining error.

    variance of the output per variance of white noise = h/pi integral of |R(jw)|^2 dw from 0 to pi/h

Invariants: the gain is never searched where a closed form gives it; a controller that cannot keep the limits is
None, not a bad number.

The search for the times of a controller: a coarse grid in ultimate periods, then simplexes from its best points.

The gain is not a variable: for given times the limits determine it (`gain_limits`). First `Ti` and `Td`
are searched without a limit of the noise, with the filter tied to `Td`; then the filter too, from the result.

Invariants: variables are logarithms of times; nothing is random; the simpler controller wins a tie.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy

from autotuner.core.design.gains import PidGains
from autotuner.core.design.nyquist import encircles_nothing, frequency_grid, path_ends
from autotuner.core.design.optimisation.gain_limits import largest_gain
from autotuner.core.design.requirements import Controller, Purpose, Requirements
from autotuner.core.model.process import frequency_response

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from autotuner.core.design.optimisation.loop_grid import LoopGrid
    from autotuner.core.design.requirements import Noise
    from autotuner.core.model.arrays import ComplexArray, FloatArray
    from autotuner.core.model.process import ProcessModel

NOT_POSSIBLE = 50.0
"""Logarithm of the error of a controller that cannot keep the limits."""
OVERSHOOT_PRICE = 5.0
"""Weight of the overshoot in the logarithm of the load error: 1 % of the step beyond the goal's counts as 5 %."""
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
        unit = self.sign * self.grid.controller(shape)
        loops, ends = unit * self.responses, path_ends(self.grid.model, shape).times(self.sign)

        def stable(k: float) -> bool:
            return encircles_nothing(ends.times(k), k * loops[0])

        k = largest_gain(loops, self.Ms, self.Mt, stable)
        if k is not None and self.requirements.noise is not None:
            k = self._quiet_gain(k, unit)
        return None if k is None else replace(shape, Kp=self.sign * k)

    def stabilises_all(self, gains: PidGains) -> bool:
        """Return whether the loop is stable for every process; a search only checks the first one."""
        controller = self.grid.controller(gains)
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
        device = self.requirements.device
        if self.requirements.purpose is Purpose.LOAD:
            return self.load_iae(gains) * (1.0 if device is None else self._overshoot_factor(gains))
        b = 1.0 if device is None else device.b
        e0, p = self.grid.set_point_error(gains)
        if abs(e0[0] - b * p[0] - 1.0) > UNRESOLVED:
            return math.inf
        return self.grid.model.D + self.grid.integral_of(e0 - b * p)

    def _overshoot_factor(self, gains: PidGains) -> float:
        """Return the factor of the error for its overshoot, in a device with a fixed set-point weight."""
        excess = self.grid.overshoot(gains) - self.requirements.overshoot if gains.Ki else 0.0
        return math.exp(OVERSHOOT_PRICE * min(max(0.0, excess), 1.0))

    def load_iae(self, gains: PidGains) -> float:
        """Return the integral of the absolute error after a unit load step; at least `Ti/|Kp|`, the integral error."""
        if gains.Ki == 0.0:
            return math.inf
        return max(self.grid.integral_of(self.grid.load_error(gains)), 1.0 / abs(gains.Ki))

    def _quiet_gain(self, k: float, unit: ComplexArray) -> float | None:
        """Return the largest gain up to `k` that keeps the limits and the allowed movement of the output, or None."""
        noise = self.requirements.noise
        assert noise is not None  # noqa: S101 - only called with a noise limit
        allowed = (noise.jitter / noise.sigma) ** 2

        def excess(gain: float) -> float:
            noise_response = gain * unit / (1.0 + gain * unit * self.grid.process)
            return float(self.noise_weights @ np.abs(noise_response) ** 2) / allowed - 1.0

        if allowed == 0.0 or not excess(0.0) < 0.0:  # smaller than a number can be: no gain at all is as quiet
            return None
        if excess(k) <= 0.0:
            return k
        quiet = float(scipy.optimize.brentq(excess, 0.0, k, xtol=1e-5 * k, rtol=1e-4))
        return quiet if quiet > 0.0 and self.keeps(quiet * unit * self.responses) else None

    def keeps(self, loop: ComplexArray) -> bool:
        """Return whether loops keep the limits of both sensitivities."""
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
    controller = grid.controller(gains)
    noise_response = controller / (1.0 + controller * grid.process)
    return noise.sigma * math.sqrt(float(noise_weights(grid.w, noise.sample_time_s) @ np.abs(noise_response) ** 2))


TI_STARTS = np.geomspace(0.03, 10.0, 8)
TD_STARTS = np.geomspace(0.01, 1.0, 6)
TF_STARTS = np.geomspace(0.003, 0.3, 4)
LONGEST, SHORTEST = 300.0, 0.001
"""Times of the controller in ultimate periods."""
SLOWER_STARTS = (1.0, 2.0, 4.0, 8.0)
FILTER_STARTS = (0.03, 0.1, 0.4, 1.5)
"""Initial guesses of the search with a filter: the best times without it, scaled, `Tf` as a share of `Td` or `Ti/4`."""
DEAD_TIME_START = (0.26, 0.17, 0.13)
"""Initial guess of the best PID controller of a pure dead time, in ultimate periods."""
LARGEST_FILTER_RATIO = 100.0
"""`Td / Tf` (or `Ti / (4 Tf)`) with a noise limit."""
LONGER_FILTER = 1.05
"""Ratio to the shortest filter at which it shows whether a longer one costs less."""
SIMPLEX_STARTS = 2
"""Best points of the grid from which the simplex search starts: two, as the cost may have two valleys."""
ROUGH, CLOSE = (0.1, 1e-2), (1e-3, 1e-5)
"""Differences of logarithms of times, and of errors, at which a simplex ends: to rank them, and for the best one."""
SIMPLEX_STEP, NEIGHBOUR_STEP = 0.4, 0.15
"""First edge of a simplex, in logarithms of times; smaller next to a known answer."""
WORTH_A_DERIVATIVE = 0.99
"""Error of PID over that of PI above which derivative action is omitted."""
CHECK_STEP_RAD = 0.03
"""Steps of the dead time's phase in the last check, where the peaks of a sensitivity are narrow."""
PEAK_POINTS = 41
"""Frequencies of the last check from one neighbour of a peak to the other: a peak is then known to 1e-5."""
CHECK_RESERVE = 0.999
"""Reserve of the last check, as a share of `M - 1`, for peaks between its frequencies."""


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
        return _checked(search, _in_device(search.requirements, PidGains(1.0)))
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
        if self.requirements.device is not None:
            return False
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
        guesses = [np.hstack((times, share * reference)) for share in FILTER_STARTS]
        if self.derivative:
            guesses.append(np.array([DEAD_TIME_START]) * self.Pu)
        logarithms: FloatArray = np.log(np.vstack(guesses))
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
        return _in_device(self.requirements, PidGains(1.0, Ti, Td, max(searched, shortest)))


def _in_device(requirements: Requirements, shape: PidGains) -> PidGains:
    """Return the controller in the form of the device; unchanged without a known device."""
    return shape if requirements.device is None else requirements.device.as_run(shape)


def _searched(search: Search, axes: _Axes, start: PidGains | None = None) -> PidGains | None:
    """Return the best PI or PID controller: first without limit on the noise, then with the filter as a third time."""
    best: FloatArray | None
    if start is not None:
        best = _minimum(search, axes, axes.at(start), NEIGHBOUR_STEP)
    else:
        best = _minimum(search.without_noise(), axes, axes.everywhere(with_filter=False))
        if best is not None and axes.filter_matters and not _needs_no_filter(search, axes, best):
            best = _minimum(search, axes, axes.with_filter(best))
            best = _minimum(search, axes, axes.everywhere(with_filter=True)) if best is None else best
    return None if best is None else _checked(search, axes.shape(best))


def _needs_no_filter(search: Search, axes: _Axes, best: FloatArray) -> bool:
    """Return whether a filter longer than the shortest costs more, both near the best times and elsewhere.

    Without a limit of the noise only a process that is little more than dead time gains from one.
    """
    if search.requirements.noise is not None:
        return False
    cost = _cost_of(search, axes)
    least, longer = cost(best), math.log(LONGER_FILTER * axes.shape(best).Tf)
    elsewhere = [x for x in axes.with_filter(best) if x[-1] > longer]
    if not elsewhere or cost(np.append(best, longer)) < least:
        return False
    return _simplex(cost, _corners(min(elsewhere, key=cost), SIMPLEX_STEP), *ROUGH)[0] >= least


def _minimum(search: Search, axes: _Axes, guesses: FloatArray, step: float = SIMPLEX_STEP) -> FloatArray | None:
    """Return the logarithms of the best times: simplexes from the best of the starts."""
    cost = _cost_of(search, axes)
    costs = np.array([cost(x) for x in guesses])
    if costs.min() >= NOT_POSSIBLE:
        return None
    starts = guesses[np.argsort(costs, kind="stable")[:SIMPLEX_STARTS]]
    rough = [_simplex(cost, _corners(x, step), *ROUGH) for x in starts]
    cheapest = min(rough, key=lambda pair: pair[0])[1]
    best: FloatArray = _simplex(cost, cheapest, *CLOSE)[1][0]
    return best


def _cost_of(search: Search, axes: _Axes) -> Callable[[FloatArray], float]:
    """Return the cost of a controller by the logarithms of its times."""
    return lambda x: search.cost(axes.shape(x))


def _corners(start: FloatArray, step: float) -> FloatArray:
    """Return the corners of a simplex with its first edges along the axes."""
    return np.vstack((start, start + step * np.eye(start.size)))


def _simplex(
    cost: Callable[[FloatArray], float], corners: FloatArray, xatol: float, fatol: float
) -> tuple[float, FloatArray]:
    """Return the least cost, and the corners where the search ends, the best first: from there it goes on unchanged."""
    result = scipy.optimize.minimize(
        cost, corners[0], method="Nelder-Mead", options={"initial_simplex": corners, "xatol": xatol, "fatol": fatol}
    )
    ended: FloatArray = result.final_simplex[0]
    return float(result.fun), ended


def _checked(search: Search, shape: PidGains) -> PidGains | None:
    """Return the shape with its largest gain on a grid that is refined for this controller."""
    rough = search.gains_at(shape)
    if rough is None:
        return None
    w = frequency_grid(search.grid.model, rough, CHECK_STEP_RAD)
    fine = _on(search, w)
    gains = fine.gains_at(shape) or rough
    finer = _on(search, _with_peaks(fine.grid, gains))
    if not finer.keeps(finer.grid.controller(gains) * finer.responses):
        gains = finer.gains_at(shape) or gains
    return gains if finer.stabilises_all(gains) else None


def _with_peaks(grid: LoopGrid, gains: PidGains) -> FloatArray:
    """Return the frequencies with more of them around the largest of either sensitivity, where a peak is narrow."""
    w, loop = grid.w, grid.controller(gains) * grid.process
    distance = np.abs(1.0 + loop)
    largest = {int(np.argmin(distance)), int(np.argmax(np.abs(loop) / distance))}
    around = [np.linspace(w[max(k - 1, 0)], w[min(k + 1, w.size - 1)], PEAK_POINTS) for k in largest]
    return np.unique(np.concatenate((w, *around)))


def _on(search: Search, w: FloatArray) -> Search:
    """Return the problem of the last check on a grid of its own."""
    fine = replace(search.grid, w=w, process=frequency_response(search.grid.model, w))
    return Search(fine, search.models[1:], search.requirements, CHECK_RESERVE)
