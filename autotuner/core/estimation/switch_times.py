"""Changes of the output that happened between two samples: their times are estimated together with the process.

    pv(t) = y(t; theta, tau + e),   d pv/d e_i = -step_i gain g(t - D - tau_i),   e_i uniform in (-slack_i, 0)

`tau` times as recorded, `e` their corrections, s; `g` impulse response. A recorded output shows a
change at the first sample after it, so `e` has the mean `-slack/2` and the deviation `slack/sqrt(12)`. The static gain
is sensitive to these times: a relay record of a lag ten times its dead time shows little more of the gain than the
rise or fall of the oscillation after each switch.

Rounds of (1) least squares under the noise by the errors of the switch times (`timing_jitter_model`), (2) the
most likely times, from which the next round starts (Gauss and Newton), (3) the noise of the samples. The likelihood
decides whether a record needs this: one with exact times is better explained without.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.estimation.backgrounds import floor_of
from autotuner.core.estimation.intervals.covariance import full_jacobian
from autotuner.core.estimation.noise.timing_jitter_model import TimingJitterModel
from autotuner.core.estimation.optimiser import refine
from autotuner.core.model.zoh_input import unit_step

if TYPE_CHECKING:
    from autotuner.core.estimation.data import Data, GainPrior
    from autotuner.core.estimation.optimiser import Solution
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.recording import Recording

MOST_CHANGES, MOST_WORK = 100, 1e7
"""Changes, and samples times changes squared, up to which their moments are estimated."""
FEWEST_SAMPLES = 5
"""Samples a change from which its moment can be distinguished from noise."""
ROUNDS = 20
"""Most Gauss-Newton rounds over the moments of the changes."""
SETTLED, STEADY = 1e-3, 0.1
"""Change of the moments, in slacks, and relative change of the noise, at which the rounds end."""
LEAST_NOISE = 10.0
"""Least noise reckoned with, in residuals that count as none: far under that of the moments, arithmetic ends."""


def may_be_unsure(data: Data) -> bool:
    """Return whether the moments of the changes are open, and few enough to be estimated."""
    changes, samples = data.held.times.size - 1, data.t.size
    few = 1 <= changes <= min(MOST_CHANGES, samples / FEWEST_SAMPLES, math.sqrt(MOST_WORK / samples))
    return few and data.held.slack_s is not None


def promise(solution: Solution) -> float:
    """Return by how much free moments would raise the log likelihood of a fit with the moments as recorded.

    To first order, with all fitted parameters free. Positive where the record supports the correction.
    """
    data, sigma = solution.problem.data, _sigma(solution)
    if sigma <= LEAST_NOISE * floor_of(data):
        return -math.inf
    shaken = _shaken(solution, data, np.zeros(data.held.times.size - 1), sigma).shaken
    assert shaken is not None  # noqa: S101 - just made
    tangent = np.linalg.qr(full_jacobian(solution))[0]
    residual, columns = (
        free - tangent @ (tangent.T @ free)
        for free in (solution.problem.residual(solution.theta), shaken.columns * data.weight[:, None])
    )
    residual_noise = TimingJitterModel.of(columns, np.ones_like(data.weight), sigma)
    white = residual_noise.whitened(residual)
    used = int(np.count_nonzero(data.weight))
    return 0.5 * (used * math.log(float(residual @ residual) / float(white @ white)) - residual_noise.log_determinant)


def settled(solution: Solution, prior: GainPrior, sigma: float) -> Solution:
    """Return a fit with the moments of the output's changes free within their slack.

    Parameters
    ----------
    solution : Solution
        The fit with the moments as recorded.
    prior : GainPrior
        Prior knowledge of the static gain.
    sigma : float
        Noise to begin with, PV.
    """
    data = solution.problem.data
    assert data.held.slack_s is not None  # noqa: S101 - see `may_be_unsure`
    slack, least = data.held.slack_s[1:], LEAST_NOISE * floor_of(data)
    shifts = -slack / 2.0
    for _ in range(ROUNDS):
        problem = solution.problem
        shaken = _shaken(solution, data, shifts, sigma)
        solution = refine(shaken, problem.structure, problem.background, solution.start, prior)
        previous, shifts = shifts, np.clip(most_likely_shifts(solution), -slack, 0.0)
        supposed, sigma = sigma, max(_sigma(solution), least)
        moved = float(np.max(np.abs(shifts - previous) / slack))
        if moved < SETTLED and abs(math.log(sigma / supposed)) < STEADY:
            break
    return solution


def _sigma(solution: Solution) -> float:
    fitted = solution.theta.size + solution.problem.linear(solution.theta).size
    return math.sqrt(solution.misfit / max(int(np.count_nonzero(solution.problem.data.weight)) - fitted, 1))


def _shaken(solution: Solution, data: Data, shifts: FloatArray, sigma: float) -> Data:
    """Return the recording with its changes moved; the remaining uncertainty of their times counts as noise."""
    assert data.held.slack_s is not None  # noqa: S101 - see `may_be_unsure`
    slopes, slack = moment_slopes(solution, data, shifts), data.held.slack_s[1:]
    shaken = TimingJitterModel.of(slopes * (slack / math.sqrt(12.0) / sigma), data.weight, sigma)
    return replace(data, held=data.held.shifted(shifts), pv=data.pv - slopes @ (-slack / 2.0 - shifts), shaken=shaken)


def moment_slopes(solution: Solution, data: Data, shifts: FloatArray) -> FloatArray:
    """Return the slope of the PV with the moment of each change, PV/s, shape (N, C)."""
    problem, theta = solution.problem, solution.theta
    shape, delay = problem.split(theta)
    motion = problem.structure.motion(shape, data.span_s)
    since = data.t - delay - (data.held.times[1:] + shifts)[:, None]
    slopes = motion.forced(unit_step(0.0), since)[1]
    response = np.tensordot(problem.linear(theta)[: len(slopes)], np.stack(slopes), axes=1)
    result: FloatArray = -(data.held.steps[1:, None] * response).T
    return result


def most_likely_shifts(solution: Solution) -> FloatArray:
    """Return by how much each change happened later than recorded, s; negative."""
    problem, theta = solution.problem, solution.theta
    data = problem.data
    assert data.shaken is not None and data.held.slack_s is not None  # noqa: S101, PT018 - made by `_shaken`
    residual = problem.left(theta) * data.weight
    slack = data.held.slack_s[1:]
    result: FloatArray = slack * (data.shaken.shifts(residual, data.weight) / math.sqrt(12.0) - 0.5)
    return result


def shifts_of(solution: Solution, data: Data) -> FloatArray | None:
    """Return by how much a fit moved the changes of a recording, s; None where it took them as they stand."""
    moved = solution.problem.data
    return None if moved.shaken is None else moved.held.times[1:] - data.held.times[1:]


def with_moments(recording: Recording, shifts: FloatArray) -> Recording:
    """Return a recording whose outputs act from the estimated times.

    Parameters
    ----------
    recording : Recording
        The output as it was sampled.
    shifts : array of float, shape (C,)
        By how much each of its changes happened later than recorded, s; not positive.
    """
    rows = np.flatnonzero(np.diff(recording.output)) + 1
    # A sample holds one change: where two follow each other at once, the second stays at its own sample.
    first_of_row = np.diff(rows, prepend=-1) > 1
    rows, moments = rows[first_of_row], recording.t[rows[first_of_row]] + shifts[first_of_row]
    output, written_s = recording.output.copy(), recording.t.copy()
    output[rows - 1] = output[rows]
    written_s[rows - 1] = np.clip(moments, recording.t[rows - 1], recording.t[rows])
    return replace(recording, output=output, written_s=written_s)
