"""Diagnosis: effects that a recording shows and a model lacks (residual, named effect, error before and after)."""

from typing import TYPE_CHECKING

from autotuner.core.lazy_imports import lazy_names

if TYPE_CHECKING:
    from autotuner.core.diagnosis.findings.result import Diagnosis, FoundEffect, Misfit
    from autotuner.core.diagnosis.procedure import diagnose
else:
    __getattr__ = lazy_names(
        __name__,
        {
            "autotuner.core.diagnosis.procedure": "diagnose",
            "autotuner.core.diagnosis.findings.result": "Diagnosis FoundEffect Misfit",
        },
    )

__all__ = ["Diagnosis", "FoundEffect", "Misfit", "diagnose"]
