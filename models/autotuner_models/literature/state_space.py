"""Relay with hysteresis and the exact state-space equations of its limit cycle.

    x(t + Pu) = x(t),   y = PV at which the relay switched, one dead time before the input turns

solved for the process; see `identification.closed_form` and `identification.inverse_cycle`, which hold the equations.
Source: Majhi and Atherton, IEE Proc. Control Theory Appl. 146 (1999); the thesis cites Bajrangbali et al. for it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.core.identification.limit_cycle.closed_form import fopdt_of_cycle
from autotuner.core.identification.limit_cycle.inverse_cycle import sopdt_of_cycle
from autotuner_models.literature.trial import FOPDT, HYSTERESIS, SOPDT, Method

if TYPE_CHECKING:
    from autotuner.core.model.process import ProcessModel
    from autotuner_models.literature.trial import Trial


def estimate(trial: Trial) -> ProcessModel:
    """Return the process whose exact limit cycle this is."""
    cycle = trial.cycle(HYSTERESIS)
    return fopdt_of_cycle(trial.K, cycle) if trial.first_order else sopdt_of_cycle(trial.K, cycle)


METHOD = Method("state_space", "Hysteresis relay, state space (Majhi, Atherton)", FOPDT + SOPDT, estimate, finds=("D",))
