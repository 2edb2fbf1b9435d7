"""Friction of the actuator with a known process: the loop was tuned, so only the friction is searched.

    PV = model(position),   position = friction(output; band, jump),   sizes with the least error of a grid, then nearby

or, as alternative, an external disturbance:

    PV = model(output) + a cos(w t) + b sin(w t) + c + d t,   w within a few percent of the oscillation's

`band`, `jump`, `width` output units, defined as in `autotuner.core.design.simulation.actuators`. A record of normal
operation alone hardly distinguishes a process from its friction; with the process fixed as tuned, it does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.design.simulation.actuators import SEATS, Setting, actuator_of
from autotuner.core.estimation.simulation import simulate_fit
from autotuner.core.signals.noise import rms

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.recording import Recording

SHARES = (0.06, 0.1, 0.15, 0.21, 0.28, 0.36, 0.46, 0.58, 0.72, 0.9, 1.1)
"""Bands that are tried, in swings of the output."""
JUMPS = (0.3, 0.6, 1.0)
"""Jumps that are tried, in bands."""
FOLLOWED = 2
"""Number of grid points of each kind that are refined."""
STEPS = (0.12, 0.06, 0.06, 0.03, 0.03, 0.015)
"""Relative steps of the sizes around the best so far, one round after the other."""
PERIODS = tuple(np.linspace(0.97, 1.03, 61).tolist())
"""Periods of a wave that are tried, over that of the oscillation."""


@dataclass(frozen=True, slots=True)
class Friction:
    """Friction with its sizes, and the remaining residual.

    Attributes
    ----------
    name : str
        ``backlash`` or ``stiction``.
    parameters : mapping of str to float
        Sizes, output units.
    error : float
        Root mean square of measured minus simulated PV, PV units.
    """

    name: str
    parameters: Mapping[str, float]
    error: float


def likeliest_friction(recording: Recording, model: ProcessModel) -> Friction:
    """Return the friction with which a process explains a recording best.

    Parameters
    ----------
    recording : Recording
        A loop that oscillates.
    model : ProcessModel
        Its process, without friction.
    """
    tried = sorted(
        ((_tried(recording, model, name, sizes, seat), seat) for name, sizes, seat in _grid(recording)),
        key=lambda one: one[0].error,
    )
    candidates = [
        one for name in ("backlash", "stiction") for one in [t for t in tried if t[0].name == name][:FOLLOWED]
    ]
    return min((_refined(recording, model, *one) for one in candidates), key=lambda one: one.error)


def _refined(recording: Recording, model: ProcessModel, best: Friction, seat: float) -> Friction:
    for step in STEPS:
        nearby = [_tried(recording, model, best.name, sizes, seat) for sizes in _around(best.parameters, step)]
        best = min([best, *nearby], key=lambda one: one.error)
    return best


def _around(sizes: Mapping[str, float], step: float) -> Iterator[dict[str, float]]:
    """Yield uniformly scaled sizes, and other ratios of jump to band; a jump is at most as long as its band."""
    factors = (1.0 - step, 1.0 - step / 2.0, 1.0 + step / 2.0, 1.0 + step)
    for factor in factors:
        yield {part: factor * size for part, size in sizes.items()}
    if "jump" in sizes:
        for factor in factors:
            yield {**sizes, "jump": min(factor * sizes["jump"], sizes["band"])}


def error_beside_wave(recording: Recording, model: ProcessModel, period_s: float) -> float:
    """Return the root mean square error of a model with an external wave of about this period, PV units."""
    error = recording.pv - simulate_fit(model, recording)
    t = recording.t - recording.t[0]
    return min(_left(error, t, 2.0 * math.pi / (period_s * factor)) for factor in PERIODS)


def _left(error: FloatArray, t: FloatArray, w: float) -> float:
    columns = np.column_stack((np.cos(w * t), np.sin(w * t), np.ones_like(t), t))
    coefficients = np.linalg.lstsq(columns, error, rcond=None)[0]
    return rms(error - columns @ coefficients)


def _grid(recording: Recording) -> Iterator[tuple[str, dict[str, float], float]]:
    swing = float(np.ptp(recording.output))
    for share, seat in product(SHARES, SEATS):
        yield "backlash", {"width": share * swing}, seat
        for jump in JUMPS:
            yield "stiction", {"band": share * swing, "jump": jump * share * swing}, seat


def _tried(recording: Recording, model: ProcessModel, name: str, sizes: Mapping[str, float], seat: float) -> Friction:
    move = actuator_of([_Sized(name, sizes)], Setting(float(recording.output[0]), recording.sample_interval_s, seat))
    assert move is not None  # noqa: S101 - both kinds of friction act on the output
    position = np.array([move(u) for u in (recording.output - recording.output[0]).tolist()])
    driven = replace(recording, output=position)
    return Friction(name, sizes, rms(recording.pv - simulate_fit(model, driven)))


@dataclass(frozen=True, slots=True)
class _Sized:
    name: str
    parameters: Mapping[str, float]
