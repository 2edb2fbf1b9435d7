"""What the PV does besides answering the recorded output, and how much of it a recording needs.

    offset   the PV at rest                  drift   a straight line in time
    before   the answer to the unknown output before the first sample
    state    the motion from an unknown initial state

Which of them are taken in is decided by the Bayesian information criterion, `N ln(S/N) + c p`, with a price `c` that
asks for strong evidence.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.identification.held_input import unit_step
from autotuner.core.identification.linear import residual_after

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from autotuner.core.arrays import FloatArray
    from autotuner.core.identification.data import Data
    from autotuner.core.identification.motions import Motion

Background = tuple[str, ...]

PRICE = 10.0
"""Fall of the criterion that one more column has to bring: strong evidence (Raftery, Sociol. Methodol. 25, 1995)."""
FLOOR = 1e-7
"""Residual, as a share of the PV's swing, that counts as none: below it lies arithmetic."""
SETTLING: tuple[Background, ...] = (
    ("offset",),
    ("offset", "before"),
    ("offset", "state"),
    ("offset", "before", "state"),
)
WANDERING: tuple[Background, ...] = (
    ("offset",),
    ("offset", "drift"),
    ("offset", "before"),
    ("offset", "drift", "before"),
    ("offset", "drift", "state"),
    ("offset", "drift", "before", "state"),
)
RUNNING_AWAY: tuple[Background, ...] = (("offset", "state"),)


def backgrounds(a0: float, *, has_state: bool) -> tuple[Background, ...]:
    """Return the choices, the widest last; the sign of `a0` tells a settling from an integrating or unstable process.

    A process whose only state is its offset has no `state` of its own.
    """
    choices = SETTLING if a0 > 0.0 else WANDERING if a0 == 0.0 else RUNNING_AWAY
    return choices if has_state else tuple(choice for choice in choices if "state" not in choice)


def background_columns(
    data: Data, motion: Motion, background: Background, when: FloatArray
) -> list[tuple[FloatArray, FloatArray]]:
    """Return the background's columns with their slopes; `when` is time less dead time, s."""
    nothing = np.zeros(data.t.shape)
    makers: dict[str, Callable[[], list[tuple[FloatArray, FloatArray]]]] = {
        "offset": lambda: [(np.ones(data.t.shape), nothing)],
        "drift": lambda: [(data.t / data.span_s, nothing)],
        "before": lambda: list(zip(*motion.forced(unit_step(0.0), when), strict=True)),
        "state": lambda: [(column, nothing) for column in motion.free(data.t)],
    }
    return [pair for name in background for pair in makers[name]()]


def cheapest(
    data: Data, motion: Motion, delay_s: float, choices: Sequence[Background], forced: Sequence[FloatArray] = ()
) -> Background:
    """Return the background with the lowest criterion.

    Parameters
    ----------
    data : Data
        The recording; for a known response, the PV less that response.
    motion : Motion
        The process's motion.
    delay_s : float
        Its dead time, s.
    choices : sequence of Background
        What there is to choose from.
    forced : sequence of array of float
        Response columns whose gains are solved for along with the background.
    """
    when = data.t - delay_s
    floor = (FLOOR * float(np.ptp(data.pv))) ** 2

    def criterion(background: Background) -> float:
        columns = [*forced, *(column for column, _ in background_columns(data, motion, background, when))]
        left = residual_after(np.column_stack(columns) * data.weight[:, None], data.pv * data.weight)
        return data.t.size * math.log(float(left @ left) / data.t.size + floor + 1e-300) + PRICE * len(columns)

    return min(choices, key=criterion)
