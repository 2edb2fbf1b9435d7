"""Least squares once more, after prewhitening by an autoregressive noise model, where the residual is not white.

    minimise  sum_k (A(q) (pv - y(theta)))_k^2,   A(q) = 1 - a_1 q^-1 - ... - a_p q^-p

Rounds of (1) the autoregressive coefficients `a` of the residual, (2) least squares after that filter, until `theta`
converges. The residual of a fit is less than the noise, for the fit absorbs a part of it; so the coefficients are those
of the residual AND of the absorbed part,

    E[c_k(e)] = c_k(residual) + sum_j c_k(M_j),   M M' = J (J' V^-1 J)^-1 J',

`c_k` autocovariances, `J` slopes of the PV to all fitted parameters, `V` the covariance of the noise: residual and
estimate are independent of each other under the right `V`. (The idea is that of Patterson and Thompson, Biometrika 58,
1971.)

A process that does more than its structure leaves a residual with a memory as well. Then the answer stays that of plain
least squares, which comes nearest to the PV: the residual must be white here and show nothing of the output.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.estimation.backgrounds import PRICE
from autotuner.core.estimation.data import ANY_GAIN
from autotuner.core.estimation.drift import choices_of
from autotuner.core.estimation.intervals.covariance import covariance_of_fit, full_jacobian
from autotuner.core.estimation.least_squares import candidate_of, preferred_background
from autotuner.core.estimation.linear_least_squares import residual_after
from autotuner.core.estimation.noise.ar_noise import SAMPLES_EACH, Coloured, even_runs, memory_of
from autotuner.core.estimation.optimiser import Solution, best_delay, refine
from autotuner.core.quantiles import chi2_tail, f_tail
from autotuner.core.signals.noise import autocorrelation, inflation, rms

if TYPE_CHECKING:
    from autotuner.core.estimation.backgrounds import Background
    from autotuner.core.estimation.candidate import Candidate
    from autotuner.core.estimation.data import Data, GainPrior
    from autotuner.core.estimation.initial_guesses import Start
    from autotuner.core.model.arrays import FloatArray

ROUNDS = 8
"""Most rounds of estimating the noise's memory and the model in turn (Cochrane and Orcutt, 1949)."""
SETTLED = 1e-3
"""Relative change of lags and dead time at which the rounds end."""
NOTHING = 1e-9
"""Share of the sample interval up to which a lag or a dead time counts as none."""
ASIDE = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Sample intervals around the dead time in which it is searched: after prewhitening its minima are narrow."""
FARTHER = 1.25
"""Residual of the simulation, over that of plain least squares, up to which the answer is accepted."""
SWINGS_ON = 0.5
"""Share of an oscillation left after a period from which on it is a disturbance to be named, not noise."""
SURE = 1e-4
"""Probability under which a residual is not taken for white, or for free of the output."""
PARTS, LATE = (0.3, 3.0, 1.0, 1.0), (1.0, 1.0, 0.5, 1.5)
"""Factors on lags and dead time of answers that must not be found in the residual."""


def remembered(candidate: Candidate, data: Data, prior: GainPrior = ANY_GAIN) -> Candidate | None:
    """Return a fitted structure with the memory of its noise reckoned with; None where that is not the better answer.

    Parameters
    ----------
    candidate : Candidate
        What plain least squares found.
    data : Data
        The recording.
    prior : GainPrior
        Prior knowledge of the static gain.
    """
    found = None if candidate.white else with_memory(candidate, data, prior, SWINGS_ON)
    return found if found is not None and _is_near(found.solution, _counting(data, candidate), prior) else None


def with_memory(candidate: Candidate, data: Data, prior: GainPrior, swings_on: float) -> Candidate | None:
    """Return a structure where its innovations are least; None where these are not white, or follow the output.

    Parameters
    ----------
    candidate : Candidate
        Where the search starts.
    data : Data
        The recording.
    prior : GainPrior
        Prior knowledge of the static gain.
    swings_on : float
        Share of an oscillation left after a period from which on it is a disturbance, not noise.
    """
    whole = _counting(data, candidate)
    if candidate.solution.problem.data.shaken is not None or not is_even(whole):
        return None
    choices = choices_of(whole, candidate.structure.stiffness)
    firsts = dict.fromkeys((choices[0], candidate.solution.problem.background))
    tried = [_settled(candidate.solution, whole, first, choices, prior) for first in firsts]
    found = [solution for solution in tried if solution is not None]
    if not found:
        return None
    best = min(found, key=criterion_of)
    candidate_ = candidate_of(best, prior, candidate.spikes, candidate.floor)
    if candidate_ is None or candidate_.model.structure != candidate.model.structure:
        return None
    return candidate_ if _is_explained(best, swings_on) else None


def _counting(data: Data, candidate: Candidate) -> Data:
    """Return the recording without outliers, the samples before a state's dead time among those that count."""
    weight = candidate.solution.problem.data.weight
    first = int(np.argmax(weight > 0.0))
    return data.weighted(np.where(np.arange(weight.size) < first, data.weight, weight))


