"""Requirements on a controller.

Invariants: requirements are checked when they are created; a goal in users' words is a row of data.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from autotuner.errors import InputError

if TYPE_CHECKING:
    from autotuner.core.design.device_controller import DeviceController

SMALLEST_MS, LARGEST_MS = 1.05, 4.0
"""Below, the loop would hardly act; above, it would hardly be stable."""


class Purpose(StrEnum):
    """Purpose of the controller."""

    LOAD = "load"
    SET_POINT = "set_point"


class Controller(StrEnum):
    """Which parts the controller may have."""

    P = "P"
    PI = "PI"
    PID = "PID"


@dataclass(frozen=True, slots=True)
class Noise:
    """Measured noise of the PV, taken as white at the sample time.

    Attributes
    ----------
    sigma : float
        Standard deviation, PV units.
    sample_time_s : float
        Sample time of the measurement, s.

    Raises
    ------
    InputError
        A value that is not a positive number; names the field.
    """

    sigma: float
    sample_time_s: float

    def __post_init__(self) -> None:
        _positive(self, ("sigma", "sample_time_s"))


@dataclass(frozen=True, slots=True)
class NoiseLimit:
    """Measured noise and how much of it may reach the output.

    Attributes
    ----------
    sigma : float
        Standard deviation of the measurement noise, PV units; taken as white at the sample time.
    jitter : float
        Largest standard deviation of the output that the noise may cause, output units.
    sample_time_s : float
        Sample time of the measurement, s.

    Raises
    ------
    InputError
        A value that is not a positive number; names the field.
    """

    sigma: float
    jitter: float
    sample_time_s: float

    def __post_init__(self) -> None:
        _positive(self, ("sigma", "jitter", "sample_time_s"))


def _positive(noise: Noise | NoiseLimit, names: tuple[str, ...]) -> None:
    for name in names:
        value = getattr(noise, name)
        if not 0.0 < value < math.inf:
            raise InputError(
                "must be a positive number",
                field=f"noise.{name}",
                value=value,
                remedy="Give the measured value, or no noise at all.",
            )


@dataclass(frozen=True, slots=True)
class Requirements:
    """Requirements on a controller.

    Attributes
    ----------
    Ms, Mt : float
        Largest sensitivity and complementary sensitivity allowed.
    controller : Controller
        Permitted parts of the controller; derivative action without a benefit is omitted.
    purpose : Purpose
        Whether the error after a load step or after a set-point step is made small.
    noise : NoiseLimit or None
        Limit of the output's jitter; the measurement filter is designed with the gains. None: `Tf = Td / filter_ratio`,
        or longer where that lowers the error, as for a process of little more than dead time.
    filter_ratio : float
        `Td / Tf` without a noise limit; infinite for no filter.
    derivative_ratio : float
        Largest `Td / Ti`; 0.25 for devices of the series form.
    device : DeviceController or None
        The controller that will hold the gains; its set-point weight and filter are then no part of the design.
    overshoot : float
        Overshoot after a set-point step, share of the step, above which the error counts more: it matters for a device,
        whose set-point weight is fixed.

    Raises
    ------
    InputError
        A limit that no controller can keep, or that is not a number; names the field.
    """

    Ms: float = 1.4
    Mt: float = 1.4
    controller: Controller = Controller.PID
    purpose: Purpose = Purpose.LOAD
    noise: NoiseLimit | None = None
    filter_ratio: float = 10.0
    derivative_ratio: float = math.inf
    device: DeviceController | None = None
    overshoot: float = math.inf

    def __post_init__(self) -> None:
        for name in ("Ms", "Mt"):
            value = getattr(self, name)
            if not SMALLEST_MS <= value <= LARGEST_MS:
                raise InputError(
                    f"must lie between {SMALLEST_MS:g} and {LARGEST_MS:g}; every real loop has a sensitivity above 1",
                    field=f"requirements.{name}",
                    value=value,
                    remedy="Use 1.25 for a calm, 1.4 for a balanced, 1.7 for a brisk loop.",
                )
        for name in ("filter_ratio", "derivative_ratio"):
            if not getattr(self, name) > 0.0:
                raise InputError(
                    "must be positive",
                    field=f"requirements.{name}",
                    value=getattr(self, name),
                    remedy="Leave it at its default.",
                )


GOALS: dict[str, float] = {"calm": 1.25, "balanced": 1.4, "brisk": 1.7}
"""Largest `Ms` and `Mt` by goal."""
OVERSHOOT: dict[str, float] = {"calm": 0.05, "balanced": 0.1, "brisk": 0.2}
"""Overshoot that a goal aims at in a device with a fixed set-point weight, share of the step."""


MOVEMENT: dict[str, float] = {"calm": 0.0025, "balanced": 0.005, "brisk": 0.01}
"""Largest standard deviation of the output that noise and resolution of the PV may cause, by goal.

It is a share of the output's span. A control valve may leave changes of 1 % unanswered (dead band and stick-slip
together: EnTech, Control Valve Dynamic Specification 3.0, 1998). With 0.5 %, nineteen movements in twenty stay below
that: they would wear the valve without effect. Movement as a requirement besides robustness: Garpinger, Hagglund and
Astrom, J. Process Control 24, 2014.
"""


def requirements_for(goal: str | Requirements) -> Requirements:
    """Return the requirements of a goal by name; requirements are returned as they are.

    Raises
    ------
    InputError
        No goal has this name.
    """
    if isinstance(goal, Requirements):
        return goal
    if goal not in GOALS:
        raise InputError("is not a known goal", field="goal", value=goal, remedy=f"Use one of {', '.join(GOALS)}.")
    return Requirements(Ms=GOALS[goal], Mt=GOALS[goal])
