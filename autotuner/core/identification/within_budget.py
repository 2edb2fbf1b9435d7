"""Identification on a controller without the time for least squares: the learned correction's answer, or a better one.

The learned correction answers first. Least squares has the rest of the time; where that does not suffice, the learned
model is the recommended one, with its calibrated errors.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.estimation.data import TimeSpentError
from autotuner.core.estimation.simulation import misfit, simulate_fit
from autotuner.core.experiment.parallel_controller import relay_part
from autotuner.core.identification import advice
from autotuner.core.identification.learned.correction import BESIDE, GAIN_UNKNOWN, LEARNED, LearnedModels, by_learned
from autotuner.core.identification.learned.gain_by_record import gain_by_record
from autotuner.core.identification.limit_cycle.relay_harmonics import process_sign
from autotuner.core.identification.procedure import identify
from autotuner.core.identification.result import Fit, Identification, refuse, share_unexplained
from autotuner.core.notes import Note
from autotuner.core.signals.limit_cycle import measure_limit_cycle
from autotuner.core.signals.noise import noise_sigma, quantisation
from autotuner.core.verdict import refused

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.core.identification.result import Estimate
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Recording
    from autotuner.core.verdict import Verdict

NOT_LEAST_SQUARES = "the time did not suffice for least squares: the model is the learned correction's"
MORE_TIME = "For a closer model and better gains give more time, or have `autotuner identify` read the recording."


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
    quick = learned_estimate(recording, recording, structure, known_gain, learned)
    try:
        return identify(recording, structure, known_gain, learned=learned, is_spent=is_spent)
    except TimeSpentError:
        return learned_alone(recording, quick)


def learned_estimate(
    relay: Recording,
    shown: Recording,
    structure: str = "auto",
    known_gain: float | None = None,
    learned: LearnedModels | str | None = None,
) -> Estimate:
    """Return the learned correction's estimate of a relay part; a gain that it does not show is from the whole record.

    Parameters
    ----------
    relay : Recording
        The relay part.
    shown : Recording
        The relay part, and the check after it where there is one.
    structure, known_gain, learned
        As in `identify`.
    """
    if relay_part(relay) is not None:
        return refuse(LEARNED, BESIDE)
    gain = None if known_gain is None else (known_gain, 0.0)
    wanted, sign = None if structure == "auto" else structure, process_sign(relay)
    quick = by_learned(relay, wanted, gain, learned, sign)
    if quick.refusal != GAIN_UNKNOWN or not isinstance(learned, LearnedModels):
        return quick
    return by_learned(relay, wanted, gain_by_record(relay, shown, wanted, learned, sign), learned, sign)


def learned_alone(recording: Recording, estimate: Estimate) -> Identification:
    """Return the identification of a recording that had time for the learned estimate only."""
    cycle, sigma = measure_limit_cycle(recording), noise_sigma(recording.pv)
    if estimate.model is None:
        verdict = refused(
            "budget_spent",
            f"the time did not suffice for least squares, and the learned correction has no answer: {estimate.refusal}",
            f"Give the structure, or the static gain where it is known. {MORE_TIME}",
        )
        return Identification(None, cycle, {LEARNED: estimate}, None, verdict, Fit(noise_sigma=sigma), recording.notes)
    rmse, percent = misfit(recording.pv, simulate_fit(estimate.model, recording))
    covariance = np.diag([estimate.standard_error.get(name, 0.0) ** 2 for name in estimate.model.parameters()])
    calibrated = replace(estimate, covariance=covariance, rmse=rmse, fit_percent=percent)
    return Identification(
        model=estimate.model,
        limit_cycle=cycle,
        estimates={LEARNED: calibrated},
        recommended=LEARNED,
        verdict=_found(estimate.model, percent),
        fit=Fit(rmse, percent, sigma, share_unexplained(rmse, sigma, recording.pv), quantisation(recording.pv)),
        warnings=(*recording.notes, Note(f"{NOT_LEAST_SQUARES}, with its calibrated errors")),
        recording=recording,
    )


def _found(model: ProcessModel, percent: float) -> Verdict:
    """Return the verdict of a success that is to be improved on."""
    found = advice.found(model, percent)
    return replace(found, message=f"{found.message}; {NOT_LEAST_SQUARES}", remedy=MORE_TIME)
