"""The step of a verification: large enough to be seen in the noise, small enough for the limits, over in time.

    step = min(wanted, ROOM x room of the output / move per unit step, ROOM x room of the PV / move per unit step)
    step >= SEEN sigma

The moves per unit step are those of the simulated loop (`closed_loop`). Time ends when the simulated PV has settled.

`sigma` standard deviation of the measurement noise; steps and rooms in PV and output units.

Rules of this file: a step that the limits leave no room for is a refusal with its numbers, never a smaller limit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.tuning.closed_loop import Scenario, predict
from autotuner.core.tuning.loop_grid import sum_of_lags
from autotuner.core.verdict import Verdict, refused

if TYPE_CHECKING:
    from autotuner.core.arrays import FloatArray
    from autotuner.core.process import ProcessModel
    from autotuner.core.tuning.pid import PidSettings

ROOM = 0.8
"""Share of the room inside the limits that a step may use."""
SEEN = 10.0
"""Least step in standard deviations of the noise."""
WANTED = 40.0
"""Step in standard deviations of the noise where none is wanted."""
SPANS = 8.0
"""Longest step in dead times and lags of the process and integral times of the controller."""
LONGEST_SAMPLES = 20_000
AFTER_SETTLING = 1.3


@dataclass(frozen=True, slots=True)
class Rest:
    """The loop before the step.

    Attributes
    ----------
    pv, output : float
        Where it rests, PV and output units.
    noise_sigma : float
        Standard deviation of the measurement noise, PV units.
    """

    pv: float
    output: float
    noise_sigma: float


@dataclass(frozen=True, slots=True)
class Bounds:
    """Limits of output and PV, their units."""

    output: tuple[float, float]
    pv: tuple[float, float] = (-math.inf, math.inf)


def planned_step(
    model: ProcessModel,
    settings: PidSettings,
    rest: Rest,
    bounds: Bounds,
    *,
    sample_time_s: float,
    scan_s: float | None = None,
    wanted: float | None = None,
    with_load: bool = False,
) -> Scenario | Verdict:
    """Return the step to make, or a refusal when there is no room for one that would be seen.

    Parameters
    ----------
    model : ProcessModel
        The process.
    settings : PidSettings
        The controller to be verified; its limits are not looked at.
    rest : Rest
        The loop before the step.
    bounds : Bounds
        Limits of output and PV.
    sample_time_s : float
        Time between two samples, s.
    scan_s : float, optional
        Time between two steps of the controller, s, at most that of the samples, which is the default; the scenario
        goes by it, or by a larger part of the sample time where there would be too many steps.
    wanted : float, optional
        Size of the set-point step, PV units; `WANTED` standard deviations of the noise by default.
    with_load : bool
        Whether a load of the same weight is put on the output at the same time.
    """
    span_s = SPANS * (model.D + sum_of_lags(model) + (settings.gains.Ti if math.isfinite(settings.gains.Ti) else 0.0))
    h = sample_time_s / _parts(sample_time_s, scan_s or sample_time_s, span_s)
    free = replace(settings, low=-math.inf, high=math.inf, slew_per_s=math.inf)
    load = _load_of(model) if with_load else 0.0
    unit = predict(model, free, Scenario(span_s, h, 1.0, load))
    size = wanted or WANTED * rest.noise_sigma or ROOM * _largest(unit.output, unit.pv, rest, bounds)[0]
    upward, sign = _largest(unit.output, unit.pv, rest, bounds)
    step = min(size, upward)
    if not step > 0.0 or step < SEEN * rest.noise_sigma or not math.isfinite(step):
        return refused(
            "no_room_to_verify",
            f"the limits leave room for a step of {max(upward, 0.0):.3g}, but under {SEEN * rest.noise_sigma:.3g} "
            f"it would not be seen in the noise",
            "Move the loop to the middle of its limits, or verify by watching it.",
        )
    settled_s = max(AFTER_SETTLING * unit.settling_time_s + 2.0 * model.D, 20.0 * sample_time_s)
    return Scenario(min(span_s, settled_s), h, sign * step, sign * step * load)


def _parts(sample_time_s: float, scan_s: float, span_s: float) -> int:
    """Return into how many steps of the controller a sample time is divided."""
    return max(1, min(round(sample_time_s / scan_s), math.floor(LONGEST_SAMPLES * sample_time_s / span_s)))


def _load_of(model: ProcessModel) -> float:
    """Return a load, output units, that moves the PV by one unit as a set point of one unit does."""
    K = model.parameters().get("K", 0.0)
    return 1.0 / K if model.rational().a[0] != 0.0 and K else 0.0


def _largest(output: FloatArray, pv: FloatArray, rest: Rest, bounds: Bounds) -> tuple[float, float]:
    """Return the largest step that stays inside the room, and its sign."""
    sizes = {}
    for sign in (1.0, -1.0):
        by_output = _fits(sign * output, rest.output, bounds.output)
        by_pv = _fits(sign * pv, rest.pv, bounds.pv)
        sizes[sign] = ROOM * min(by_output, by_pv)
    best = max(sizes, key=lambda sign: sizes[sign])
    return sizes[best], best


def _fits(moves: FloatArray, rest: float, limits: tuple[float, float]) -> float:
    """Return by how much a move per unit may be multiplied before it leaves the limits."""
    up, down = float(np.max(moves)), float(-np.min(moves))
    above = (limits[1] - rest) / up if up > 0.0 else math.inf
    below = (rest - limits[0]) / down if down > 0.0 else math.inf
    return min(above, below)
