"""Dual-input describing function: a biased relay shows the static gain and one point of the frequency response.

    K   = (mean PV over cycles - PV at rest)/(mean output - output at rest)
    N   = (4h/(pi A)) sqrt(1 - (a0/A)^2),   N G(jw) = -1

`a0` distance of the PV's mean from the switching level, `A` amplitude. Source: Shen, Wu and Yu, AIChE J. 42 (1996);
Gelb and Vander Velde, Multiple-Input Describing Functions (1968).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from autotuner.core.identification.limit_cycle import describing_function
from autotuner.core.signals.static_gain import gain_from_cycles
from autotuner.errors import InputError
from autotuner_models.literature.trial import BIASED, FOPDT, SOPDT, Method

if TYPE_CHECKING:
    from autotuner.core.model.process import ProcessModel
    from autotuner_models.literature.trial import Trial


def estimate(trial: Trial) -> ProcessModel:
    """Return the process of the dual-input describing function."""
    recording, cycle = trial.recording(BIASED), trial.cycle(BIASED)
    gain = gain_from_cycles(recording, cycle)
    if gain is None:
        raise InputError("is not asymmetric enough", field="tests.biased", remedy="Move the relay further off.")
    rows = (recording.t >= cycle.start_s) & (recording.t <= cycle.end_s)
    off = float(recording.pv[rows].mean()) - (cycle.pv_at_rise + cycle.pv_at_fall) / 2.0
    A = cycle.A if trial.first_order else cycle.A1
    h = cycle.h * math.sqrt(max(1.0 - (off / A) ** 2, 0.0))
    if trial.first_order:
        return describing_function.fopdt(gain.K, h, A, cycle.Pu)
    return describing_function.sopdt(gain.K, trial.D, h, A, cycle.Pu)


METHOD = Method("dual_input", "Dual-input describing function (Shen et al.)", FOPDT + SOPDT, estimate, finds=("K",))
