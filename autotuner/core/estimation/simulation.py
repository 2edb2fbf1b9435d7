"""Simulation of a model on a recording: the PV to the recorded output, and the response from rest.

The model is given; offset, drift where the process does not settle, and initial state are fitted to the recording,
because the model does not contain them. The criterion of least squares selects them. Beyond the part to which it is
fitted, a drift continues only where it is known to be straight (`drifting`).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.estimation.backgrounds import background_columns, cheapest, counted
from autotuner.core.estimation.data import data_of
from autotuner.core.estimation.drift import choices_beside, choices_of, goes_straight_on
from autotuner.core.estimation.linear_least_squares import solve_linear
from autotuner.core.model.process import NLags, ThirdOrder, ThirdOrderUnderdamped
from autotuner.core.model.step_responses import (
    EqualLags,
    Integrator,
    Lag,
    LaggedIntegrator,
    Motion,
    Pair,
    PairAndLag,
    UnstableLag,
)
from autotuner.core.model.zoh_input import HeldInput

if TYPE_CHECKING:
    from autotuner.core.model.arrays import BoolArray, FloatArray
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Recording


def simulate_fit(
    model: ProcessModel, recording: Recording, fitted_until_s: float = math.inf, counts: BoolArray | None = None
) -> FloatArray:
    """Return the PV that a model gives on the recorded output, with offset and initial state fitted.

    Parameters
    ----------
    model : ProcessModel
        The process.
    recording : Recording
        Output and PV.
    fitted_until_s : float
        Time up to which offset and initial state are fitted, s; beyond it they are carried on.
    counts : array of bool, shape (N,), optional
        Samples that they are fitted to; all by default.

    Returns
    -------
    array of float, shape (N,)
        Simulated PV at the recording's times, PV units; for a recording that begins in the middle of a motion, the
        measured PV over the first dead time, in which it answers to an output that is not recorded.
    """
    data = data_of(recording)
    motion, gains = motion_of(model, data.span_s)
    when = data.t - model.D
    forced_pv: FloatArray = np.stack(motion.forced(data.held, when)[0], axis=1) @ gains
    counting = data.weight if counts is None else data.weight * counts
    fitted = np.where(recording.t <= fitted_until_s, counting, 0.0)
    background_data = replace(data, pv=data.pv - forced_pv).weighted(fitted)
    choices = choices_beside(motion, model.D, background_data, choices_of(data, model.rational().a[0]))
    background = cheapest(background_data, motion, model.D, choices)
    columns = np.column_stack([column for column, _ in background_columns(data, motion, background, when)])
    weight = counted(background_data, background, model.D).weight
    _, coefficients = solve_linear(columns * weight[:, None], background_data.pv * weight)
    if "drift" in background and model.rational().a[0] > 0.0:
        place, fitted_rows = background.index("drift"), weight > 0.0
        slope_per_s = float(coefficients[place]) / data.span_s
        if not goes_straight_on(data, slope_per_s, (background_data.pv - columns @ coefficients)[fitted_rows]):
            columns[:, place] = np.minimum(columns[:, place], columns[fitted_rows, place].max())
    simulated: FloatArray = forced_pv + columns @ coefficients + (recording.pv - data.pv)
    return np.where(counted(data, background, model.D).weight == 0.0, recording.pv, simulated)


def response(model: ProcessModel, t: FloatArray, output: FloatArray, at: FloatArray | None = None) -> FloatArray:
    """Return the exact PV (deviation) of a process that was at rest before `t[0]`.

    Parameters
    ----------
    model : ProcessModel
        The process.
    t : array of float, shape (N,)
        Times, s, not decreasing; `output[k]` is held from `t[k]` to `t[k + 1]`, the last one for ever.
    output : array of float, shape (N,)
        Output, as deviation from the output before `t[0]`.
    at : array of float, shape (M,), optional
        Times at which the PV is wanted, s, none before `t[0]`; `t` by default.

    Returns
    -------
    array of float, shape (M,)
        PV, as deviation from the PV before `t[0]`.
    """
    changes = np.flatnonzero(np.diff(output, prepend=0.0))
    held = HeldInput(np.append(t[0], t[changes]), np.append(0.0, output[changes]))
    motion, gains = motion_of(model, float(t[-1] - t[0]))
    if isinstance(motion, UnstableLag):
        # `T w' = w + u` run forward from rest is a lag of `-T` on `-u`.
        motion, gains = Lag(-motion.T), -gains
    result: FloatArray = np.stack(motion.forced(held, (t if at is None else at) - model.D)[0], axis=-1) @ gains
    return result


def misfit(pv: FloatArray, simulated: FloatArray) -> tuple[float, float]:
    """Return root mean square of the residual, PV, and the fit `100 (1 - |e| / |pv - mean pv|)`, percent."""
    residual = float(np.linalg.norm(pv - simulated))
    deviation = float(np.linalg.norm(pv - pv.mean()))
    return residual / np.sqrt(pv.size), 100.0 * (1.0 - residual / deviation) if deviation > 0.0 else float("nan")


def motion_of(model: ProcessModel, span_s: float) -> tuple[Motion, FloatArray]:
    """Return the unit-gain motion of a model and the gains of its columns."""
    if isinstance(model, NLags):
        return EqualLags(model.T, round(model.n)), np.array([model.K])
    if isinstance(model, ThirdOrder):
        # The two lags nearest to each other are the pair, which may be equal; the remaining lag is separate.
        alone, *pair = (model.T1, model.T2, model.T3)
        if model.T1 / model.T2 < model.T2 / model.T3:
            *pair, alone = (model.T1, model.T2, model.T3)
        return PairAndLag(pair[0] * pair[1], pair[0] + pair[1], alone), np.array([model.K])
    if isinstance(model, ThirdOrderUnderdamped):
        return PairAndLag(model.m, model.n, model.T), np.array([model.K])
    r = model.rational()
    (b0, b1), (a0, a1, a2) = r.b, r.a
    if a0 < 0.0:
        return UnstableLag(a1, span_s), np.array([b0])
    if a0 == 0.0:
        return (LaggedIntegrator(a2) if a2 > 0.0 else Integrator()), np.array([b0])
    zero = b1 != 0.0
    return Lag(a1, zero) if a2 == 0.0 else Pair(a2, a1, zero), np.array([b0, b1] if zero else [b0])
