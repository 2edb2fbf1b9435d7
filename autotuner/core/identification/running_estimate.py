"""Running estimate: a quick model of the record so far, after each half period of the relay.

    explained   rms residual <= MISFIT times the noise at rest, coloured or not, or FLOOR times the swing of the PV
    error       largest of  se(K)/|K|,  se(m)/m,  se(other times)/(their sum)

The simplest structure that explains the PV is taken; a lag that may as well be nothing so does not spoil the error of
the others, because time constants are judged against their sum (the average residence time). It feeds the stop of the
relay, and the live view. The learned correction answers before it, from the oscillation alone. It counts for the stop
on the same condition, that it explains the PV.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from autotuner.core.estimation.data import data_of
from autotuner.core.estimation.initial_guesses import starts_from
from autotuner.core.estimation.least_squares import fit
from autotuner.core.estimation.simulation import misfit, simulate_fit
from autotuner.core.identification.crossover_uncertainty import expected_loss
from autotuner.core.identification.held_out import wander_at_rest
from autotuner.core.identification.learned.correction import LEARNED, by_learned
from autotuner.core.identification.limit_cycle.relay_harmonics import process_sign
from autotuner.core.identification.result import RunningModel
from autotuner.core.model.structures import FOPDT, PURE_INTEGRATOR, SECOND_ORDER
from autotuner.core.signals.noise import noise_sigma as sigma_of
from autotuner.core.signals.noise import resolution

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.identification.learned.correction import LearnedModels
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Recording

CANDIDATES = (FOPDT, PURE_INTEGRATOR, SECOND_ORDER)
"""Structures in the order in which they are tried."""
MOST_SAMPLES = 400
"""Most samples of the running fit, which has to end before the next sample."""
MISFIT = 1.2
"""Rms residual over the noise up to which the model explains the record; chance alone reaches 1.1 at 50 samples."""
UNSURE = 1.5
"""Noise in the whole record that is accepted, in noise at rest: fifty samples determine it to a seventh only."""
FLOOR = 3e-3
"""Rms residual over the swing up to which a model explains a record without noise."""


def running_model(
    recording: Recording, noise_sigma: float, begun: ProcessModel | None = None, *, nearest: bool = False
) -> RunningModel | None:
    """Return a quick model, or None while none explains the PV to within its noise.

    Parameters
    ----------
    recording : Recording
        Samples so far; more than `MOST_SAMPLES` are decimated.
    noise_sigma : float
        Noise measured at rest, PV units.
    begun : ProcessModel, optional
        Where the search starts: the model of the half period before, or the learned correction. Without it, or where
        no structure explains the PV from there, the starts are those of a scan.
    nearest : bool
        Whether the nearest model is returned where none explains the PV; its `explains` is false then, and its errors
        are not known.
    """
    data, closest = data_of(recording).thinned(MOST_SAMPLES), None
    step, allowed = resolution(recording.pv), _allowed(recording, noise_sigma)
    for model in (None,) if begun is None else (begun, None):
        for structure in CANDIDATES:
            candidate = fit(data, structure, resolution=step, starts=starts_from(model, structure))
            if candidate is not None and candidate.rmse <= allowed:
                found = candidate.uncertainty(profile=False)
                error = relative_error(candidate.model.parameters(), found.standard_error)
                loss = expected_loss(candidate.model, found.covariance)
                return RunningModel(candidate.model, found.standard_error, error, expected_loss=loss)
            if candidate is not None and (closest is None or candidate.rmse < closest.rmse):
                closest = candidate
    return RunningModel(closest.model, {}, math.inf, explains=False) if nearest and closest is not None else None


def running_learned(
    recording: Recording, noise_sigma: float, models: LearnedModels, gain: tuple[float, float] | None
) -> RunningModel | None:
    """Return the learned correction's model of the most similar structure, or None.

    Parameters
    ----------
    recording : Recording
        Samples so far.
    noise_sigma : float
        Noise measured at rest, PV units.
    models : LearnedModels
        What was trained.
    gain : (float, float) or None
        Static gain and its standard error so far, for an oscillation that does not determine it.
    """
    estimate = by_learned(recording, None, None, models, process_sign(recording), gain)
    if estimate.model is None:
        return None
    rmse, _ = misfit(recording.pv, simulate_fit(estimate.model, recording))
    errors = estimate.standard_error
    error = relative_error(estimate.model.parameters(), errors)
    return RunningModel(estimate.model, errors, error, LEARNED, rmse <= _allowed(recording, noise_sigma))


def _allowed(recording: Recording, noise_sigma: float) -> float:
    """Return the largest root mean square of a residual that is noise."""
    noise = max(noise_sigma, min(sigma_of(recording.pv), UNSURE * noise_sigma), wander_at_rest(recording))
    swing = float(recording.pv.max() - recording.pv.min())
    return max(MISFIT * math.hypot(noise, resolution(recording.pv) / math.sqrt(12.0)), FLOOR * swing)


def relative_error(values: Mapping[str, float], errors: Mapping[str, float]) -> float:
    """Return the largest relative standard error, time constants against their sum."""
    total = sum(abs(value) for name, value in values.items() if name not in {"K", "m"})
    scales = {name: abs(value) if name in {"K", "m"} else total for name, value in values.items()}
    return max(errors[name] / scales[name] for name in values)
