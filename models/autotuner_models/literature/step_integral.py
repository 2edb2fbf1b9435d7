"""Integrals of a step response: linear least squares without any derivative.

    int_0^t y = K u (t - D) - T y(t),   t >= D

is linear in `K`, `K D` and `T`; samples before the dead time do not count, so it is repeated with the dead time found.
`u` the step, `y` the PV, both as deviations from rest. Source: Bi et al., Control Eng. Pract. 7 (1999); Fedele, J.
Franklin Inst. 346 (2009), which also uses integrals of the step response.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.model.process import Fopdt
from autotuner.core.signals.static_gain import rest_rows
from autotuner.errors import InputError
from autotuner_models.literature.trial import FOPDT, SOPDT, STEP, Method

if TYPE_CHECKING:
    from autotuner.core.model.process import ProcessModel
    from autotuner_models.literature.trial import Trial

ROUNDS = 10
"""Most rounds of the fixed-point iteration."""


def estimate(trial: Trial) -> ProcessModel:
    """Return the first-order process of the integrals, whatever the structure wanted."""
    recording = trial.recording(STEP)
    rest = rest_rows(recording.output) + 1
    t = recording.t[rest:] - recording.t[rest]
    y = recording.pv[rest:] - recording.pv[: rest + 1].mean()
    u = float(recording.output[rest] - recording.output[0])
    area = np.concatenate(([0.0], np.cumsum((y[1:] + y[:-1]) / 2.0 * np.diff(t))))
    D, T, K = 0.0, 0.0, 0.0
    for _ in range(ROUNDS):
        rows = t >= D
        phi = np.column_stack((u * t[rows], np.full(int(rows.sum()), -u), -y[rows]))
        K, KD, T = np.linalg.lstsq(phi, area[rows], rcond=None)[0].tolist()
        if K == 0.0 or T <= 0.0:
            raise InputError(f"comes out as {T:.3g} s", field="T", remedy="Record the step for longer.")
        D = min(max(KD / K, 0.0), float(t[-1]) / 2.0)
    return Fopdt(K, T, D)


METHOD = Method("step_integral", "Integrals of a step (Fedele)", FOPDT + SOPDT, estimate, finds_all=True)
