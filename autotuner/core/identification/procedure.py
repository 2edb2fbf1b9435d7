"""Identification of a recording: all estimators in parallel, the recommended one selected by evidence.

Order of preference: least squares, unless its misfit is not below those of the closed form and the describing function;
then the closed form, which has no bias of its own; then the describing function.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.estimation.data import GainPrior, data_of
from autotuner.core.estimation.decimate import condensed
from autotuner.core.estimation.disturbed_loop import with_disturbance
from autotuner.core.estimation.drift import levelled
from autotuner.core.estimation.noise.outliers import without_wild
from autotuner.core.estimation.prewhitening import remembered
from autotuner.core.estimation.simulation import misfit, simulate_fit
from autotuner.core.estimation.switch_times import shifts_of, with_moments
from autotuner.core.identification import advice, selection
from autotuner.core.identification.controller_inverse import controller_of, is_inverse
from autotuner.core.identification.crossover_uncertainty import TOO_VAGUE, response_error
from autotuner.core.identification.frequency_points import frequency_points
from autotuner.core.identification.frozen_samples import stuck_rows
from autotuner.core.identification.learned.correction import BESIDE, LEARNED, by_learned
from autotuner.core.identification.limit_cycle.from_cycle import by_closed_form, by_describing_function, static_gain
from autotuner.core.identification.limit_cycle.online_relay import controller_beside
from autotuner.core.identification.measured_disturbances import answering, moving, unnamed
from autotuner.core.identification.result import Estimate, Fit, Identification, refuse
from autotuner.core.identification.selection import MOMENTS, Choice, choose
from autotuner.core.model.structures import searched
from autotuner.core.signals.feedback import moves_all_the_time, process_sign, set_point_moves
from autotuner.core.signals.limit_cycle import measure_limit_cycle
from autotuner.core.signals.noise import noise_sigma, quantisation, resolution
from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from autotuner.core.estimation.candidate import Candidate
    from autotuner.core.estimation.data import Data
    from autotuner.core.identification.frequency_points import FrequencyPoint
    from autotuner.core.identification.frozen_samples import Stuck
    from autotuner.core.identification.learned.correction import LearnedModels
    from autotuner.core.identification.limit_cycle.from_cycle import Known
    from autotuner.core.identification.limit_cycle.online_relay import Beside
    from autotuner.core.model.arrays import BoolArray
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Recording
    from autotuner.core.signals.limit_cycle import LimitCycle
    from autotuner.core.verdict import Verdict

LEAST_SQUARES = "least_squares"
TRUST = (LEAST_SQUARES, "closed_form", "describing_function")
"""Estimates in the order in which they are preferred."""
CLEARLY_WORSE = 1.2
"""Residual of a preferred estimate over that of another at which it is passed over."""
CLEARLY_BETTER = 0.5
"""Ratio of the residuals without and with the frozen samples below which these are omitted."""
MOST_NOISE = 0.15
"""Share of the PV's motion that may be noise which remembers; more of it is something else that moved the PV."""


def identify(
    recording: Recording,
    structure: str = "auto",
    known_gain: float | None = None,
    moments: str = "auto",
    learned: LearnedModels | str | None = None,
    disturbances: Sequence[str] = (),
    is_spent: Callable[[], bool] | None = None,
    *,
    profile: bool = True,
) -> Identification:
    """Identify the process of a recording: relay test, step, random binary sequence or closed loop.

    Parameters
    ----------
    recording : Recording
        The samples.
    structure : str
        A structure of `autotuner.core.model.process`, or ``auto``.
    known_gain : float, optional
        The static gain when known, PV/output.
    moments : str
        When the output changed: ``exact`` at its samples, ``between`` them (a historian's record, sampled afterwards),
        or ``auto``, which leaves it to the record. One with the time of each write is exact.
    learned : LearnedModels or str, optional
        Trained corrections, or the reason for their absence.
    disturbances : sequence of str
        Names of the recording's further columns that move the PV too (another heater, the ambient temperature).
    is_spent : callable, optional
        Returns whether the time is spent; then the search ends with `TimeSpentError`.
    profile : bool
        Whether intervals are those of the profile likelihood where the covariance is not enough; quicker without.

    Returns
    -------
    Identification
        With a verdict; a recording that shows no process is refused there, with numbers and advice.

    Raises
    ------
    InputError
        Unknown structure, moments or disturbance, or a gain that is zero or not finite.
    """
    _require_understood(structure, known_gain, moments)
    how = (structure, known_gain, moments, learned)
    found = _identified(recording, *how, disturbances, is_spent, profile=profile)
    if found.model is not None or not disturbances:
        return found
    return unnamed(found, disturbances, _identified(recording, *how, (), is_spent, profile=profile))


