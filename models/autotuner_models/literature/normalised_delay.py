"""Asymmetric relay with formulas in the normalised dead time `tau = D/(D + T)`.

    rho = longer over shorter half period,   gamma = larger over smaller part of the swing
    tau = (gamma - rho)/((gamma - 1) (0.35 rho + 0.65))                            a fit over many processes
    K   = int (y - y_rest) dt / int (u - u_rest) dt                                 over whole cycles
    e^{t_h/T} = (eps/K - d_l + e^{D/T} (d_h + d_l))/(d_h - eps/K)                   exact, with D/T = tau/(1 - tau)

`d_h`, `d_l` distance of the upper and lower output level from rest, `t_h` time at the upper, `eps` half width of the
dead zone (PV). Source: Berner, Hagglund and Astrom, Control Eng. Pract. 54 (2016); Berner, Lund University (2017).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from autotuner.core.model.process import Fopdt
from autotuner.core.signals.static_gain import gain_from_cycles
from autotuner.errors import InputError
from autotuner_models.literature.trial import BIASED, FOPDT, Method

if TYPE_CHECKING:
    from autotuner.core.model.process import ProcessModel
    from autotuner_models.literature.trial import Trial

LARGEST = 0.99
"""Normalised dead time that is still distinguished from a pure one."""


def estimate(trial: Trial) -> ProcessModel:
    """Return the process of the normalised dead time."""
    recording, cycle = trial.recording(BIASED), trial.cycle(BIASED)
    gain = gain_from_cycles(recording, cycle)
    rest = float(recording.output[0])
    up, down = cycle.bias + cycle.h - rest, rest - (cycle.bias - cycle.h)
    if gain is None or min(up, down) <= 0.0:
        raise InputError(
            "does not swing about the rest", field="tests.biased", remedy="Place the rest between the levels."
        )
    rho = max(cycle.high_s, cycle.low_s) / min(cycle.high_s, cycle.low_s)
    gamma = max(up, down) / min(up, down)
    tau = (gamma - rho) / ((gamma - 1.0) * (0.35 * rho + 0.65)) if gamma > 1.0 else 0.0
    if not 0.0 < tau < LARGEST:
        raise InputError(f"comes out as {tau:.3g}", field="tau", remedy="Make the relay more asymmetric.")
    zone = cycle.hysteresis / abs(gain.K)
    d = tau / (1.0 - tau)
    ratio = (zone - down + math.exp(d) * (up + down)) / (up - zone) if up > zone else 0.0
    if ratio <= 1.0:
        raise InputError("is wider than the oscillation", field="hysteresis", remedy="Narrow the dead zone.")
    T = cycle.high_s / math.log(ratio)
    return Fopdt(gain.K, T, d * T)


METHOD = Method("normalised_delay", "Normalised dead time (Berner et al.)", FOPDT, estimate, finds_all=True)
