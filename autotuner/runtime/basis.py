"""What the gains of an identified process rest on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.process import InverseResponse, SopdtOverdamped
from autotuner.core.tuning import Basis, merged, noise_of

if TYPE_CHECKING:
    from autotuner.core.arrays import FloatArray
    from autotuner.core.identification import Identification
    from autotuner.core.identification.result import Estimate
    from autotuner.core.process import ProcessModel


def basis_of(identification: Identification, sample_time_s: float = 0.0, *, interval_s: float = 0.0) -> Basis:
    """Return what gains for an identified process rest on; parameters as in `analysis.gains_for`."""
    assert identification.model is not None  # noqa: S101 - asked by the caller
    estimate = identification.estimates.get(identification.recommended or "")
    covariance, known_as = (None, None) if estimate is None else known_within(estimate)
    fit, every_s = identification.fit, interval_s or sample_time_s
    noise = noise_of(fit.noise_sigma, fit.rmse, every_s)
    return Basis(identification.model, covariance, sample_time_s, noise, known_as)


def known_within(estimate: Estimate) -> tuple[FloatArray | None, ProcessModel | None]:
    """Return the covariance of an estimate, and the process by its parameters where those are not the model's."""
    if estimate.pair_covariance is not None and isinstance(estimate.model, SopdtOverdamped | InverseResponse):
        return _finite(estimate.pair_covariance), merged(estimate.model)
    return _finite(estimate.covariance), None


def _finite(covariance: FloatArray | None) -> FloatArray | None:
    return covariance if covariance is not None and bool(np.all(np.isfinite(covariance))) else None
