"""Estimators: from a recording to process models with their errors."""

from autotuner.core.identification.disturbances import Disturbance, without_disturbances
from autotuner.core.identification.identify import identify
from autotuner.core.identification.points import FrequencyPoint
from autotuner.core.identification.result import Estimate, Fit, Identification
from autotuner.core.identification.running import RunningModel, running_learned, running_model
from autotuner.core.identification.simulate import simulate_fit
from autotuner.core.signals.limit_cycle import LimitCycle, measure_limit_cycle

__all__ = [
    "Disturbance",
    "Estimate",
    "Fit",
    "FrequencyPoint",
    "Identification",
    "LimitCycle",
    "RunningModel",
    "identify",
    "measure_limit_cycle",
    "running_learned",
    "running_model",
    "simulate_fit",
    "without_disturbances",
]
