"""Selection of the extended model: the process with a named effect explains a record that the process alone does not.

The process of the extended model, as a controller sees it, replaces the identified one, with its own
intervals, under conditions:

1. The diagnosis explains the record, and the part that was not fitted confirms it.
2. The remaining residual is no larger a share of the motion than that of an accepted plain model.
3. The gain is known: half its 95 % interval is under `GAIN_KNOWN` of it. The response at the turnover frequency is
   known as well as a simple model requires.
4. A model represents the effects in the loop: gains that ignore an inverse response, or the weaker of two
   directions, would be wrong without a warning.
5. Where a simple model would be accepted but misses the held-out part, the effect removes at least half of that miss.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.findings.controller_view import controller_view
from autotuner.core.identification.advice import found
from autotuner.core.identification.crossover_uncertainty import TOO_VAGUE, response_error
from autotuner.core.identification.result import Estimate, Fit
from autotuner.core.notes import Doubt, Note
from autotuner.core.quantiles import NORMAL_95

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.diagnosis import Diagnosis
    from autotuner.core.diagnosis.findings.controller_view import ControllerView
    from autotuner.core.identification import Identification
    from autotuner.core.recording import Recording

IN_THE_GAINS = frozenset(
    {"inverse_response", "extra_lag", "slow_mode", "integrating", "sensor_quantisation", "output_quantisation"}
)
"""Effects that gains can be right for: where they are shown to hold, nothing has to be done."""
METHOD = "diagnosis"
GAIN_KNOWN = 0.25
"""Largest half of the 95 % interval of the static gain, as a share of it, with which the gain counts as known."""
LEAST_CONFIDENCE = 0.5
"""Least confidence of every effect."""
HALF = 0.5
"""Largest share of the prediction error after the effects: a design changes when at least half is explained."""


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
    if min(effect.confidence for effect in diagnosis.effects) < LEAST_CONFIDENCE:
        return False
    motion = float(np.std(recording.pv))
    parts = [diagnosis.error["fitted"], diagnosis.error["held_out"]]
    small = all(max(part.after**2 - part.expected**2, 0.0) < (most * motion) ** 2 for part in parts)
    return small and _is_known(diagnosis)


def halves_the_error(diagnosis: Diagnosis) -> bool:
    """Return whether the effects take half of the error on the part that was not fitted."""
    held = diagnosis.error["held_out"]
    return held.after <= HALF * held.before


def _is_known(diagnosis: Diagnosis) -> bool:
    view = _view_of(diagnosis)
    if view is None or view.covariance is None or not np.all(np.isfinite(view.covariance)):
        return False
    error = math.sqrt(max(float(view.covariance[0, 0]), 0.0))
    return (
        NORMAL_95 * error < GAIN_KNOWN * abs(view.model.K) and response_error(view.model, view.covariance) <= TOO_VAGUE
    )


def _view_of(diagnosis: Diagnosis) -> ControllerView | None:
    """Return the process as a controller sees it; None where no model represents it."""
    process = diagnosis.process
    return None if process is None else controller_view(process, diagnosis.covariance, diagnosis.effects)


def with_diagnosed_process(identification: Identification, diagnosis: Diagnosis) -> Identification:
    """Return an identification whose recommended model is the process of the diagnosis.

    The warnings about the other model do not hold for this one, so they are removed.
    """
    view = _view_of(diagnosis)
    assert view is not None  # noqa: S101 - it was asked before
    estimate = _estimate(view, diagnosis)
    return replace(
        identification,
        model=view.model,
        estimates={METHOD: estimate, **identification.estimates},
        recommended=METHOD,
        fit=Fit(
            estimate.rmse,
            estimate.fit_percent,
            diagnosis.error["fitted"].noise,
            resolution=identification.fit.resolution,
        ),
        warnings=(_summary(identification, diagnosis, view),),
        verdict=found(view.model, estimate.fit_percent),
    )


def _estimate(view: ControllerView, diagnosis: Diagnosis) -> Estimate:
    assert view.covariance is not None  # noqa: S101 - asked before
    errors = np.sqrt(np.maximum(np.diag(view.covariance), 0.0)).tolist()
    values: Mapping[str, float] = view.model.parameters()
    return Estimate(
        METHOD,
        view.model,
        standard_error=dict(zip(values, errors, strict=True)),
        interval95={
            n: (v - NORMAL_95 * s, v + NORMAL_95 * s) for (n, v), s in zip(values.items(), errors, strict=True)
        },
        covariance=view.covariance,
        rmse=diagnosis.error["fitted"].after,
        fit_percent=_fit_percent(diagnosis),
        evidence={"effects": [effect.to_dict() for effect in diagnosis.effects]},
    )


def _fit_percent(diagnosis: Diagnosis) -> float:
    traces = diagnosis.traces
    if traces is None:
        return float("nan")
    return 100.0 * (1.0 - diagnosis.error["fitted"].after / float(np.std(traces.pv)))


def are_in_the_gains(diagnosis: Diagnosis) -> bool:
    """Return whether gains can be right for all the effects that were found."""
    return all(effect.name in IN_THE_GAINS for effect in diagnosis.effects)


def _summary(identification: Identification, diagnosis: Diagnosis, view: ControllerView) -> str:
    """Return the note on the origin of this process."""
    names = " and ".join(effect.name for effect in diagnosis.effects)
    held = diagnosis.error["held_out"]
    parts = (
        f"the process alone ({identification.structure}) does not explain the record; with {names} the error on the "
        f"part that was not fitted falls from {held.before:.3g} to {held.after:.3g}: process and gains are those of "
        "that extended model" + "".join(f"; {parts}" for parts in view.changes)
    )
    if diagnosis.disturbances_alone:
        return Note(parts)
    return Doubt(parts) if are_in_the_gains(diagnosis) else parts
