"""A model on a recording: what the PV would have been, and its response from rest.

The model is given; offset, drift where the process does not settle, and initial state are fitted to the recording, for
they are not the model's to know. Which of them are needed is decided by the same criterion as in least squares. Beyond
the part they are fitted to, a drift is carried on only where it is known to go straight on (`drifting`).
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
    known: FloatArray = np.stack(motion.forced(data.held, when)[0], axis=1) @ gains
    counting = data.weight if counts is None else data.weight * counts
    fitted = np.where(recording.t <= fitted_until_s, counting, 0.0)
    left = replace(data, pv=data.pv - known).weighted(fitted)
    choices = choices_beside(motion, model.D, left, choices_of(data, model.rational().a[0]))
    background = cheapest(left, motion, model.D, choices)
    columns = np.column_stack([column for column, _ in background_columns(data, motion, background, when)])
    weight = counted(left, background, model.D).weight
    _, coefficients = solve_linear(columns * weight[:, None], left.pv * weight)
    if "drift" in background and model.rational().a[0] > 0.0:
        place, good = background.index("drift"), weight > 0.0
        slope_per_s = float(coefficients[place]) / data.span_s
        if not goes_straight_on(data, slope_per_s, (left.pv - columns @ coefficients)[good]):
            columns[:, place] = np.minimum(columns[:, place], columns[good, place].max())
    simulated: FloatArray = known + columns @ coefficients + (recording.pv - data.pv)
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
    left = float(np.linalg.norm(pv - simulated))
    moved = float(np.linalg.norm(pv - pv.mean()))
    return left / np.sqrt(pv.size), 100.0 * (1.0 - left / moved) if moved > 0.0 else float("nan")


def motion_of(model: ProcessModel, span_s: float) -> tuple[Motion, FloatArray]:
    """Return the unit-gain motion of a model and the gains of its columns."""
    if isinstance(model, NLags):
        return EqualLags(model.T, round(model.n)), np.array([model.K])
    if isinstance(model, ThirdOrder):
        # The two lags nearest to each other are the pair, which may be equal; the lag that is left has to be apart.
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
