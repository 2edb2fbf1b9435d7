"""The running estimate: a quick model of the record so far, asked for after each half period of the relay.

    explained   rms residual <= MISFIT times the noise, or FLOOR times the swing of the PV
    error       largest of  se(K)/|K|,  se(m)/m,  se(other times)/(their sum)

The simplest structure that explains the PV is taken; a lag that may as well be nothing so does not spoil the error of
the others, because time constants are judged against their sum (the average residence time). It feeds the stop of the
relay, and the eye of whoever watches.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from autotuner.core.identification.data import data_of
from autotuner.core.identification.least_squares import fit
from autotuner.core.identification.structures import FOPDT, PURE_INTEGRATOR, SECOND_ORDER
from autotuner.core.signals.noise import noise_sigma as sigma_of
from autotuner.core.signals.noise import resolution

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.process import ProcessModel
    from autotuner.core.recording import Recording

CANDIDATES = (FOPDT, PURE_INTEGRATOR, SECOND_ORDER)
"""Structures in the order in which they are tried."""
MOST_SAMPLES = 400
MISFIT = 1.2
UNSURE = 1.5
"""Noise in the whole record that is believed, in noise at rest: fifty samples tell it to a seventh only."""
FLOOR = 3e-3


@dataclass(frozen=True, slots=True)
class RunningModel:
    """A model of the record so far.

    Attributes
    ----------
    model : ProcessModel
        The simplest one that explains the PV.
    standard_error : mapping of str to float
        Of its parameters.
    relative_error : float
        The largest, see above.
    """

    model: ProcessModel
    standard_error: Mapping[str, float]
    relative_error: float


def running_model(recording: Recording, noise_sigma: float) -> RunningModel | None:
    """Return a quick model, or None while none explains the PV to within its noise.

    Parameters
    ----------
    recording : Recording
        The samples so far; those beyond `MOST_SAMPLES` are thinned out.
    noise_sigma : float
        Noise measured at rest, PV units.
    """
    data = data_of(recording).thinned(MOST_SAMPLES)
    step = resolution(recording.pv)
    noise = max(noise_sigma, min(sigma_of(recording.pv), UNSURE * noise_sigma))
    allowed = max(MISFIT * math.hypot(noise, step / math.sqrt(12.0)), FLOOR * float(data.pv.max() - data.pv.min()))
    for structure in CANDIDATES:
        candidate = fit(data, structure, resolution=step)
        if candidate is not None and candidate.rmse <= allowed:
            errors = candidate.uncertainty().standard_error
            return RunningModel(candidate.model, errors, relative_error(candidate.model.parameters(), errors))
    return None


def relative_error(values: Mapping[str, float], errors: Mapping[str, float]) -> float:
    """Return the largest relative standard error, time constants against their sum."""
    total = sum(abs(value) for name, value in values.items() if name not in {"K", "m"})
    scales = {name: abs(value) if name in {"K", "m"} else total for name, value in values.items()}
    return max(errors[name] / scales[name] for name in values)