def _identified(
    recording: Recording,
    structure: str,
    known_gain: float | None,
    moments: str,
    learned: LearnedModels | str | None,
    disturbances: Sequence[str],
    is_spent: Callable[[], bool] | None,
    *,
    profile: bool,
) -> Identification:
    named, still = moving(recording, disturbances)
    recording, wild = without_wild(condensed(replace(recording, notes=(*recording.notes, *still))))
    if verdict := advice.unusable(recording):
        return _refused(verdict, recording, None)
    beside = controller_beside(recording)
    step = resolution(recording.pv)
    prior = GainPrior(known_gain, process_sign(recording))
    stuck = stuck_rows(recording, step)
    counted = np.where(wild, 0.0, 1.0)

    def with_named(names: Sequence[str]) -> tuple[Data, Choice | None]:
        data = replace(data_of(recording, names), is_spent=is_spent).weighted(counted)
        return data, _chosen(data, stuck, lambda samples: choose(samples, structure, prior, step, moments))

    data, choice, found, recording = answering(with_named, named, recording)
    choice = _beside_a_load(choice, structure, recording, data, prior, step)
    level = recording if choice is None else levelled(recording, choice.best)
    cycle = measure_limit_cycle(level) if beside is None else beside.cycle
    if choice is None:
        return _refused(advice.no_fit(structure), recording, cycle)
    wrong, said = _doubts(structure, choice, recording, data, prior, step)
    if wrong is not None:
        return _refused(wrong, recording, cycle)
    recording = _as_answered(recording, choice, data)
    gain = static_gain(level, cycle, known_gain, choice.best.model)
    fitted = _fitted(choice.best, recording, data, prior, step)
    estimates = _estimates(recording, cycle, choice, _by_least_squares(choice, fitted, profile=profile), gain, beside)
    estimates[LEARNED] = _by_learned(level, estimates[LEAST_SQUARES], choice.best.counts, known_gain, beside, learned)
    warnings = (*said, *advice.warnings_about(recording, choice, estimates[LEAST_SQUARES], step, stuck))
    return replace(_answer(recording, cycle, choice, estimates, warnings, step), disturbances=found)


def _doubts(
    structure: str, choice: Choice, recording: Recording, data: Data, prior: GainPrior, step: float
) -> tuple[Verdict | None, tuple[str, ...]]:
    """Return a refusal where the recording shows no answer, or another one than requested; else the notes."""
    wrong, said = selection.beside_the_record(structure, choice, data, prior, step)
    if wrong is None and is_inverse(choice.best.model, controller_of(recording)):
        wrong = advice.controller_instead()
    if wrong is None and not choice.best.is_shown():
        wrong = advice.no_answer(recording, noise_sigma(recording.pv))
    return wrong, said


def _beside_a_load(
    choice: Choice | None, structure: str, recording: Recording, data: Data, prior: GainPrior, step: float
) -> Choice | None:
    """Return the process that predicts best where a closed loop has a load as large as the moves of its set point.

    Plain least squares lies between the process and the inverse of the controller there, often with the wrong sign.
    """
    in_loop = moves_all_the_time(recording) and set_point_moves(recording)
    if choice is None or not in_loop or advice.unexplained_share(choice.best, recording, step) <= MOST_NOISE:
        return choice
    found = with_disturbance([candidate for candidate, _ in choice.ranking], searched(structure), data, prior)
    return choice if found is None else Choice(found, ((found, 0.0),))


def _fitted(best: Candidate, recording: Recording, data: Data, prior: GainPrior, step: float) -> Candidate:
    """Return the chosen structure with its autoregressive noise, unless the residual is more than noise."""
    if best.memory or advice.unexplained_share(best, recording, step) > MOST_NOISE:
        return best
    behind = remembered(best, data, prior)
    return best if behind is None or advice.odd_output_before(behind, recording) is not None else behind


def _as_answered(recording: Recording, choice: Choice, data: Data) -> Recording:
    """Return the recording with the moments of the output's changes where they were estimated."""
    shifts = shifts_of(choice.best.solution, data)
    return recording if shifts is None else with_moments(recording, shifts)


def _chosen(data: Data, stuck: Stuck | None, choice_of: Callable[[Data], Choice | None]) -> Choice | None:
    """Return the choice of all samples, or without those of a stuck sensor where only the rest is explained."""
    choice = choice_of(data)
    explained = choice is not None and choice.best.white
    if stuck is None or explained or np.count_nonzero(~stuck.rows) < advice.FEWEST_SAMPLES:
        return choice
    other = choice_of(data.weighted(np.where(stuck.rows, 0.0, data.weight)))
    better = choice is None or (other is not None and other.best.rmse < CLEARLY_BETTER * choice.best.rmse)
    return other if better else choice


