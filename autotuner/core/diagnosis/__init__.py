"""Diagnosis: what a model lacks that a recording shows (residual, named effect, error before and after)."""

from autotuner.core.diagnosis.diagnose import diagnose
from autotuner.core.diagnosis.result import Diagnosis, FoundEffect, Misfit

__all__ = ["Diagnosis", "FoundEffect", "Misfit", "diagnose"]
