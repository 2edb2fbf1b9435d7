"""Background of the PV besides the response to the recorded output, and its selection for a recording.

    offset   the PV at rest                  drift   a straight line in time
    curve    a parabola in time: a load that drifts, seen through an integrator
    before   the response to the unknown output before the first sample
    state    the free response of an unknown state, one dead time after the first sample; earlier samples are the
             response to an output that is not in the recording, and do not count

A criterion of Mallows's kind (Technometrics 15, 1973) selects them,

    S/s^2 + 2 (samples that do not count) + c (columns),   s^2 the smallest mean square among the choices

with a penalty `c` that requires strong evidence; an omitted sample costs twice its contribution by noise alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.estimation.linear_least_squares import residual_after
from autotuner.core.model.arrays import SMALLEST_DIVISOR
from autotuner.core.model.zoh_input import unit_step

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from autotuner.core.estimation.data import Data
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.step_responses import Motion

Background = tuple[str, ...]

PRICE = 10.0
"""Fall of the criterion that one more column has to bring: strong evidence (Raftery, Sociol. Methodol. 25, 1995)."""
LEFT_OUT = 2.0
"""Penalty of an omitted sample, as of one more parameter in Akaike's criterion (1974)."""
FLOOR = 1e-7
"""Residual that counts as none, as a share of the PV's swing."""
SETTLING: tuple[Background, ...] = (("offset",), ("offset", "before"), ("offset", "state"))
WANDERING: tuple[Background, ...] = (
    ("offset",),
    ("offset", "drift"),
    ("offset", "before"),
    ("offset", "drift", "before"),
    ("offset", "drift", "state"),
    ("offset", "drift", "curve"),
    ("offset", "drift", "curve", "state"),
)
RUNNING_AWAY: tuple[Background, ...] = (("offset", "state"),)


def backgrounds(a0: float) -> tuple[Background, ...]:
    """Return the choices, widest last; the sign of `a0` separates settling from integrating and unstable processes."""
    return SETTLING if a0 > 0.0 else WANDERING if a0 == 0.0 else RUNNING_AWAY


def counted(data: Data, background: Background, delay_s: float) -> Data:
    """Return the samples that count with a background: all, or with a state those after one dead time."""
    return data.weighted(data.weight * (data.t >= delay_s)) if "state" in background else data


def score(squares: FloatArray, used: FloatArray, data: Data) -> FloatArray:
    """Return the criterion for fits with different numbers of samples: `(S/n + floor^2) e^{2 (N - n)/n}`.

    It is the criterion above for a noise of unknown variance, raised to the power `1/n`.

    Parameters
    ----------
    squares, used : array of float, any shape
        Weighted sums of squares, and the samples that count in them.
    data : Data
        The recording.
    """
    n = np.maximum(used, 1.0)
    result: FloatArray = (squares / n + floor_of(data) ** 2) * np.exp(
        np.minimum(LEFT_OUT * (data.t.size - n) / n, 500.0)
    )
    return result


def floor_of(data: Data) -> float:
    """Return the residual that counts as none, PV: below it lies arithmetic."""
    return FLOOR * float(np.ptp(data.pv))


def background_columns(
    data: Data, motion: Motion, background: Background, when: FloatArray
) -> list[tuple[FloatArray, FloatArray]]:
    """Return the background's columns with their slopes; `when` is time less dead time, s."""
    nothing = np.zeros(data.t.shape)
    makers: dict[str, Callable[[], list[tuple[FloatArray, FloatArray]]]] = {
        "offset": lambda: [(np.ones(data.t.shape), nothing)],
        "drift": lambda: [(data.t / data.span_s, nothing)],
        "curve": lambda: [((data.t / data.span_s) ** 2, nothing)],
        "before": lambda: list(zip(*motion.forced(unit_step(0.0), when), strict=True)),
        "state": lambda: [(column, nothing) for column in motion.free(data.t)],
    }
    return [pair for name in background for pair in makers[name]()]


def disturbance_columns(data: Data, motion: Motion, delays_s: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """Return the answers to the measured disturbances with their slopes; each has its own dead time, s."""
    responses = [motion.forced(held, data.t - D) for held, D in zip(data.others, delays_s, strict=True)]
    return [(columns[0], slopes[0]) for columns, slopes in responses]


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
        Response columns whose gains are solved together with the background.
    """
    fits = {background: _fit(data, motion, delay_s, background, forced) for background in choices}
    variance = min(mean_square for mean_square, _, _ in fits.values()) + floor_of(data) ** 2 + SMALLEST_DIVISOR

    def criterion(background: Background) -> float:
        mean_square, used, columns = fits[background]
        return used * mean_square / variance + LEFT_OUT * (data.t.size - used) + PRICE * columns

    return min(choices, key=criterion)


def _fit(
    data: Data, motion: Motion, delay_s: float, background: Background, forced: Sequence[FloatArray]
) -> tuple[float, int, int]:
    """Return the mean square that a background leaves, the samples that count with it, and its columns."""
    columns = [*forced, *(c for c, _ in background_columns(data, motion, background, data.t - delay_s))]
    counting = counted(data, background, delay_s)
    used = max(int(np.count_nonzero(counting.weight)), 1)
    residual = residual_after(counting.balanced(np.column_stack(columns)), counting.balanced(data.pv))
    return float(residual @ residual) / used, used, len(columns)
