"""What a controller meets on its loop, for the prediction of what it will do there.

    PID of the device -> limits and slew of the output -> effects between output and process -> process

Rules of this file: the prediction is that of `autotuner.core.tuning.closed_loop`, with the controller's own sample time
as far as a response of `MOST_SAMPLES` allows; what is not known is left out, never guessed; steps are of a size that
this loop has seen, because limits and effects look different under each size.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from autotuner.core.tuning.actuators import Setting, actuator_of, predictable
from autotuner.core.tuning.closed_loop import Prediction, Scenario, predict
from autotuner.core.tuning.pid import PidSettings

if TYPE_CHECKING:
    from autotuner.core.process import ProcessModel
    from autotuner.core.tuning.actuators import Named
    from autotuner.core.tuning.gains import PidGains

MOST_SAMPLES = 2500
"""Most samples of a response."""
LEAST_SAMPLES = 600
"""Fewest: a controller whose sample time is not known is taken as so fast."""
FREE = (-math.inf, math.inf)


@dataclass(frozen=True, slots=True)
class Installed:
    """How a controller is installed.

    Attributes
    ----------
    sample_time_s : float
        Its sample time, s; 0: not known.
    output_room : tuple of float
        How far the output may fall and rise from where it rests, output units.
    slew_per_s : float
        Fastest change of the output, output units/s.
    derivative_filter : float or None
        `N` of the device's own filter of the derivative, of `Td/N`; None for none.
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
    derivative_filter: float | None = None
    rest_output: float = 0.0
    effects: tuple[Named, ...] = ()
    set_point_step: float = 1.0
    load_step: float = 1.0

    @property
    def foreseen(self) -> tuple[str, ...]:
        """Names of the effects that take part."""
        return tuple(effect.name for effect in predictable(self.effects))


PLAIN = Installed()
"""A controller of which nothing is known but its gains: unit steps on the process alone."""


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
    h = max(min(installed.sample_time_s or math.inf, duration_s / LEAST_SAMPLES), duration_s / MOST_SAMPLES)
    low, high = installed.output_room
    filter_s = gains.Td / installed.derivative_filter if installed.derivative_filter else 0.0
    settings = PidSettings(gains, low, high, installed.slew_per_s, filter_s)
    setting = Setting(installed.rest_output, h)
    moved, loaded = (
        predict(model, settings, scenario, actuator=actuator_of(installed.effects, setting))
        for scenario in (
            Scenario(duration_s, h, set_point_step=installed.set_point_step),
            Scenario(duration_s, h, load_step=installed.load_step),
        )
    )
    return moved, loaded


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
