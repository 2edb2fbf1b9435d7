"""Estimators: from a recording to process models with their errors."""

from autotuner.core.identification.result import Estimate, Fit, Identification, LimitCycle

__all__ = ["Estimate", "Fit", "Identification", "LimitCycle"]