def is_even(data: Data) -> bool:
    """Return whether most samples follow others in even steps."""
    return len(even_runs(data.t, data.weight)) * SAMPLES_EACH < int(np.count_nonzero(data.weight))


def _settled(
    solution: Solution, data: Data, background: Background, choices: tuple[Background, ...], prior: GainPrior
) -> Solution | None:
    """Return where the rounds end that begin with a background; None where the noise remembers nothing."""
    structure = solution.problem.structure
    if background != solution.problem.background:
        solution = refine(data, structure, background, solution.start, prior)
    for _ in range(ROUNDS):
        memory = memory_of(_left(solution), _taken(solution), even_runs(data.t, solution.problem.data.weight))
        if not memory.order:
            return None
        whitened = replace(data, coloured=Coloured.of(memory, data.t, data.weight))
        before, solution = solution.start, _nearby(whitened, solution, background, prior)
        wanted = preferred_background(solution, whitened, choices)
        if wanted == background and _moved(before, solution.start, data.interval_s) < SETTLED:
            break
        background = wanted
    return solution


def _left(solution: Solution) -> FloatArray:
    """Return the weighted residual as it is, before prewhitening."""
    left: FloatArray = solution.problem.left(solution.theta) * solution.problem.data.weight
    return left


def _taken(solution: Solution) -> FloatArray:
    """Return columns whose autocovariances are those of the absorbed part of the noise, shape (N, P)."""
    problem, theta = solution.problem, solution.theta
    plain, samples_each = solution, 1.0
    if problem.data.coloured is None:
        samples_each = inflation(_left(solution)[problem.data.weight > 0.0])
    else:
        plain = Solution(replace(problem, data=replace(problem.data, coloured=None), _theta=None), theta, 0.0)
    size, axes = np.linalg.eigh(covariance_of_fit(solution, samples_each))
    taken: FloatArray = full_jacobian(plain) @ (axes * np.sqrt(np.maximum(size, 0.0)))
    return taken


def _nearby(data: Data, solution: Solution, background: Background, prior: GainPrior) -> Solution:
    """Return the lowest minimum about a solution: several dead times are tried."""
    start, structure = solution.start, solution.problem.structure
    asides = [0.0, *(side * aside * data.interval_s for aside in ASIDE for side in (-1.0, 1.0))]
    delays = [start.delay_s + aside for aside in asides if start.delay_s + aside >= 0.0]
    return refine(data, structure, background, best_delay(data, structure, background, start, delays, prior), prior)


def _moved(before: Start, after: Start, interval_s: float) -> float:
    """Return the largest relative change of lags and dead time, or change in sample intervals where they are zero."""
    pairs = zip((*before.shape, before.delay_s), (*after.shape, after.delay_s), strict=True)
    return max(abs(new - old) / max(abs(old), NOTHING * interval_s) for old, new in pairs)


def criterion_of(solution: Solution) -> float:
    """Return `N ln(S/N)` with the price of the background, by which solutions with other backgrounds are compared."""
    columns = solution.problem.linear(solution.theta).size
    return solution.problem.data.t.size * math.log(solution.score) + PRICE * columns


def _is_near(solution: Solution, data: Data, prior: GainPrior) -> bool:
    """Return whether plain least squares with the same background comes little nearer to the PV."""
    problem = solution.problem
    plain = refine(data, problem.structure, problem.background, solution.start, prior)
    return rms(_left(solution)) < FARTHER * rms(_left(plain))


def _is_explained(solution: Solution, swings_on: float) -> bool:
    """Return whether the residual is white, and shows nothing of the output."""
    problem, theta = solution.problem, solution.theta
    data = problem.data
    if data.coloured is None or data.coloured.memory.swings_on > swings_on:
        return False
    residual = problem.residual(theta)
    r = autocorrelation(residual[data.weight > 0.0])
    if chi2_tail(np.count_nonzero(data.weight) * float(r @ r), r.size) < SURE:
        return False
    shape, delay = problem.split(theta)
    motions = [problem.structure.motion([part * value for value in shape], data.span_s) for part in PARTS]
    responses = [motion.forced(data.held, data.t - delay * late) for motion, late in zip(motions, LATE, strict=True)]
    others = data.balanced(np.column_stack([columns[0] for columns, _ in responses]))
    tangent = full_jacobian(solution)
    kept = residual_after(np.hstack((tangent, others)), residual)
    more, freedom = others.shape[1], np.count_nonzero(data.weight) - tangent.shape[1] - others.shape[1]
    ratio = (float(residual @ residual) / float(kept @ kept) - 1.0) * freedom / more
    return f_tail(ratio, more, freedom) > SURE
