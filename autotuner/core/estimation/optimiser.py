"""The search for shape and dead time: Levenberg-Marquardt from several starts, first on few samples, then on all.

(Levenberg 1944, Marquardt 1963; MINPACK through SciPy.) A dead time that turns negative is put to zero and left there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy

from autotuner.core.estimation.backgrounds import counted, score
from autotuner.core.estimation.data import ANY_GAIN
from autotuner.core.estimation.initial_guesses import Start, delays_of, scans
from autotuner.core.estimation.variable_projection import Projection
from autotuner.core.model.structures import log_shape

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.estimation.backgrounds import Background
    from autotuner.core.estimation.data import Data, GainPrior
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.structures import Structure

COARSE_SAMPLES = 400
"""Samples on which the starts are compared: enough for the place of a valley, not for its floor."""
COARSE_STEPS = 25
"""Most steps of the optimiser from each start on these samples."""
STARTS = 4
"""Best points of the scan from which the optimiser starts."""
LONGEST_KNOWN = 0.5
"""Dead time of a known start, in lengths of the record, from which its response would hardly be seen."""
PLACES = (0.05, 0.2, 0.5, 1.0)
"""Dead times from which those of measured disturbances are searched for once more, as shares of the longest tried."""
TOLERANCE = 1e-9
"""Relative change of the sum of squares, and of shape and dead time, at which the search ends."""


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The best of a search.

    Attributes
    ----------
    problem : Projection
        What was solved.
    theta : array of float
        Where its minimum is.
    misfit : float
        Weighted sum of squares there.
    """

    problem: Projection
    theta: FloatArray
    misfit: float

    @property
    def score(self) -> float:
        """Criterion for solutions with different samples, PV squared."""
        data = self.problem.data
        return float(score(np.array(self.misfit), np.array(np.count_nonzero(data.weight)), data))

    @property
    def gain(self) -> float:
        """Gain of the response's first column."""
        return float(self.problem.linear(self.theta)[0])

    @property
    def start(self) -> Start:
        """The solution as a start for another search."""
        shape, delay = self.problem.split(self.theta)
        return Start(tuple(shape), delay, self.score, tuple(self.problem.other_delays(self.theta).tolist()))


def solve(
    data: Data,
    structure: Structure,
    background: Background,
    prior: GainPrior = ANY_GAIN,
    starts: tuple[Start, ...] = (),
) -> Solution:
    """Return the best fit of a structure.

    Parameters
    ----------
    data : Data
        The recording.
    structure : Structure
        What is fitted.
    background : tuple of str
        Names of the background's columns.
    prior : GainPrior
        Prior knowledge of the static gain.
    starts : tuple of Start
        Where the search starts; the best points of the scan when empty.
    """
    thin = data.thinned(COARSE_SAMPLES)
    known = [start for start in starts if start.delay_s < LONGEST_KNOWN * data.span_s]
    guesses = known or scans(data, structure, background, (prior,))[0][:STARTS]
    placed = [_placed(thin, structure, background, start, prior) for start in guesses] if data.others else guesses
    if len(placed) > 1 or thin.t.size < data.t.size:
        coarse = [refine(thin, structure, background, start, prior, COARSE_STEPS) for start in placed]
        placed = [best_of(coarse, prior).start]
    found = refine(data, structure, background, placed[0], prior)
    # With a state, the samples that count begin one dead time after the first: once more with the one just found.
    found = refine(data, structure, background, found.start, prior) if "state" in background else found
    return _beside(found, data, prior) if structure.gains > 1 else found


def _beside(found: Solution, data: Data, prior: GainPrior) -> Solution:
    """Return the best of a solution and of those with a sample interval more and less of dead time.

    A response that begins with a jump of its slope, downward, has a minimum in each interval between two samples.
    """
    starts = [
        replace(found.start, delay_s=max(found.start.delay_s + by, 0.0)) for by in (-data.interval_s, data.interval_s)
    ]
    kinds = found.problem.structure, found.problem.background
    return best_of([found, *(refine(data, *kinds, start, prior, COARSE_STEPS) for start in starts)], prior)


