"""Whether the residual of a model is autoregressive noise: an unmeasured disturbance, and no missing effect.

    e_k = a_1 e_{k-1} + ... + a_p e_{k-p} + w_k,   w the innovations

A residual is such noise where (1) its innovations are white, (2) past outputs explain nothing of them, (3) they are
as large on the selection part as on the fitted one, and in every fifth of the fitted part, (4) the memory fades
within half of the process's own lags, or within one and a half where the innovations are normal, and (5) the noise is
a small share of the PV's motion. A slow or uneven residual is none, and stays unexplained. Where the process was fitted
beside the noise (`beside_a_load`), its memory may be longer, and its share larger. (Ljung, System Identification, 1999,
ch. 16.6: residual analysis.)

Effects give way to it where they are not worth their numbers:

    2 N ln(sigma_w / sigma_e) < price of the effects,   sigma_e innovations of the residual with them

`N` fitted samples, `sigma_w` standard deviation of `w`, prices as in the criterion (see `fit_context`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.base import is_physical, theta_of
from autotuner.core.diagnosis.extended.fitting import fit
from autotuner.core.estimation.data import GainPrior
from autotuner.core.estimation.disturbed_loop import with_disturbance
from autotuner.core.estimation.linear_least_squares import residual_after
from autotuner.core.estimation.noise.ar_noise import Coloured, Memory, even_runs, memory_of
from autotuner.core.model.arrays import SMALLEST_DIVISOR
from autotuner.core.model.structures import FOPDT, SECOND_ORDER
from autotuner.core.quantiles import chi2_tail, f_tail
from autotuner.core.signals.noise import autocorrelation, rms

if TYPE_CHECKING:
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.diagnosis.extended.fit_context import FitContext
    from autotuner.core.model.arrays import FloatArray, IntArray

SURE = 1e-3
"""Probability under which innovations are not taken for white, or for free of the output."""
MOST_OF_THE_MOTION = 0.15
"""Share of the PV's standard deviation that noise may have."""
UNEVEN = 1.6
"""Innovations in one fifth of the record, or on the selection part, over all of them."""
FADES, FADES_WITH_PROCESS = 0.5, 1.5
"""Time constant of the memory over the process's own: of any noise, and of the sum of many small disturbances, which is
normal and has passed the process. That has the process's own memory, known to about half."""
FEWEST_LENGTHS = 12
"""Fewest time constants of the memory in the fitted part, where the process was fitted beside the noise: a few slow
swings are a single event, which has a name."""
BLOCKS, PAST = 5, 12


@dataclass(frozen=True, slots=True)
class Innovations:
    """Standard deviations, PV: of the noise, and of its innovations."""

    noise: float
    fitted: float
    selection: float


@lru_cache(maxsize=4)
def coloured_noise(context: FitContext, candidate: Fitted) -> Innovations | None:
    """Return the innovations of a model whose residual is autoregressive noise, else None. Cached.

    It is none where it is white, or not noise.
    """
    dataset = context.dataset
    rows, residual = _residual(context, candidate)
    noise, motion = rms(residual), float(np.std(dataset.data.pv[rows]))
    most = MOST_OF_THE_MOTION if candidate.problem.memory is None else math.inf
    if rows.size < 5 * PAST or not 0.0 < noise < most * motion:
        return None
    t, memory = dataset.data.t, _memory(context, rows, residual)
    if not memory.order:
        return None
    white = _whitened(memory, t[rows], residual)
    if (
        not _fades(memory.predictors[-1], candidate, dataset.data.interval_s, white)
        or not _is_white(white)
        or _follows_output(context, rows, white)
    ):
        return None
    size = rms(white)
    blocks = [rms(block) for block in np.array_split(white, BLOCKS)]
    others = np.flatnonzero(dataset.held_out)
    late = rms(_whitened(memory, t[others], dataset.data.pv[others] - candidate.simulated(others)))
    if max(blocks) > UNEVEN * size or late > UNEVEN * size:
        return None
    return Innovations(noise, size, late)


