"""Describing function of a relay with hysteresis.

    N = 4h/(pi A) e^{-j asin(eps/A)},   N G(jw) = -1

    T = sqrt((|N| K)^2 - 1)/w,   D = (pi - asin(eps/A) - atan(w T))/w

with the peak for `A`, as in the thesis's first-order rows. The thesis names Lee et al. for it ("describing function
approach using hysteresis relay to estimate stable FOPDT process model parameter") and prints no figures of theirs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.core.identification.limit_cycle import describing_function
from autotuner_models.literature.trial import FOPDT, HYSTERESIS, Method

if TYPE_CHECKING:
    from autotuner.core.model.process import ProcessModel
    from autotuner_models.literature.trial import Trial


def estimate(trial: Trial) -> ProcessModel:
    """Return the process of the describing function with the dead zone that the record shows."""
    cycle = trial.cycle(HYSTERESIS)
    return describing_function.fopdt(trial.K, cycle.h, cycle.A, cycle.Pu, min(cycle.hysteresis, cycle.A))


METHOD = Method("hysteresis", "Describing function, hysteresis relay (Lee et al.)", FOPDT, estimate)