def best_of(solutions: Sequence[Solution], prior: GainPrior) -> Solution:
    """Return the solution with the lowest score of those that have the right sign."""
    return min(solutions, key=lambda solution: (not prior.allows(solution.gain), solution.score))


def others_moved(solution: Solution, data: Data, prior: GainPrior) -> Solution:
    """Return the best fit with the dead times of measured disturbances searched for from other places too.

    They have their own minima, and their guesses were made with a preliminary process.
    """
    if not data.others:
        return solution
    problem, start, thin = solution.problem, solution.start, data.thinned(COARSE_SAMPLES)
    kinds = problem.structure, problem.background
    places = [tuple(np.full(len(data.others), share * delays_of(data)[-1])) for share in PLACES]
    tried = [refine(thin, *kinds, replace(start, others_s=place), prior, COARSE_STEPS) for place in places]
    return best_of([solution, refine(data, *kinds, best_of(tried, prior).start, prior)], prior)


def best_delay(
    data: Data,
    structure: Structure,
    background: Background,
    start: Start,
    delays_s: Sequence[float],
    prior: GainPrior = ANY_GAIN,
) -> Start:
    """Return a start with the best of some dead times, s; the shape stays."""

    def score_at(delay_s: float) -> float:
        problem, theta = _problem(data, structure, background, replace(start, delay_s=delay_s), prior)
        residual = problem.residual(theta)
        return Solution(problem, theta, float(residual @ residual)).score

    return replace(start, delay_s=min(delays_s, key=score_at))


def refine(
    data: Data,
    structure: Structure,
    background: Background,
    start: Start,
    prior: GainPrior = ANY_GAIN,
    steps: int = 40,
) -> Solution:
    """Return the minimum next to a start."""
    problem, theta = _problem(data, structure, background, start, prior)
    solution = _minimum(problem, theta, steps)
    if problem.split(solution.theta)[1] >= 0.0:
        return solution
    at_once = replace(problem, fixed_delay_s=0.0)
    return _minimum(at_once, np.delete(solution.theta, len(structure.shape)), steps)


def _problem(
    data: Data, structure: Structure, background: Background, start: Start, prior: GainPrior
) -> tuple[Projection, FloatArray]:
    """Return the problem and where its search starts."""
    unit = max(start.delay_s, sum(start.shape), data.span_s / data.t.size)
    problem = Projection(counted(data, background, start.delay_s), structure, background, unit, prior.known)
    others_s = start.others_s or (start.delay_s,) * len(data.others)
    return problem, np.array([*log_shape(start.shape), *(D / unit for D in (start.delay_s, *others_s))])


def _placed(data: Data, structure: Structure, background: Background, start: Start, prior: GainPrior) -> Start:
    """Return a start with the dead time of each measured disturbance at the best of the scan's, one after the other."""
    problem, theta = _problem(data, structure, background, start, prior)
    tried = delays_of(data) / problem.delay_unit_s
    for k in range(theta.size - len(data.others), theta.size):
        misfits = []
        for theta[k] in tried:
            residual = problem.residual(theta)
            misfits.append(float(residual @ residual))
        theta[k] = tried[int(np.argmin(misfits))]
    return replace(start, others_s=tuple(problem.other_delays(theta).tolist()))


def _minimum(problem: Projection, theta: FloatArray, steps: int) -> Solution:
    if theta.size:
        # What `least_squares` does with the method "lm", without its checks of every value.
        theta = scipy.optimize.leastsq(
            problem.residual,
            theta,
            Dfun=problem.jacobian,
            full_output=True,
            ftol=TOLERANCE,
            xtol=TOLERANCE,
            gtol=1e-15,
            maxfev=steps,
        )[0]
    residual = problem.residual(theta)
    return Solution(problem, theta, float(residual @ residual))
