"""The catalogue of effects, by place."""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.core.diagnosis.catalogue.actuator import actuator_effects
from autotuner.core.diagnosis.catalogue.disturbance import disturbance_effects
from autotuner.core.diagnosis.catalogue.friction import friction_effects
from autotuner.core.diagnosis.catalogue.process import process_effects

if TYPE_CHECKING:
    from autotuner.core.arrays import FloatArray
    from autotuner.core.diagnosis.case import Case
    from autotuner.core.diagnosis.effect import Effect


def catalogue(case: Case, residual: FloatArray) -> tuple[Effect, ...]:
    """Return the effects that a recording could show, with starts taken from it.

    Parameters
    ----------
    case : Case
        The recording.
    residual : array of float, shape (N,)
        What the process model alone leaves at all samples: where a disturbance's starts come from.
    """
    return (
        *friction_effects(case),
        *actuator_effects(case),
        *process_effects(case),
        *disturbance_effects(case, residual),
    )
