"""Setup of a closed loop for predictions: controller, limits, effects and process.

    PID of the device -> limits and slew of the output -> effects between output and process -> process

Invariants:

1. The prediction is that of `autotuner.core.design.simulation.closed_loop`, with the controller's own scan as far as a
   response of `MOST_SAMPLES` allows.
2. Unknown parts are omitted, never guessed. Steps have a size that this loop has seen, because limits and effects
   depend on the size.
3. Displayed overshoot, settling time and error come from `predicted_loop` alone: table, chart, report and
   API show the same simulation.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.design.simulation.actuators import Setting, actuator_of, predictable
from autotuner.core.design.simulation.closed_loop import Prediction, Scenario, predict
from autotuner.core.design.simulation.pid import PidSettings

if TYPE_CHECKING:
    from autotuner.core.design.gains import PidGains
    from autotuner.core.design.simulation.actuators import Named
    from autotuner.core.model.process import ProcessModel

MOST_SAMPLES = 2500
"""Most samples of a response."""
LEAST_SAMPLES = 600
"""Scan time assumed for a controller with an unknown scan, s."""
DEAD_TIMES, INTEGRAL_TIMES = 12.0, 4.0
"""Length of a response in dead times and in integral times."""
FREE = (-math.inf, math.inf)


@dataclass(frozen=True, slots=True)
class Installed:
    """Setup of a controller on its loop.

    Attributes
    ----------
    sample_time_s : float
        Time between two moves of the controller (its scan), s; 0: not known.
    output_room : tuple of float
        How far the output may fall and rise from where it rests, output units.
    slew_per_s : float
        Fastest change of the output, output units/s.
    rest_output : float
        Output at rest, output units.
    effects : tuple of Named
        What a diagnosis found; those between output and process take part.
    set_point_step, load_step : float
        Sizes of the steps to predict, PV and output units.
    """

    sample_time_s: float = 0.0
    output_room: tuple[float, float] = FREE
    slew_per_s: float = math.inf
    rest_output: float = 0.0
    effects: tuple[Named, ...] = ()
    set_point_step: float = 1.0
    load_step: float = 1.0

    def settings(self, gains: PidGains) -> PidSettings:
        """Return the controller with its limits, as deviations from rest."""
        low, high = self.output_room
        return PidSettings(gains, low, high, self.slew_per_s)

    @property
    def foreseen(self) -> tuple[str, ...]:
        """Names of the effects that take part."""
        return tuple(effect.name for effect in predictable(self.effects))


PLAIN = Installed()
"""A controller of which only the gains are known: unit steps on the process alone."""


def responses(
    model: ProcessModel, gains: PidGains, installed: Installed, duration_s: float
) -> tuple[Prediction, Prediction]:
    """Return the responses to a step of the set point and of the load.

    Parameters
    ----------
    model : ProcessModel
        The process.
    gains : PidGains
        The controller.
    installed : Installed
        Where it works.
    duration_s : float
        Length of each response, s.
    """
    natural_s = response_time_s(model, gains)
    h = max(installed.sample_time_s or natural_s / LEAST_SAMPLES, natural_s / MOST_SAMPLES)
    settings = installed.settings(gains)
    setting = Setting(installed.rest_output, h)
    moved, loaded = (
        predict(model, settings, scenario, actuator=actuator_of(installed.effects, setting))
        for scenario in (
            Scenario(duration_s, h, set_point_step=installed.set_point_step),
            Scenario(duration_s, h, load_step=installed.load_step),
        )
    )
    return moved, loaded


def response_time_s(model: ProcessModel, gains: PidGains) -> float:
    """Return the length of a response, s."""
    Ti = gains.Ti if math.isfinite(gains.Ti) else 10.0 * model.D
    return DEAD_TIMES * model.D + INTEGRAL_TIMES * Ti


@dataclass(frozen=True, slots=True)
class LoopPrediction:
    """Predict the loop with a controller, for the steps of `Installed`.

    Attributes
    ----------
    set_point_step, load_step : float
        Sizes of the steps, PV and output units.
    overshoot : float
        Largest excess of the PV over the set point, share of the step.
    settling_time_s : float or None
        Time from which the PV stays within 2 % of the step, s; None where it does not within the simulated time.
    output_move : float
        Largest move of the output after the step of the set point, output units.
    load_deviation : float
        Largest deviation of the PV after the step of the load, PV units.
    load_iae : float
        Integral of the absolute error after it, PV s.
    """

    set_point_step: float
    load_step: float
    overshoot: float
    settling_time_s: float | None
    output_move: float
    load_deviation: float
    load_iae: float

    def to_dict(self) -> dict[str, float | None]:
        """Return JSON-ready values."""
        return asdict(self)


def predicted_loop(model: ProcessModel, gains: PidGains, installed: Installed) -> LoopPrediction:
    """Return the figures of the two responses, over the loop's own time; parameters as in `responses`."""
    moved, loaded = responses(model, gains, installed, response_time_s(model, gains))
    settling_s = moved.settling_time_s
    return LoopPrediction(
        set_point_step=installed.set_point_step,
        load_step=installed.load_step,
        overshoot=moved.overshoot,
        settling_time_s=settling_s if settling_s < moved.t[-1] else None,
        output_move=float(np.max(np.abs(moved.output))),
        load_deviation=float(np.max(np.abs(loaded.pv))),
        load_iae=loaded.iae,
    )


def handy(size: float) -> float:
    """Return the largest of 1, 2, 5 and their decades that is not above `size`; 1 for no size.

    Parameters
    ----------
    size : float
        Any number; its sign does not matter.
    """
    if not 0.0 < abs(size) < math.inf:
        return 1.0
    decade = 10.0 ** math.floor(math.log10(abs(size)))
    return max((step * decade for step in (1.0, 2.0, 5.0) if step * decade <= abs(size)), default=decade)
