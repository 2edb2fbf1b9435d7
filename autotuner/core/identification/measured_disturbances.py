"""Measured disturbances: further recorded inputs of the PV, which are separated from the process.

    pv(t) = response to the output + background + sum_k gain_k w(t - D_k; lags of the process) driven by disturbance k

`gain_k` PV per unit of the disturbance, `D_k` its dead time, s. Each passes the process's own lags, as a load at
its input does, and as every input does in a state-space or ARX model with common poles. They are fitted together with
the process and then subtracted from the recording, so that every later step sees the response to the output alone.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.estimation.data import data_of
from autotuner.core.estimation.intervals.covariance import covariance_of_fit
from autotuner.core.estimation.simulation import motion_of
from autotuner.core.identification.result import Disturbance
from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from autotuner.core.estimation.candidate import Candidate
    from autotuner.core.estimation.data import Data
    from autotuner.core.identification.result import Identification
    from autotuner.core.identification.selection import Choice
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Recording

SILENT = "the PV shows no answer to {}: it was left out"
"""What is said of a disturbance that does nothing."""


def moving(recording: Recording, names: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the disturbances that move in this recording, and notes on those that do not.

    Raises
    ------
    InputError
        A name that is not a further column of the recording, or a column with cells that are not numbers.
    """
    for name in names:
        if name not in recording.extra or not np.all(np.isfinite(recording.extra[name])):
            known = ", ".join(recording.extra) or "none"
            raise InputError(
                "is not a column of numbers in this recording",
                field="disturbance",
                value=name,
                remedy=f"Its further columns are: {known}.",
            )
    still = [name for name in names if np.ptp(recording.extra[name]) == 0.0]
    notes = tuple(f"{name} never moves: nothing about it can be determined" for name in still)
    return tuple(name for name in names if name not in still), notes


def disturbances_of(best: Candidate, names: Sequence[str]) -> tuple[Disturbance, ...]:
    """Return the results of a fit, in the order of the disturbances of `data_of`."""
    problem, theta = best.solution.problem, best.solution.theta
    count = len(problem.data.others)
    if not count:
        return ()
    error = np.sqrt(np.diag(covariance_of_fit(best.solution, best.inflation)))
    rows = zip(
        names,
        problem.linear(theta)[-count:].tolist(),
        error[-count:].tolist(),
        problem.other_delays(theta).tolist(),
        (problem.delay_unit_s * error[theta.size - count : theta.size]).tolist(),
        strict=True,
    )
    return tuple(Disturbance(*row) for row in rows)


def answering(
    chosen: Callable[[Sequence[str]], tuple[Data, Choice | None]], names: Sequence[str], recording: Recording
) -> tuple[Data, Choice | None, tuple[Disturbance, ...], Recording]:
    """Choose with the disturbances named, then without those that the PV does not answer to.

    Returns
    -------
    data, choice
        With the remaining disturbances.
    disturbances : tuple of Disturbance
        What these do.
    recording : Recording
        Without the answers to them, and with notes on those that were left out.
    """
    data, choice = chosen(names)
    found = () if choice is None else disturbances_of(choice.best, names)
    silent = [one.name for one in found if not one.shows]
    if choice is None:
        return data, None, (), recording
    if not silent:
        return data, choice, found, without_disturbances(recording, choice.best.model, found)
    notes = tuple(SILENT.format(name) for name in silent)
    noted = replace(recording, notes=(*recording.notes, *notes))
    return answering(chosen, [name for name in names if name not in silent], noted)


def unnamed(refusal: Identification, names: Sequence[str], alone: Identification) -> Identification:
    """Return the identification without the named disturbances, where naming them led to a refusal.

    A slowly varying column, such as the ambient temperature, can replace a slow response to the output, which then has
    no response left. The identification without the column remains valid, with a warning.

    Parameters
    ----------
    refusal : Identification
        With the disturbances named.
    names : sequence of str
        The disturbances.
    alone : Identification
        Without them.
    """
    if alone.model is None:
        return refusal
    columns = " and ".join(names)
    note = (
        f"identified without {columns}: with it the recording gives no model ({refusal.verdict.code}), for it could "
        "explain the PV in place of the output; move the output by more, or more often, to separate the two"
    )
    return replace(alone, warnings=(note, *alone.warnings))


def without_disturbances(recording: Recording, model: ProcessModel, disturbances: Sequence[Disturbance]) -> Recording:
    """Return a recording with the answers to measured disturbances taken out of its PV.

    Parameters
    ----------
    recording : Recording
        The record they were found in, or a longer one.
    model : ProcessModel
        The process, whose lags the disturbances pass.
    disturbances : sequence of Disturbance
        What is taken out.
    """
    if not disturbances:
        return recording
    data = data_of(recording, [one.name for one in disturbances])
    motion, _ = motion_of(model, data.span_s)
    answer = sum(
        one.gain * motion.forced(held, data.t - one.D)[0][0]
        for one, held in zip(disturbances, data.others, strict=True)
    )
    return replace(recording, pv=recording.pv - answer)
