"""Diagnosis: what a model lacks that a recording shows (residual, named effect, error before and after)."""

from typing import TYPE_CHECKING

from autotuner.core.on_demand import on_demand

if TYPE_CHECKING:
    from autotuner.core.diagnosis.diagnosing import diagnose
    from autotuner.core.diagnosis.result import Diagnosis, FoundEffect, Misfit
else:
    __getattr__ = on_demand(
        __name__,
        {
            "diagnosing": "diagnose",
            "result": "Diagnosis FoundEffect Misfit",
        },
    )

__all__ = ["Diagnosis", "FoundEffect", "Misfit", "diagnose"]
