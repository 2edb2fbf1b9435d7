"""Closed form of the first-order limit cycle under an ideal relay.

    A = K h (1 - e^{-D/T}),   Pu = 2 T ln(2 e^{D/T} - 1)

solved for D and T without iteration (`identification.closed_form`). The thesis cites Gerov for a solution by Lambert's
W; given the same amplitude and period, every solution of these equations is the same process.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.core.identification.limit_cycle.closed_form import fopdt_symmetric
from autotuner_models.literature.trial import FOPDT, SYMMETRIC, Method

if TYPE_CHECKING:
    from autotuner.core.model.process import ProcessModel
    from autotuner_models.literature.trial import Trial


def estimate(trial: Trial) -> ProcessModel:
    """Return the first-order process of peak and period."""
    cycle = trial.cycle(SYMMETRIC)
    return fopdt_symmetric(trial.K, cycle.h, cycle.A, cycle.Pu)


METHOD = Method("closed_form", "Closed form of the cycle", FOPDT, estimate)
