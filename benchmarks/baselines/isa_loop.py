"""The loop of a process with the controller of the simulated device, in the frequency domain.

    C(s) = Kp (1 + 1/(Ti s) + Td s/(1 + Td s/N)),   N = `DERIVATIVE_FILTER`

`Ms` is the largest `|1/(1 + C G)|` (Astrom and Hagglund, Advanced PID Control, 2006).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from autotuner_sim.devices.loop_device import DERIVATIVE_FILTER

if TYPE_CHECKING:
    from autotuner.core.model.arrays import ComplexArray


def controller(s: ComplexArray, Kp: float, Ti: float, Td: float) -> ComplexArray:
    """Return `C(s)`, shape of `s`, output/PV; `Ti` and `Td` in s, without integral action where `Ti` is 0."""
    return Kp * (1.0 + (1.0 / (Ti * s) if Ti else 0.0) + Td * s / (1.0 + Td * s / DERIVATIVE_FILTER))


def largest_sensitivity(loop: ComplexArray) -> float:
    """Return `Ms` of the open loop `C G`, an array over frequencies."""
    return float(np.max(1.0 / np.abs(1.0 + loop)))
