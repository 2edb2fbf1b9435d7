"""Two relay tests, the second with a known extra dead time in the loop: two points of the frequency response.

    |G(jw_i)| = pi A_i/(4 h),   arg G(jw_1) = -pi,   arg G(jw_2) = -pi + w_2 Delta

    FOPDT   (K/|G_i|)^2 - 1 = (w_i T)^2                                    least squares for T^2
    SOPDT   (K/|G_i|)^2 - 1 = (n^2 - 2 m) w_i^2 + m^2 w_i^4                solved for m, n
    D_i = (-arg G_i - atan2(n w_i, 1 - m w_i^2))/w_i                       averaged

`Delta` extra dead time, `w_i` frequencies of the two cycles. Source: Li, Eskinat and Luyben, Ind. Eng. Chem. Res. 30
(1991).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.model.process import Fopdt, second_order
from autotuner.errors import InputError
from autotuner_models.literature.trial import DELAYED, FOPDT, SOPDT, SYMMETRIC, Method

if TYPE_CHECKING:
    from autotuner.core.model.process import ProcessModel
    from autotuner_models.literature.trial import Trial


def estimate(trial: Trial) -> ProcessModel:
    """Return the process through both points."""
    cycles = (trial.cycle(SYMMETRIC), trial.cycle(DELAYED))
    w = np.array([2.0 * math.pi / cycle.Pu for cycle in cycles])
    excess = np.array([(trial.K * 4.0 * cycle.h / (math.pi * cycle.A)) ** 2 - 1.0 for cycle in cycles])
    behind = np.array([math.pi, math.pi - w[1] * trial.added_delay_s])
    if trial.first_order:
        squared = float(excess @ w**2) / float(w**2 @ w**2)
        if squared <= 0.0:
            raise _impossible("T^2", squared)
        T = math.sqrt(squared)
        return Fopdt(trial.K, T, float(np.mean((behind - np.arctan(w * T)) / w)))
    both, m_squared = np.linalg.solve(np.column_stack((w**2, w**4)), excess).tolist()
    if m_squared <= 0.0 or both + 2.0 * math.sqrt(m_squared) <= 0.0:
        raise _impossible("m^2", m_squared)
    m = math.sqrt(m_squared)
    n = math.sqrt(both + 2.0 * m)
    return second_order(trial.K, m, n, float(np.mean((behind - np.arctan2(n * w, 1.0 - m * w**2)) / w)))


def _impossible(name: str, value: float) -> InputError:
    return InputError(f"comes out as {value:.3g}", field=name, remedy="Check the static gain, or test at lower noise.")


METHOD = Method("two_relays", "Two relay tests (Li et al.)", FOPDT + SOPDT, estimate, finds=("D",))
