"""A loop in its normal running, against what was expected of it."""

from autotuner.core.monitoring.findings import Change, Findings
from autotuner.core.monitoring.judge import Expected, findings
from autotuner.core.monitoring.oscillation import Oscillation, oscillation_of

__all__ = ["Change", "Expected", "Findings", "Oscillation", "findings", "oscillation_of"]
