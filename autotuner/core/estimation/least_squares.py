"""Output-error least squares on the exact response to the recorded output.

    minimise  sum_k w_k (pv_k - y(t_k; model, background))^2

`y` is the response through a zero-order hold at the very samples, whatever their spacing, with the dead time unrounded;
offset, drift and initial state are free where the recording needs them. For white noise this is maximum likelihood and
reaches the Cramer-Rao bound (Ljung, System Identification, 1999, ch. 7).

The structure is fitted with the background that the record's beginning suggests; then the background that its criterion
selects is used, and it is fitted again. Spikes in the residual are omitted.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.estimation.backgrounds import PRICE, cheapest, floor_of
from autotuner.core.estimation.candidate import Candidate
from autotuner.core.estimation.data import ANY_GAIN
from autotuner.core.estimation.drift import choices_beside, choices_of, starts_at_rest
from autotuner.core.estimation.noise.outliers import answers, outliers
from autotuner.core.estimation.optimiser import others_moved, refine, solve
from autotuner.core.estimation.switch_times import LEAST_NOISE, settled
from autotuner.core.model.arrays import SMALLEST_DIVISOR
from autotuner.core.signals.noise import noise_sigma
from autotuner.errors import InputError

if TYPE_CHECKING:
    from autotuner.core.estimation.backgrounds import Background
    from autotuner.core.estimation.data import Data, GainPrior
    from autotuner.core.estimation.initial_guesses import Start
    from autotuner.core.estimation.optimiser import Solution
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.structures import Structure

OUTLIER_ROUNDS = 3
"""Most rounds of fitting and leaving out outliers, which bounds the time where two sets alternate."""
FIRST_NOISE = 0.1
"""Noise to begin with where moments are free, as a share of the residual without: most of that may be the moments'."""

SMALLEST_NORMAL = float(np.finfo(float).tiny)
"""Replaces a gain that is exactly zero; the smallest normal number of IEEE 754."""


def fit(
    data: Data,
    structure: Structure,
    prior: GainPrior = ANY_GAIN,
    resolution: float = 0.0,
    starts: tuple[Start, ...] = (),
) -> Candidate | None:
    """Fit one structure.

    Parameters
    ----------
    data : Data
        The recording.
    structure : Structure
        What to fit.
    prior : GainPrior
        Prior knowledge of the static gain.
    resolution : float
        Smallest step of the PV.
    starts : tuple of Start
        Where the search starts; the best points of the scan when empty.

    Returns
    -------
    Candidate or None
        None where the best fit is not a process of this structure.
    """
    floor = floor_of(data)
    solution = _with_background(data, structure, prior, starts)
    spikes = np.zeros(data.t.size, dtype=np.bool_)
    for _ in range(OUTLIER_ROUNDS):
        previous, spikes = spikes, outliers(_residual(solution), max(resolution, floor))
        spikes &= ~answers(spikes, data.t, data.held.times[1:], data.interval_s)
        if np.array_equal(spikes, previous):
            break
        weight = np.where(spikes, 0.0, data.weight)
        solution = refine(data.weighted(weight), structure, solution.problem.background, solution.start, prior)
    return candidate_of(solution, prior, int(np.count_nonzero(spikes & (data.weight > 0.0))), floor)


def freed(candidate: Candidate, prior: GainPrior = ANY_GAIN) -> Candidate | None:
    """Return the same structure with the times of the output's changes free; None where it is not a process then."""
    sigma = max(noise_sigma(candidate.solution.problem.data.pv), FIRST_NOISE * candidate.rmse)
    solution = settled(candidate.solution, prior, sigma)
    return candidate_of(solution, prior, candidate.spikes, LEAST_NOISE * candidate.floor)


def candidate_of(solution: Solution, prior: GainPrior, spikes: int, floor: float) -> Candidate | None:
    """Return the candidate, or None where it is not a process, or one of the wrong sign: a controller's inverse."""
    problem, theta = solution.problem, solution.theta
    if not problem.data.weight.any():
        return None  # the dead time is longer than the record, so that nothing was fitted
    if not prior.allows(solution.gain):
        return None
    shape, delay = problem.split(theta)
    if problem.structure.stiffness < 0.0 and min(shape) < problem.data.interval_s:
        # What runs away within a sample is an immediate answer of the other sign: the controller's inverse again.
        return None
    # A gain of exactly zero is not a process, but its background competes with the other structures.
    gains = [gain or SMALLEST_NORMAL for gain in problem.linear(theta)[: problem.structure.gains].tolist()]
    try:
        model = problem.structure.model(shape, gains, delay)
    except InputError:
        return None
    return Candidate(problem.structure, solution, model, _residual(solution), spikes, floor)


def _residual(solution: Solution) -> FloatArray:
    """Return the residual at every sample, also those that do not count; its noise white."""
    problem = solution.problem
    return problem.data.whitened(problem.left(solution.theta))


def _with_background(data: Data, structure: Structure, prior: GainPrior, starts: tuple[Start, ...]) -> Solution:
    """Fit with the narrowest background where the recording starts at rest, else also with the widest.

    A state is a strong thing to assume: together with a long dead time it explains the answer of a whole closed loop,
    or half a period of an oscillation as its opposite. An integrator that is not at rest drifts.
    """
    choices = choices_of(data, structure.stiffness)
    if starts_at_rest(data) or len(choices) == 1:
        firsts = choices[:1]
    else:
        firsts = (choices[-1], choices[1 if structure.stiffness == 0.0 else 0])
    found = [_settled(solve(data, structure, first, prior, starts), data, choices, prior) for first in firsts]
    moved = [others_moved(solution, data, prior) for solution in found]
    return min(moved, key=lambda solution: (not prior.allows(solution.gain), _priced(solution)))


def _priced(solution: Solution) -> float:
    """Return the score with the price of the background's columns, on the scale of its logarithm."""
    samples = max(int(np.count_nonzero(solution.problem.data.weight)), 1)
    return (
        math.log(max(solution.score, SMALLEST_DIVISOR)) + PRICE * solution.problem.linear(solution.theta).size / samples
    )


def _settled(solution: Solution, data: Data, choices: tuple[Background, ...], prior: GainPrior) -> Solution:
    """Return the solution with the background that its criterion prefers."""
    for _ in range(2):
        background = preferred_background(solution, data, choices)
        if background == solution.problem.background:
            break
        solution = refine(data, solution.problem.structure, background, solution.start, prior)
    return solution


def preferred_background(solution: Solution, data: Data, choices: tuple[Background, ...]) -> Background:
    """Return the background that its criterion selects for the process of a solution."""
    problem = solution.problem
    shape, delay = problem.split(solution.theta)
    columns = problem.layout(solution.theta).columns
    forced = [*columns[:, : problem.structure.gains].T, *columns[:, columns.shape[1] - len(data.others) :].T]
    motion = problem.structure.motion(shape, data.span_s)
    return cheapest(data, motion, delay, choices_beside(motion, delay, data, choices), forced)
