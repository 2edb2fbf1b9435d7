"""Output-error least squares on the exact response to the recorded output.

    minimise  sum_k w_k (pv_k - y(t_k; model, background))^2

`y` is the zero-order-hold response at the very samples, whatever their spacing, with the dead time unrounded; offset,
drift and initial state are free where the recording needs them. For white noise this is maximum likelihood and reaches
the Cramer-Rao bound (Ljung, System Identification, 1999, ch. 7).

Which background is needed is decided by the Bayesian information criterion: the structure is fitted, then the columns
that lower the criterion are taken in and it is fitted again. The same criterion chooses between structures, with as
many samples as the residual's correlation leaves independent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.identification.backgrounds import LEFT_OUT, backgrounds, cheapest, floor_of
from autotuner.core.identification.covariance import Uncertainty, covariance_of_fit, uncertainty
from autotuner.core.identification.data import ANY_GAIN
from autotuner.core.identification.linear import residual_after
from autotuner.core.identification.motions import Lag, Pair
from autotuner.core.identification.outliers import outliers
from autotuner.core.identification.search import refine, solve
from autotuner.core.identification.static_gain import stands_still
from autotuner.core.identification.structures import INVERSE_RESPONSE
from autotuner.core.process import InverseResponse, SopdtUnderdamped, UnstableFopdt
from autotuner.core.signals.noise import inflation
from autotuner.errors import InputError

if TYPE_CHECKING:
    from autotuner.core.arrays import BoolArray, FloatArray
    from autotuner.core.identification.data import Data, GainPrior
    from autotuner.core.identification.search import Solution
    from autotuner.core.identification.starts import Start
    from autotuner.core.identification.structures import Structure
    from autotuner.core.process import ProcessModel

OUTLIER_ROUNDS = 3
MANY_STRUCTURES = math.log(6.0)
"""What a parameter costs more because six structures are tried (Chen and Chen, Biometrika 95, 2008, gamma = 1/2)."""
CERTAIN = 12.0
"""Least price of a parameter where the residual is white: taken for nothing, a second lag would bias the dead time."""
SURE = 6.0
"""Standard errors by which a time constant has to stay below what would look like an integrator."""
SHORTEST, LONGEST = 0.02, 30.0
"""Time constants that count as seen: in sample intervals, and in lengths of the recording."""
LEAST_DAMPING = 0.02
"""Damping under which an oscillation is the disturbance's, not the process's."""
LARGEST_ZERO = 5.0
"""Largest inverse response believed: `Z` over the sum of the lags."""
LONGEST_TO_HOLD = 2.0
"""Dead time over time constant from which no PID controller holds an unstable process, so that none is on record."""
LOOKS_INTEGRATING = 3.0
"""Time constant, in lengths of the recording, from which a lag looks like an integrator."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """One structure fitted to a recording.

    Attributes
    ----------
    structure : Structure
        What was fitted.
    solution : Solution
        Where the search ended.
    model : ProcessModel
        The model there.
    residual : array of float, shape (N,)
        Measured minus simulated PV, at samples that do not count too.
    spikes : int
        Samples left out as outliers.
    floor : float
        Residual that counts as none, PV.
    """

    structure: Structure
    solution: Solution
    model: ProcessModel
    residual: FloatArray
    spikes: int
    floor: float

    @property
    def good(self) -> FloatArray:
        """The residual at the samples that count."""
        return self.residual[self.counts]

    @property
    def counts(self) -> BoolArray:
        """Which samples count."""
        return self.solution.problem.data.weight > 0.0

    @property
    def rmse(self) -> float:
        """Root mean square of the residual at the samples that count, PV."""
        return float(np.sqrt(np.mean(self.good**2)))

    @property
    def inflation(self) -> float:
        """How many samples are worth an independent one."""
        return 1.0 if self.rmse <= self.floor else inflation(self.good)

    @property
    def white(self) -> bool:
        """Whether the residual is noise, or nothing."""
        return self.inflation == 1.0

    @property
    def parameters(self) -> int:
        """Number of everything that was fitted."""
        problem = self.solution.problem
        linear = problem.linear(self.solution.theta).size - (problem.known_gain is not None)
        return int(self.solution.theta.size + linear)

    def criterion(self, independent: float, shared: BoolArray) -> float:
        """Return the extended Bayesian information criterion.

        Parameters
        ----------
        independent : float
            How many independent samples the recording is worth.
        shared : array of bool, shape (N,)
            Samples that count for all structures compared; one that counts for others only has its price.
        """
        price = math.log(max(independent, 2.0)) + MANY_STRUCTURES
        if independent >= self.good.size:
            price = max(price, CERTAIN)
        left_out = LEFT_OUT * (1.0 - self.good.size / self.residual.size)
        mean_square = float(np.mean(self.residual[shared] ** 2)) + self.floor**2
        return independent * (math.log(mean_square) + left_out) + self.parameters * price

    @property
    def resolved(self) -> bool:
        """Whether every time constant lies where the recording can show one, and the model is plausible."""
        problem = self.solution.problem
        shortest, longest = SHORTEST * problem.data.interval_s, LONGEST * problem.data.span_s
        shape = self.solution.start.shape
        return _is_plausible(self.model) and all(shortest < value < longest for value in shape)

    def settles(self) -> bool:
        """Return whether its lag is significantly shorter than one that would look like an integrator here."""
        shape = self.solution.start.shape
        if self.structure.stiffness <= 0.0 or not shape:
            return False
        slowest = int(np.argmax(shape)) if self.structure is INVERSE_RESPONSE else 0
        error = math.sqrt(covariance_of_fit(self.solution, self.inflation)[slowest, slowest])
        return (
            shape[slowest] * math.exp(min(SURE * error, 700.0)) < LOOKS_INTEGRATING * self.solution.problem.data.span_s
        )

    def gain_of_zero(self) -> float:
        """Return by how much `n ln S` would fall to first order if the response's curvature were a column too.

        A right-half-plane zero looks like dead time, `1 - Z s = e^{-Z s} (1 - Z^2 s^2/2 - ...)`: the curvature is the
        first thing by which it differs. Everything that was fitted may move along (score test, Rao 1948).
        """
        problem, theta = self.solution.problem, self.solution.theta
        shape, delay = problem.split(theta)
        weight = problem.data.weight[:, None]
        motion = problem.structure.motion(shape, problem.data.span_s)
        if not isinstance(motion, Lag | Pair):
            return math.inf
        curvature = replace(motion, zero=True).forced(problem.data.held, problem.data.t - delay)[1][1]
        tangent = (problem.sensitivities(theta), problem.layout(theta).columns * weight, curvature[:, None] * weight)
        left = residual_after(np.hstack(tangent), problem.residual(theta))
        floor = self.good.size * self.floor**2
        return self.good.size / self.inflation * math.log((self.solution.misfit + floor) / (float(left @ left) + floor))

    def uncertainty(self) -> Uncertainty:
        """Return the errors of the model's parameters."""
        return uncertainty(self.solution, self.model, self.inflation)


