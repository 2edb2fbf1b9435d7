"""A record that the process alone does not explain, but the process with a named effect does.

The process of the extended model then takes the place of the identified one, with its own intervals, under conditions:

1. The diagnosis explains the record, and the part that was not fitted says the same.
2. What is left is no more of the motion than a plain model may leave.
3. The gain is known: half its 95 % interval is under `GAIN_KNOWN` of it.
4. Where a plain model would do, but misses the part that was not fitted, the effect takes half of that miss at least.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.identification.advice import found
from autotuner.core.identification.result import Estimate, Fit

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.diagnosis import Diagnosis
    from autotuner.core.identification import Identification
    from autotuner.core.process import ProcessModel
    from autotuner.core.recording import Recording

METHOD = "diagnosis"
GAIN_KNOWN = 0.25
SURE_ENOUGH = 0.5
"""Least confidence of every effect."""
NORMAL_95 = 1.96
HALF = 0.5


def gives_a_process(diagnosis: Diagnosis, recording: Recording, most: float) -> bool:
    """Return whether a diagnosis explains a record so well that gains may rest on its process.

    Parameters
    ----------
    diagnosis : Diagnosis
        What was found.
    recording : Recording
        The record.
    most : float
        Share of the PV's motion, beyond noise, that may be left unexplained.
    """
    if diagnosis.verdict != "explained" or not diagnosis.effects or diagnosis.process is None:
        return False
    if min(effect.confidence for effect in diagnosis.effects) < SURE_ENOUGH:
        return False
    motion = float(np.std(recording.pv))
    parts = [diagnosis.error["fitted"], diagnosis.error["held_out"]]
    small = all(max(part.after**2 - part.noise**2, 0.0) < (most * motion) ** 2 for part in parts)
    return small and _gain_is_known(diagnosis.process, diagnosis)


def halves_the_error(diagnosis: Diagnosis) -> bool:
    """Return whether the effects take half of the error on the part that was not fitted."""
    held = diagnosis.error["held_out"]
    return held.after <= HALF * held.before


def _gain_is_known(process: ProcessModel, diagnosis: Diagnosis) -> bool:
    if diagnosis.covariance is None:
        return False
    names = list(process.parameters())
    error = float(np.sqrt(max(diagnosis.covariance[names.index("K"), names.index("K")], 0.0)))
    return NORMAL_95 * error < GAIN_KNOWN * abs(process.parameters()["K"])


def with_diagnosed_process(identification: Identification, diagnosis: Diagnosis) -> Identification:
    """Return an identification whose recommended model is the process of the diagnosis.

    What was said of the other model does not hold for this one, so its warnings go.
    """
    estimate = _estimate(diagnosis)
    assert estimate.model is not None  # noqa: S101 - it was asked before
    return replace(
        identification,
        model=estimate.model,
        estimates={METHOD: estimate, **identification.estimates},
        recommended=METHOD,
        fit=Fit(estimate.rmse, estimate.fit_percent, diagnosis.error["fitted"].noise),
        warnings=(_told(identification, diagnosis),),
        verdict=found(estimate.model, estimate.fit_percent),
    )


def _estimate(diagnosis: Diagnosis) -> Estimate:
    process = diagnosis.process
    assert process is not None  # noqa: S101 - asked before
    assert diagnosis.covariance is not None  # noqa: S101 - asked before
    errors = np.sqrt(np.maximum(np.diag(diagnosis.covariance), 0.0)).tolist()
    values: Mapping[str, float] = process.parameters()
    return Estimate(
        METHOD,
        process,
        standard_error=dict(zip(values, errors, strict=True)),
        interval95={
            n: (v - NORMAL_95 * s, v + NORMAL_95 * s) for (n, v), s in zip(values.items(), errors, strict=True)
        },
        covariance=diagnosis.covariance,
        rmse=diagnosis.error["fitted"].after,
        fit_percent=_fit_percent(diagnosis),
        evidence={"effects": [effect.to_dict() for effect in diagnosis.effects]},
    )


def _fit_percent(diagnosis: Diagnosis) -> float:
    traces = diagnosis.traces
    if traces is None:
        return float("nan")
    return 100.0 * (1.0 - diagnosis.error["fitted"].after / float(np.std(traces.pv)))


def _told(identification: Identification, diagnosis: Diagnosis) -> str:
    """Return what the reader has to know: where this process comes from."""
    names = " and ".join(effect.name for effect in diagnosis.effects)
    held = diagnosis.error["held_out"]
    return (
        f"the process alone ({identification.structure}) does not explain the record; with {names} the error on the "
        f"part that was not fitted falls from {held.before:.3g} to {held.after:.3g}: process and gains are those of "
        "that extended model"
    )
