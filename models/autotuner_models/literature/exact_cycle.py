"""The exact equations of a limit cycle, solved for the process.

    ideal relay, first order     A = K h (1 - e^{-D/T}),   Pu = 2 T ln(2 e^{D/T} - 1)
    relay with hysteresis        x(t + Pu) = x(t),   y = PV at which the relay switched, one dead time before the input
                                 turns

The first are solved for D and T without iteration. The thesis cites Gerov for a solution by Lambert's W; given the same
amplitude and period, every solution of these equations is the same process. Source of the second: Majhi and Atherton,
IEE Proc. Control Theory Appl. 146 (1999); the thesis cites Bajrangbali et al. for it. The formulas are in
`autotuner_models.first_order_cycle` and in `autotuner.core.identification.limit_cycle.inverse_cycle`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.core.identification.limit_cycle.inverse_cycle import sopdt_of_cycle
from autotuner_models.first_order_cycle import fopdt_of_cycle, fopdt_symmetric
from autotuner_models.literature.trial import FOPDT, HYSTERESIS, SOPDT, SYMMETRIC, Method

if TYPE_CHECKING:
    from autotuner.core.model.process import ProcessModel
    from autotuner_models.literature.trial import Trial


def closed_form(trial: Trial) -> ProcessModel:
    """Return the first-order process of peak and period."""
    cycle = trial.cycle(SYMMETRIC)
    return fopdt_symmetric(trial.K, cycle.h, cycle.A, cycle.Pu)


def state_space(trial: Trial) -> ProcessModel:
    """Return the process whose exact limit cycle this is."""
    cycle = trial.cycle(HYSTERESIS)
    return fopdt_of_cycle(trial.K, cycle) if trial.first_order else sopdt_of_cycle(trial.K, cycle)


CLOSED_FORM = Method("closed_form", "Closed form of the cycle", FOPDT, closed_form)
STATE_SPACE = Method(
    "state_space", "Hysteresis relay, state space (Majhi, Atherton)", FOPDT + SOPDT, state_space, finds=("D",)
)