def fit(
    data: Data,
    structure: Structure,
    prior: GainPrior = ANY_GAIN,
    resolution: float = 0.0,
    more_starts: tuple[Start, ...] = (),
) -> Candidate | None:
    """Fit one structure.

    Parameters
    ----------
    data : Data
        The recording.
    structure : Structure
        What to fit.
    prior : GainPrior
        What is known of the static gain.
    resolution : float
        Smallest step of the PV.
    more_starts : tuple of Start
        Tried besides those of the scan.

    Returns
    -------
    Candidate or None
        None where the best fit is no process of this structure.
    """
    floor = floor_of(data)
    solution = _with_background(data, structure, prior, more_starts)
    spikes = np.zeros(data.t.size, dtype=np.bool_)
    for _ in range(OUTLIER_ROUNDS):
        before, spikes = spikes, outliers(_residual(solution), max(resolution, floor))
        if np.array_equal(spikes, before):
            break
        weight = np.where(spikes, 0.0, 1.0)
        solution = refine(data.weighted(weight), structure, solution.problem.background, solution.start, prior)
    shape, delay = solution.problem.split(solution.theta)
    gains = solution.problem.linear(solution.theta)[: structure.gains].tolist()
    try:
        model = structure.model(shape, gains, delay)
    except InputError:
        return None
    return Candidate(structure, solution, model, _residual(solution), int(spikes.sum()), floor)


def _is_plausible(model: ProcessModel) -> bool:
    """Return whether it rings no longer than a process does, could be held, and does more than start wrongly."""
    if isinstance(model, SopdtUnderdamped):
        return model.n >= 2.0 * LEAST_DAMPING * math.sqrt(model.m)
    if isinstance(model, UnstableFopdt):
        return model.D <= LONGEST_TO_HOLD * model.T
    return not isinstance(model, InverseResponse) or LARGEST_ZERO * (model.T1 + model.T2) >= model.Z


def _residual(solution: Solution) -> FloatArray:
    problem = solution.problem
    simulated: FloatArray = problem.layout(solution.theta).columns @ problem.linear(solution.theta)
    return problem.data.pv - simulated


def _with_background(data: Data, structure: Structure, prior: GainPrior, more_starts: tuple[Start, ...]) -> Solution:
    """Fit with the narrowest background where the recording starts at rest, else the widest; change it if it pays."""
    choices = backgrounds(structure.stiffness)
    first = choices[0] if starts_at_rest(data) else choices[-1]
    solution = solve(data, structure, first, prior, more_starts)
    for _ in range(2):
        problem = solution.problem
        shape, delay = problem.split(solution.theta)
        forced = problem.layout(solution.theta).columns[:, : structure.gains].T
        background = cheapest(data, structure.motion(shape, data.span_s), delay, choices, list(forced))
        if background == problem.background:
            break
        solution = refine(data, structure, background, solution.start, prior)
    return solution


def starts_at_rest(data: Data) -> bool:
    """Return whether the PV stands still, within its noise, while the output has not changed yet."""
    if data.held.times.size < 2:
        return False
    quiet = data.t <= data.held.times[1]
    return stands_still(data.t[quiet], data.pv[quiet])
