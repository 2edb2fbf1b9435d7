"""Estimators: from a recording to process models with their errors."""

from typing import TYPE_CHECKING

from autotuner.core.lazy_imports import lazy_names

if TYPE_CHECKING:
    from autotuner.core.estimation.simulation import simulate_fit
    from autotuner.core.identification.frequency_points import FrequencyPoint
    from autotuner.core.identification.measured_disturbances import without_disturbances
    from autotuner.core.identification.procedure import identify
    from autotuner.core.identification.result import Disturbance, Estimate, Fit, Identification, RunningModel
    from autotuner.core.identification.running_estimate import running_learned, running_model
    from autotuner.core.identification.within_budget import identify_within
    from autotuner.core.signals.limit_cycle import LimitCycle, measure_limit_cycle
else:
    __getattr__ = lazy_names(
        __name__,
        {
            "autotuner.core.identification.measured_disturbances": "without_disturbances",
            "autotuner.core.identification.procedure": "identify",
            "autotuner.core.identification.frequency_points": "FrequencyPoint",
            "autotuner.core.identification.within_budget": "identify_within",
            "autotuner.core.identification.result": "Disturbance Estimate Fit Identification RunningModel",
            "autotuner.core.identification.running_estimate": "running_learned running_model",
            "autotuner.core.estimation.simulation": "simulate_fit",
            "autotuner.core.signals.limit_cycle": "LimitCycle measure_limit_cycle",
        },
    )

__all__ = [
    "Disturbance",
    "Estimate",
    "Fit",
    "FrequencyPoint",
    "Identification",
    "LimitCycle",
    "RunningModel",
    "identify",
    "identify_within",
    "measure_limit_cycle",
    "running_learned",
    "running_model",
    "simulate_fit",
    "without_disturbances",
]
