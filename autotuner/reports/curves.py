"""Curves for display: measurement against model, and predicted responses.

Invariants: a curve is decimated by its lowest and highest PV in every interval, so that its picture
equals that of the full curve; models and loops are simulated by the core, never here.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.design.simulation.closed_loop_setup import PLAIN, Installed, response_time_s, responses
from autotuner.core.identification import simulate_fit
from autotuner.core.jsonable import jsonable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.core.design import PidGains
    from autotuner.core.diagnosis.findings.result import Traces
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Recording

MOST = 4000
"""Most points of a curve by default."""
POINTS = 600
"""Points of a predicted response."""


def kept(values: FloatArray, most: int = MOST) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """Return ascending indices of at most `most` samples whose picture equals that of all samples.

    Parameters
    ----------
    values : array of float, shape (N,)
        What is drawn.
    most : int
        At least 4.
    """
    if values.size <= most:
        return np.arange(values.size)
    edges = np.linspace(0, values.size, most // 2, dtype=np.intp)
    stretches = list(pairwise(edges))
    lowest = [low + int(np.argmin(values[low:high])) for low, high in stretches]
    highest = [low + int(np.argmax(values[low:high])) for low, high in stretches]
    return np.unique(np.array([0, *lowest, *highest, values.size - 1], dtype=np.intp))


def fit_curves(
    recording: Recording, model: ProcessModel | None, most: int = MOST, fitted_until_s: float = math.inf
) -> dict[str, object]:
    """Return measured and simulated PV by columns, JSON-ready.

    `t_s` s, `output` output units, `pv`, `set_point`, `model` and `residual` (measured minus model) PV units;
    `set_point` is None where the loop was open, `model` and `residual` where no model is given. Offset and initial
    state of the model are those of the part up to `fitted_until_s`; the rest is predicted.
    """
    shown = kept(recording.pv, most)
    simulated = None if model is None else simulate_fit(model, recording, fitted_until_s)
    columns = {
        "t_s": recording.t,
        "output": recording.output,
        "pv": recording.pv,
        "set_point": recording.set_point,
        "model": simulated,
        "residual": None if simulated is None else recording.pv - simulated,
    }
    thinned = {name: None if column is None else jsonable(column[shown]) for name, column in columns.items()}
    return {**thinned, "settings": jsonable(dict(recording.settings))}


def before_and_after(traces: Traces, most: int = MOST) -> dict[str, object]:
    """Return measured PV and the simulated one without and with the effects that a diagnosis names, JSON-ready.

    `t_s` s, `output` output units, `pv`, `before`, `after` and the residuals PV units; samples after `held_out_from_s`
    was not fitted.
    """
    shown = kept(traces.pv, most)
    columns = {
        "t_s": traces.t,
        "output": traces.output,
        "pv": traces.pv,
        "before": traces.before,
        "after": traces.after,
        "residual_before": traces.pv - traces.before,
        "residual_after": traces.pv - traces.after,
    }
    thinned = {name: jsonable(column[shown]) for name, column in columns.items()}
    return {**thinned, "held_out_from_s": traces.held_out_from_s}


def loop_curves(
    model: ProcessModel, controllers: Sequence[PidGains], installed: Installed = PLAIN
) -> list[dict[str, object]]:
    """Return the predicted responses of the loop with each controller, over the same time, JSON-ready.

    Parameters
    ----------
    model : ProcessModel
        The process.
    controllers : sequence of PidGains
        The gains to compare.
    installed : Installed
        The loop: limits, effects, size of the steps.

    Returns
    -------
    list of dict
        `t_s` s; `step_pv`, `load_pv` PV units and `step_output`, `load_output` output units, deviations from rest;
        `set_point_step`, `load_step` their sizes; `effects` the names of those that take part.
    """
    duration_s = max((response_time_s(model, gains) for gains in controllers), default=model.D)
    return [_responses(model, gains, duration_s, installed) for gains in controllers]


def _responses(model: ProcessModel, gains: PidGains, duration_s: float, installed: Installed) -> dict[str, object]:
    moved, loaded = responses(model, gains, installed, duration_s)
    columns = {
        "step_pv": moved.pv,
        "step_output": moved.output,
        "load_pv": loaded.pv,
        "load_output": loaded.output,
    }
    # The controllers may be simulated in different steps; their curves share one time grid.
    t = np.linspace(0.0, duration_s, POINTS)
    return {
        "t_s": jsonable(t),
        **{name: jsonable(np.interp(t, moved.t, column)) for name, column in columns.items()},
        "set_point_step": installed.set_point_step,
        "load_step": installed.load_step,
        "effects": list(installed.foreseen),
    }
