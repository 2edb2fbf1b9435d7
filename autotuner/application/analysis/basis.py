"""Reports the basis of the gains of an identified process."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from autotuner.core.design import Basis, known_within, noise_of

if TYPE_CHECKING:
    from autotuner.core.design import DeviceController
    from autotuner.core.identification import Identification


def basis_of(
    identification: Identification,
    sample_time_s: float = 0.0,
    *,
    interval_s: float = 0.0,
    device: DeviceController | None = None,
    output_span: float = math.inf,
) -> Basis:
    """Return the basis of the gains for an identified process; parameters as in `analysis.gains_for`."""
    assert identification.model is not None  # noqa: S101 - asked by the caller
    estimate = identification.estimates.get(identification.recommended or "")
    covariance, known_as = (None, None)
    if estimate is not None and estimate.model is not None:
        covariance, known_as = known_within(estimate.model, estimate.covariance, estimate.pair_covariance)
    fit, every_s = identification.fit, interval_s or sample_time_s
    noise = noise_of(fit.noise_sigma, fit.rmse, every_s, fit.resolution)
    scan_s = (device.scan_s if device else 0.0) or sample_time_s
    return Basis(identification.model, covariance, scan_s, noise, known_as, device, output_span)
