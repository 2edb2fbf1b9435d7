"""Describing function of a relay in parallel with a controller (section 1.3.2 of the thesis).

    (N + Gc(jw)) G(jw) = -1,   N = 4h/(pi A),   w = 2 pi/Pu

with the peak for `A` in first order and the fundamental in second, as offline. Source: Kumar et al., as cited by the
thesis; the formulas are in `identification.online`. `Gc` is the controller as it is sampled and held.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.core.identification.limit_cycle import online_relay
from autotuner.errors import InputError
from autotuner_models.literature.trial import BESIDE, FOPDT, SOPDT, Method

if TYPE_CHECKING:
    from autotuner.core.model.process import ProcessModel
    from autotuner_models.literature.trial import Trial


def estimate(trial: Trial) -> ProcessModel:
    """Return the process by the describing function in parallel with the controller."""
    cycle = trial.cycle(BESIDE)
    if trial.controller is None:
        raise InputError("is not known", field="controller", remedy="Give the gains that ran beside the relay.")
    Gc = online_relay.held_response(trial.controller, cycle.Pu, trial.recording(BESIDE).sample_interval_s)
    if trial.first_order:
        return online_relay.fopdt(trial.K, cycle.h, cycle.A, cycle.Pu, Gc)
    return online_relay.sopdt(trial.K, trial.D, cycle.h, cycle.A1, cycle.Pu, Gc)


METHOD = Method("online", "Describing function, online (relay beside PI)", FOPDT + SOPDT, estimate)
