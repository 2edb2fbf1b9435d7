"""A loop in its normal running, against what was expected of it."""

from typing import TYPE_CHECKING

from autotuner.core.on_demand import on_demand

if TYPE_CHECKING:
    from autotuner.core.monitoring.changes import Change, Expected, Findings
    from autotuner.core.monitoring.judge import findings
    from autotuner.core.monitoring.oscillation import Oscillation, oscillation_of
else:
    __getattr__ = on_demand(
        __name__,
        {
            "changes": "Change Expected Findings",
            "judge": "findings",
            "oscillation": "Oscillation oscillation_of",
        },
    )

__all__ = ["Change", "Expected", "Findings", "Oscillation", "findings", "oscillation_of"]