def beside_a_load(context: FitContext, plain: Fitted, sign: int) -> Fitted | None:
    """Return the process of a closed loop with a large load, by its error of prediction; None where it has no such one.

    Plain least squares lies between the process and the inverse of the controller there (see `disturbed_loop`).

    Parameters
    ----------
    context : FitContext
        The record, in which the set point moves.
    plain : Fitted
        The process by plain least squares.
    sign : int
        Sign of the gain; 0 when unknown.
    """
    dataset, rows = context.dataset, np.flatnonzero(context.dataset.fitted)
    if not dataset.in_loop or plain.rms < MOST_OF_THE_MOTION * float(np.std(dataset.data.pv[rows])):
        return None
    before = slice(0, rows[-1] + 1)
    weight = dataset.fitted[before].astype(float)
    data = replace(dataset.data, t=dataset.data.t[before], pv=dataset.data.pv[before], weight=weight)
    found = with_disturbance((), (FOPDT, SECOND_ORDER), data, GainPrior(None, sign))
    if found is None or found.solution.problem.data.coloured is None:
        return None
    memory = found.solution.problem.data.coloured.memory
    problem = replace(plain.problem, structure=found.structure, memory=memory, rows=rows)
    fitted = fit(problem, theta_of(problem, found.solution.start))
    return fitted if is_physical(fitted) and coloured_noise(context, fitted) is not None else None


def is_noise_instead(context: FitContext, plain: Fitted, chosen: Fitted) -> bool:
    """Return whether autoregressive noise beside a plain model is a better explanation than effects are.

    Both are judged by the innovations of their residuals, with the prices of the criterion.
    """
    noise = coloured_noise(context, plain)
    if noise is None:
        return False
    rows, residual = _residual(context, chosen)
    left = rms(_whitened(_memory(context, rows, residual), context.dataset.data.t[rows], residual))
    more = context.price_of(chosen, rows.size) - context.price_of(plain, rows.size)
    return 2.0 * rows.size * math.log(noise.fitted / max(left, context.dataset.floor)) < more


def _residual(context: FitContext, candidate: Fitted) -> tuple[IntArray, FloatArray]:
    """Return the fitted samples, and the residual there, without its mean."""
    rows = np.flatnonzero(context.dataset.fitted)
    residual = context.dataset.data.pv[rows] - candidate.simulated(rows)
    return rows, residual - residual.mean()


def _memory(context: FitContext, rows: IntArray, residual: FloatArray) -> Memory:
    runs = even_runs(context.dataset.data.t[rows], np.ones(rows.size))
    return memory_of(residual, np.zeros((rows.size, 0)), runs)


def _whitened(memory: Memory, t: FloatArray, residual: FloatArray) -> FloatArray:
    """Return the innovations of a residual at some times."""
    return Coloured.of(memory, t, np.ones(t.size)).whitened(residual)


def _fades(predictor: FloatArray, candidate: Fitted, interval_s: float, innovations: FloatArray) -> bool:
    """Return whether the memory is shorter than the process's own, or about as long for normal innovations.

    A lag that outlasts the record counts as an integrator does: not at all.
    """
    poles = np.abs(np.roots(np.concatenate(([1.0], -predictor))))
    longest = float(poles.max())
    if not 0.0 < longest < 1.0:
        return longest == 0.0
    lags = np.exp(candidate.theta[: len(candidate.problem.structure.shape)])
    own_s = float(lags[lags < candidate.problem.dataset.fitted_until_s].max(initial=0.0))
    lasts_s = -interval_s / math.log(longest)
    if lasts_s < FADES * (own_s or candidate.problem.dataset.span_s):
        return True
    beside = candidate.problem.memory is not None
    most_s = innovations.size * interval_s / FEWEST_LENGTHS if beside else FADES_WITH_PROCESS * own_s
    return lasts_s < most_s and normality(innovations) > SURE


def normality(values: FloatArray) -> float:
    """Return the probability that normal values are as skewed and as heavy-tailed (Jarque and Bera, Econ. Lett. 6)."""
    off = values - values.mean()
    variance = float(np.mean(off**2))
    if variance == 0.0:
        return 0.0
    skew, excess = float(np.mean(off**3)) / variance**1.5, float(np.mean(off**4)) / variance**2 - 3.0
    return chi2_tail(values.size / 6.0 * (skew**2 + excess**2 / 4.0), 2)


def _is_white(values: FloatArray) -> bool:
    r = autocorrelation(values, 2 * PAST)
    return chi2_tail(values.size * float(r @ r), r.size) > SURE


def _follows_output(context: FitContext, rows: IntArray, white: FloatArray) -> bool:
    """Return whether the outputs before it explain any of the innovations."""
    held, t = context.dataset.data.held, context.dataset.data.t[rows]
    output = held.levels[np.maximum(np.searchsorted(held.times, t, side="right") - 1, 0)]
    columns = np.column_stack([np.ones(output.size), *(np.roll(output, k) for k in range(1, PAST + 1))])[PAST:]
    past = white[PAST:] - white[PAST:].mean()
    kept = residual_after(columns, past)
    freedom = past.size - columns.shape[1]
    ratio = (float(past @ past) / max(float(kept @ kept), SMALLEST_DIVISOR) - 1.0) * freedom / PAST
    return f_tail(ratio, PAST, freedom) < SURE
