"""Estimators: from a recording to process models with their errors."""

from typing import TYPE_CHECKING

from autotuner.core.on_demand import on_demand

if TYPE_CHECKING:
    from autotuner.core.identification.disturbances import Disturbance, without_disturbances
    from autotuner.core.identification.identifying import identify
    from autotuner.core.identification.points import FrequencyPoint
    from autotuner.core.identification.result import Estimate, Fit, Identification, RunningModel
    from autotuner.core.identification.running import running_learned, running_model
    from autotuner.core.identification.simulate import simulate_fit
    from autotuner.core.signals.limit_cycle import LimitCycle, measure_limit_cycle
else:
    __getattr__ = on_demand(
        __name__,
        {
            "disturbances": "Disturbance without_disturbances",
            "identifying": "identify",
            "points": "FrequencyPoint",
            "result": "Estimate Fit Identification RunningModel",
            "running": "running_learned running_model",
            "simulate": "simulate_fit",
            ".signals.limit_cycle": "LimitCycle measure_limit_cycle",
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
    "measure_limit_cycle",
    "running_learned",
    "running_model",
    "simulate_fit",
    "without_disturbances",
]
