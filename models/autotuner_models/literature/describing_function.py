"""Describing function of one symmetric relay test, offline (the thesis's own row).

    N = 4h/(pi A),   N G(jw) = -1

with the peak for `A` in first order and the fundamental in second, as the thesis's numbers show. Source: Luyben, Ind.
Eng. Chem. Res. 26 (1987); thesis eqs. 3.2 to 3.23. The formulas are in `identification.describing_function`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.core.identification.limit_cycle import describing_function
from autotuner_models.literature.trial import FOPDT, SOPDT, SYMMETRIC, Method

if TYPE_CHECKING:
    from autotuner.core.model.process import ProcessModel
    from autotuner_models.literature.trial import Trial


def estimate(trial: Trial) -> ProcessModel:
    """Return the process of the describing function."""
    cycle = trial.cycle(SYMMETRIC)
    if trial.first_order:
        return describing_function.fopdt(trial.K, cycle.h, cycle.A, cycle.Pu)
    return describing_function.sopdt(trial.K, trial.D, cycle.h, cycle.A1, cycle.Pu)


METHOD = Method("describing_function", "Describing function, offline", FOPDT + SOPDT, estimate)
