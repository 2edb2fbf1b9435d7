"""Describing functions of a relay test: offline, in parallel with a controller, with hysteresis, with a biased relay.

    offline      N G(jw) = -1,           N = 4h/(pi A),   w = 2 pi/Pu
    online       (N + Gc(jw)) G(jw) = -1
    hysteresis   N G(jw) = -1,           N = 4h/(pi A) e^{-j asin(eps/A)}
                 T = sqrt((|N| K)^2 - 1)/w,   D = (pi - asin(eps/A) - atan(w T))/w
    dual input   N G(jw) = -1,           N = (4h/(pi A)) sqrt(1 - (a0/A)^2)
                 K = (mean PV over cycles - PV at rest)/(mean output - output at rest)

`A` is the peak in first order and the fundamental in second, as the thesis's numbers show; `Gc` the controller as it is
sampled and held; `eps` half the dead zone of the relay; `a0` distance of the PV's mean from the switching level.

Sources: Luyben, Ind. Eng. Chem. Res. 26 (1987) and thesis eqs. 3.2 to 3.23; Kumar et al. as cited by the thesis
(section 1.3.2); Lee et al., whom the thesis names for the hysteresis without figures of theirs; Shen, Wu and Yu, AIChE
J. 42 (1996) and Gelb and Vander Velde, Multiple-Input Describing Functions (1968) for the biased relay. The formulas
are in `autotuner.core.identification.limit_cycle`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from autotuner.core.identification.limit_cycle import describing_function, online_relay
from autotuner.core.signals.static_gain import gain_from_cycles
from autotuner.errors import InputError
from autotuner_models.literature.trial import BESIDE, BIASED, FOPDT, HYSTERESIS, SOPDT, SYMMETRIC, Method

if TYPE_CHECKING:
    from autotuner.core.model.process import ProcessModel
    from autotuner_models.literature.trial import Trial


def offline(trial: Trial) -> ProcessModel:
    """Return the process of one symmetric relay test: the thesis's own row."""
    cycle = trial.cycle(SYMMETRIC)
    if trial.first_order:
        return describing_function.fopdt(trial.K, cycle.h, cycle.A, cycle.Pu)
    return describing_function.sopdt(trial.K, trial.D, cycle.h, cycle.A1, cycle.Pu)


def online(trial: Trial) -> ProcessModel:
    """Return the process of a relay in parallel with a controller.

    Raises
    ------
    InputError
        The controller is not known.
    """
    cycle = trial.cycle(BESIDE)
    if trial.controller is None:
        raise InputError("is not known", field="controller", remedy="Give the gains that ran beside the relay.")
    Gc = online_relay.held_response(trial.controller, cycle.Pu, trial.recording(BESIDE).sample_interval_s)
    if trial.first_order:
        return describing_function.fopdt(trial.K, cycle.h, cycle.A, cycle.Pu, controller=Gc)
    return describing_function.sopdt(trial.K, trial.D, cycle.h, cycle.A1, cycle.Pu, controller=Gc)


def with_hysteresis(trial: Trial) -> ProcessModel:
    """Return the process of a relay with the dead zone that the record shows."""
    cycle = trial.cycle(HYSTERESIS)
    return describing_function.fopdt(trial.K, cycle.h, cycle.A, cycle.Pu, min(cycle.hysteresis, cycle.A))


def dual_input(trial: Trial) -> ProcessModel:
    """Return the process of a biased relay, which shows the static gain and one point of the frequency response.

    Raises
    ------
    InputError
        The test is not asymmetric enough to show the static gain.
    """
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


OFFLINE = Method("describing_function", "Describing function, offline", FOPDT + SOPDT, offline)
ONLINE = Method("online", "Describing function, online (relay beside PI)", FOPDT + SOPDT, online)
WITH_HYSTERESIS = Method("hysteresis", "Describing function, hysteresis relay (Lee et al.)", FOPDT, with_hysteresis)
DUAL_INPUT = Method(
    "dual_input", "Dual-input describing function (Shen et al.)", FOPDT + SOPDT, dual_input, finds=("K",)
)
