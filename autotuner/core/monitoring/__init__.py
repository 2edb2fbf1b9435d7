"""Monitoring: a loop in normal operation against the behaviour that its tuning predicted."""

from typing import TYPE_CHECKING

from autotuner.core.lazy_imports import lazy_names

if TYPE_CHECKING:
    from autotuner.core.monitoring.changes import Change, Expected, Findings
    from autotuner.core.monitoring.judge import findings
    from autotuner.core.monitoring.oscillation import Oscillation, oscillation_of
else:
    __getattr__ = lazy_names(
        __name__,
        {
            "autotuner.core.monitoring.changes": "Change Expected Findings",
            "autotuner.core.monitoring.judge": "findings",
            "autotuner.core.monitoring.oscillation": "Oscillation oscillation_of",
        },
    )

__all__ = ["Change", "Expected", "Findings", "Oscillation", "findings", "oscillation_of"]
