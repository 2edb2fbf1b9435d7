"""A fitted structure: its fit, its criterion, and whether the recording can resolve it.

    criterion   n (ln(S/N + floor^2) + 2 (share of samples left out)) + p (ln n + ln s) + ln det(V/s^2)

extended Bayesian information criterion of `p` parameters on `n` independent samples with `s` structures tried (Schwarz,
Ann. Statist. 6, 1978; Chen and Chen, Biometrika 95, 2008). `n` is the number of samples, reduced by their
correlation; `V` the covariance of the noise with the timing jitter of the output (`timing_jitter_model`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.estimation.backgrounds import LEFT_OUT
from autotuner.core.estimation.intervals.covariance import Uncertainty, covariance_of_fit, uncertainty
from autotuner.core.estimation.linear_least_squares import residual_after
from autotuner.core.estimation.noise.outliers import answers, outliers
from autotuner.core.model.process import (
    InverseResponse,
    InverseResponseUnderdamped,
    SopdtUnderdamped,
    ThirdOrderUnderdamped,
    UnstableFopdt,
)
from autotuner.core.model.step_responses import EqualLags, Lag, Pair, PairAndLag
from autotuner.core.signals.noise import inflation

if TYPE_CHECKING:
    from autotuner.core.estimation.optimiser import Solution
    from autotuner.core.model.arrays import BoolArray, FloatArray
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.model.structures import Structure

EVIDENCE = 10.0
"""Smallest decrease of the criterion by the response to the output, relative to a PV that moves on its own."""
LEAST_SHOWN = 1e-5
"""Smallest share of the PV's sum of squares that the response to the output must explain: a background that explains
all other variance leaves rounding and small nonlinearities, which a response could fit."""
MANY_STRUCTURES = math.log(8.0)
"""Additional penalty of a parameter for eight tried structures (Chen and Chen, Biometrika 95, 2008, gamma = 1/2)."""
CERTAIN = 12.0
"""Smallest penalty of a parameter for a white residual: without it, a spurious second lag would bias the dead time."""
SURE = 6.0
"""Standard errors between a time constant and one that resembles an integrator."""
SHORTEST, LONGEST = 0.02, 30.0
"""Range of resolvable time constants: in sample intervals, and in lengths of the recording."""
LEAST_DAMPING = 0.02
"""Damping below which an oscillation belongs to the disturbance, not to the process."""
LARGEST_ZERO = 5.0
"""Largest inverse response accepted: `Z` over the sum of the lags."""
LONGEST_TO_HOLD = 2.0
"""Dead time over time constant above which no PID controller stabilises an unstable process."""
LOOKS_INTEGRATING = 3.0
"""Time constant, in lengths of the recording, above which a lag resembles an integrator."""


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
        """Number of samples per independent sample."""
        return 1.0 if self.rmse <= self.floor else inflation(self.good)

    @property
    def white(self) -> bool:
        """Whether the residual is noise, or nothing."""
        return self.inflation == 1.0

    @property
    def answers_left(self) -> bool:
        """Whether the residual has peaks that recur at one time after the moves of the output."""
        data = self.solution.problem.data
        peaks = outliers(self.residual, self.floor) & self.counts
        return bool(answers(peaks, data.t, data.held.times[1:], data.interval_s).any())

    @property
    def memory(self) -> list[float]:
        """Coefficients of the autoregressive noise, latest sample first; empty for white noise."""
        coloured = self.solution.problem.data.coloured
        return [] if coloured is None else coloured.memory.predictors[-1].tolist()

    @property
    def parameters(self) -> int:
        """Number of everything that was fitted."""
        problem = self.solution.problem
        linear = problem.linear(self.solution.theta).size - (problem.known_gain is not None)
        return int(self.solution.theta.size + linear) + self.structure.chosen

    def criterion(self, independent: float, shared: BoolArray) -> float:
        """Return the extended Bayesian information criterion.

        Parameters
        ----------
        independent : float
            Number of independent samples in the recording.
        shared : array of bool, shape (N,)
            Samples that count for all structures compared; one that counts for others only has its price.
        """
        penalty = math.log(max(independent, 2.0)) + MANY_STRUCTURES
        if independent >= self.good.size:
            penalty = max(penalty, CERTAIN)
        left_out = LEFT_OUT * (1.0 - self.good.size / self.residual.size)
        mean_square = float(np.mean(self.residual[shared] ** 2)) + self.floor**2
        shaken = self.solution.problem.data.shaken
        unsure = 0.0 if shaken is None else shaken.log_determinant + CERTAIN
        return independent * (math.log(mean_square) + left_out) + self.parameters * penalty + unsure

    @property
    def resolved(self) -> bool:
        """Whether every time constant lies where the recording can show one, and the model is plausible.

        Where the response is rounding, its dead time is as well, and only the background competes.
        """
        problem = self.solution.problem
        shortest, longest = SHORTEST * problem.data.interval_s, LONGEST * problem.data.span_s
        shape = self.solution.start.shape
        within = all(shortest < value < longest for value in shape)
        return within and (_is_plausible(self.model) or self._is_rounding())

    def settles(self) -> bool:
        """Return whether the sum of the lags is significantly shorter than one that resembles an integrator here."""
        shape = self.solution.start.shape
        if self.structure.stiffness <= 0.0 or not shape:
            return False
        error = math.sqrt(covariance_of_fit(self.solution, self.inflation)[0, 0])
        a0, together, *_ = self.model.rational().a
        longest = LOOKS_INTEGRATING * self.solution.problem.data.span_s
        return together / a0 * math.exp(min(SURE * error, 700.0)) < longest

    def gain_of_curvature(self) -> float:
        """Return the first-order decrease of `n ln S` by a further column, the response's curvature.

        A right-half-plane zero resembles dead time, `1 - Z s = e^{-Z s} (1 - Z^2 s^2/2 - ...)`, and so does one more
        lag, `1/(1 + T s) = e^{-T s} (1 + T^2 s^2/2 - ...)`: they first differ in the curvature.
        All fitted parameters may change with it (score test, Rao 1948).
        """
        problem, theta = self.solution.problem, self.solution.theta
        shape, delay = problem.split(theta)
        motion = problem.structure.motion(shape, problem.data.span_s)
        if isinstance(motion, EqualLags | PairAndLag):
            return 0.0
        if not isinstance(motion, Lag | Pair):
            return math.inf
        curvature = replace(motion, zero=True).forced(problem.data.held, problem.data.t - delay)[1][1]
        balanced = problem.data.balanced
        tangent = (problem.sensitivities(theta), balanced(problem.layout(theta).columns), balanced(curvature[:, None]))
        residual = residual_after(np.hstack(tangent), problem.residual(theta))
        floor = self.good.size * self.floor**2
        return (
            self.good.size
            / self.inflation
            * math.log((self.solution.misfit + floor) / (float(residual @ residual) + floor))
        )

    def worth(self) -> float:
        """Return by how much the answer to the output lowers the criterion, its parameters paid for.

        Without it the background is all there is: offset, drift, and the motion from the initial state.
        """
        independent, floor = self.good.size / self.inflation, self.good.size * self.floor**2
        fall = independent * math.log((self._without_answer() + floor) / (self.solution.misfit + floor))
        parameters = self.solution.theta.size + self.structure.gains
        return fall - parameters * math.log(max(independent, 2.0))

    def is_shown(self) -> bool:
        """Return whether the recording shows the response to the output: significant, and more than rounding."""
        return self.worth() >= EVIDENCE and not self._is_rounding()

    def _is_rounding(self) -> bool:
        """Return whether the response to the output explains no more than rounding."""
        data = self.solution.problem.data
        deviation = data.balanced(data.pv - data.pv[self.counts].mean())
        return self._without_answer() - self.solution.misfit <= LEAST_SHOWN * float(deviation @ deviation)

    def _without_answer(self) -> float:
        """Return the squares that the background leaves alone."""
        problem, data = self.solution.problem, self.solution.problem.data
        background = data.balanced(problem.layout(self.solution.theta).columns[:, problem.structure.gains :])
        residual = residual_after(background, data.balanced(data.pv))
        return float(residual @ residual)

    def uncertainty(self, *, profile: bool = True) -> Uncertainty:
        """Return the errors of the model's parameters; `profile` as in `covariance.uncertainty`."""
        return uncertainty(self.solution, self.model, self.inflation, profile=profile)


def _is_plausible(model: ProcessModel) -> bool:
    """Return whether it rings no longer than a process does, could be held, and does more than start wrongly."""
    if isinstance(model, UnstableFopdt):
        return model.D <= LONGEST_TO_HOLD * model.T
    if isinstance(model, InverseResponse):
        return LARGEST_ZERO * (model.T1 + model.T2) >= model.Z
    if isinstance(model, InverseResponseUnderdamped) and LARGEST_ZERO * model.n < model.Z:
        return False
    if isinstance(model, SopdtUnderdamped | InverseResponseUnderdamped | ThirdOrderUnderdamped):
        return model.n >= 2.0 * LEAST_DAMPING * math.sqrt(model.m)
    return True