def _answer(
    recording: Recording,
    cycle: LimitCycle | None,
    choice: Choice,
    estimates: dict[str, Estimate],
    warnings: tuple[str, ...],
    step: float,
) -> Identification:
    """Return the recommended estimate with its notes, or a refusal where it is too uncertain."""
    if (error := _vagueness(estimates[LEAST_SQUARES])) > TOO_VAGUE:
        return replace(_refused(advice.too_vague(choice.best.model, error), recording, cycle), estimates=estimates)
    recommended = _recommended(estimates)
    chosen = estimates[recommended]
    unexplained = advice.unexplained_share(choice.best, recording, step)
    assert chosen.model is not None  # noqa: S101 - only estimates with a model are recommended
    return Identification(
        model=chosen.model,
        limit_cycle=cycle,
        estimates=estimates,
        recommended=recommended,
        verdict=advice.found(chosen.model, chosen.fit_percent),
        fit=Fit(chosen.rmse, chosen.fit_percent, noise_sigma(recording.pv), unexplained, quantisation(recording.pv)),
        warnings=warnings,
        points=() if cycle is None else _points(recording, cycle, chosen.model),
        recording=recording,
    )


def _require_understood(structure: str, known_gain: float | None, moments: str) -> None:
    searched(structure)
    if moments not in MOMENTS:
        raise InputError(
            "is not understood", field="moments", value=moments, remedy=f"Use one of {', '.join(MOMENTS)}."
        )
    if known_gain is not None and not (math.isfinite(known_gain) and known_gain != 0.0):
        raise InputError(
            "must be a finite number other than zero",
            field="known_gain",
            value=known_gain,
            remedy="Give PV per output.",
        )


def _points(recording: Recording, cycle: LimitCycle, model: ProcessModel) -> tuple[FrequencyPoint, ...]:
    return frequency_points(recording, cycle, model, simulate_fit(model, recording))


def _vagueness(estimate: Estimate) -> float:
    """Return the relative error of the response that a controller depends on; 0 where it cannot be determined."""
    if estimate.model is None or estimate.covariance is None:
        return 0.0
    return response_error(estimate.model, estimate.covariance)


def _estimates(
    recording: Recording,
    cycle: LimitCycle | None,
    choice: Choice,
    fitted: Estimate,
    gain: Known | None,
    beside: Beside | None,
) -> dict[str, Estimate]:
    assert fitted.model is not None  # noqa: S101 - the choice has one
    structure = fitted.model.structure
    estimates = (
        by_describing_function(cycle, gain, fitted.model, structure, beside=beside),
        by_closed_form(cycle, gain, structure, beside),
        fitted,
    )
    return {estimate.method: _simulated(estimate, recording, choice.best.counts) for estimate in estimates}


def _simulated(estimate: Estimate, recording: Recording, counts: BoolArray) -> Estimate:
    if estimate.model is None:
        return estimate
    simulated = simulate_fit(estimate.model, recording, counts=counts)
    rmse, percent = misfit(recording.pv[counts], simulated[counts])
    return replace(estimate, rmse=rmse, fit_percent=percent)


def _by_least_squares(choice: Choice, fitted: Candidate, *, profile: bool) -> Estimate:
    """Return the fit of the chosen structure, with or without autoregressive noise, outside of the ranking."""
    best, errors = choice.best, fitted.uncertainty(profile=profile)
    return Estimate(
        LEAST_SQUARES,
        fitted.model,
        errors.standard_error,
        errors.interval95,
        errors.covariance,
        evidence={
            "background": list(fitted.solution.problem.background),
            "residual_inflation": best.inflation,
            "noise_memory": fitted.memory,
            "outliers": best.spikes,
            "profile_likelihood": list(errors.profiled),
            "moments_free": best.solution.problem.data.shaken is not None,
            "ranking": [
                {"structure": c.model.structure, "rmse": c.rmse, "above_best": above} for c, above in choice.ranking
            ],
        },
        pair_covariance=errors.pair_covariance,
    )


def _by_learned(
    recording: Recording,
    fitted: Estimate,
    counts: BoolArray,
    known_gain: float | None,
    beside: Beside | None,
    learned: LearnedModels | str | None,
) -> Estimate:
    assert fitted.model is not None  # noqa: S101 - the choice has one
    if beside is not None:
        return refuse(LEARNED, BESIDE)
    K, error = fitted.model.K, fitted.standard_error.get("K", 0.0)
    gain = None if known_gain is None else (known_gain, 0.0)
    estimate = by_learned(recording, fitted.model.structure, gain, learned, K, (K, error))
    return _simulated(estimate, recording, counts)


def _recommended(estimates: dict[str, Estimate]) -> str:
    usable = [name for name in TRUST if estimates[name].model is not None]
    lowest = min(estimates[name].rmse for name in usable)
    return next(name for name in usable if estimates[name].rmse <= CLEARLY_WORSE * lowest)


def _refused(verdict: Verdict, recording: Recording, cycle: LimitCycle | None) -> Identification:
    estimates = {name: refuse(name, verdict.message) for name in sorted((*TRUST, LEARNED))}
    sigma = Fit(noise_sigma=noise_sigma(recording.pv))
    return Identification(None, cycle, estimates, None, verdict, sigma, recording.notes)
