"""Identification on a controller without the time for least squares: the learned correction's answer, or a better one.

The learned correction answers first, in about two milliseconds. Least squares has the rest of the time; where that does
not suffice, the learned model is the recommended one, with its calibrated errors.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.estimation.data import TimeSpentError
from autotuner.core.estimation.simulation import misfit, simulate_fit
from autotuner.core.identification import advice
from autotuner.core.identification.learned import LEARNED, by_learned
from autotuner.core.identification.limit_cycle.relay_harmonics import process_sign
from autotuner.core.identification.procedure import identify
from autotuner.core.identification.result import Fit, Identification
from autotuner.core.notes import Note
from autotuner.core.signals.limit_cycle import measure_limit_cycle
from autotuner.core.signals.noise import noise_sigma, quantisation
from autotuner.core.verdict import refused

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.core.identification.learned import LearnedModels
    from autotuner.core.identification.result import Estimate
    from autotuner.core.recording import Recording

NOT_LEAST_SQUARES = "the time did not suffice for least squares: the model is the learned correction's"


def identify_within(
    recording: Recording,
    is_spent: Callable[[], bool],
    structure: str = "auto",
    known_gain: float | None = None,
    learned: LearnedModels | str | None = None,
) -> Identification:
    """Return the identification that the time allows.

    Parameters
    ----------
    recording : Recording
        The samples of a relay test.
    is_spent : callable
        Returns whether the time is spent.
    structure, known_gain, learned
        As in `identify`.
    """
    gain = None if known_gain is None else (known_gain, 0.0)
    wanted = None if structure == "auto" else structure
    quick = by_learned(recording, wanted, gain, learned, process_sign(recording))
    try:
        return identify(recording, structure, known_gain, learned=learned, is_spent=is_spent)
    except TimeSpentError:
        return _learned_alone(recording, quick)


def _learned_alone(recording: Recording, estimate: Estimate) -> Identification:
    cycle, sigma = measure_limit_cycle(recording), noise_sigma(recording.pv)
    if estimate.model is None:
        verdict = refused(
            "budget_spent",
            f"the time did not suffice for least squares, and the learned correction has no answer: {estimate.refusal}",
            "Give more time, or the static gain.",
        )
        return Identification(None, cycle, {LEARNED: estimate}, None, verdict, Fit(noise_sigma=sigma), recording.notes)
    rmse, percent = misfit(recording.pv, simulate_fit(estimate.model, recording))
    covariance = np.diag([estimate.standard_error.get(name, 0.0) ** 2 for name in estimate.model.parameters()])
    told = replace(estimate, covariance=covariance, rmse=rmse, fit_percent=percent)
    return Identification(
        model=estimate.model,
        limit_cycle=cycle,
        estimates={LEARNED: told},
        recommended=LEARNED,
        verdict=advice.found(estimate.model, percent),
        fit=Fit(rmse, percent, sigma, _unexplained(rmse, sigma, recording), quantisation(recording.pv)),
        warnings=(*recording.notes, Note(NOT_LEAST_SQUARES)),
        recording=recording,
    )


def _unexplained(rmse: float, sigma: float, recording: Recording) -> float:
    moved = float(np.std(recording.pv))
    return math.sqrt(max(rmse**2 - sigma**2, 0.0)) / moved if moved > 0.0 else 0.0
