"""Controller of the device that will hold the gains: its form, registers and algorithm.

    u = Kp (b r - y + (1/Ti) int(r - y) - Td dyd/dt),   yd = y / (1 + s Td/N)

A device takes the three numbers. The set-point weight `b` and the derivative filter `N` are fixed; the
measurement filter `Tf` of a design is not one of its settings.

Invariants: design, margins and prediction are for this controller; gains that the device cannot
hold are refused with the reason, never changed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from autotuner.core.design.forms.held_gains import HeldGains, held_by_device
from autotuner.core.design.forms.pid_forms import Spans, Structure
from autotuner.core.design.forms.presets import form_named
from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.design.gains import PidGains
    from autotuner.core.model.process import ProcessModel

SERIES_RATIO = 0.25
"""Largest `Td/Ti` of a series controller: its two zeros are real."""


@dataclass(frozen=True, slots=True)
class DeviceController:
    """Properties of a device's PID controller that a design cannot change.

    Attributes
    ----------
    form : str
        Name of its form, one of `FORMS`.
    b : float
        Weight of the set point.
    N : float
        Filter of the derivative, as in `PidGains`.
    derivative : bool
        Whether it has derivative action.
    spans : Spans
        Full spans of PV and output, for forms that normalise.
    resolution : mapping of str to float
        Smallest step of ``gain``, ``integral``, ``derivative`` in its registers.
    scan_s : float
        Time between two moves of the controller, s; 0: not known.
    slew_per_s : float
        Fastest change of its output, output units/s.
    """

    form: str = "ideal"
    b: float = 1.0
    N: float = math.inf
    derivative: bool = True
    spans: Spans = field(default_factory=Spans)
    resolution: Mapping[str, float] = field(default_factory=dict)
    scan_s: float = 0.0
    slew_per_s: float = math.inf

    @property
    def derivative_ratio(self) -> float:
        """Largest `Td/Ti` that the form can hold."""
        return SERIES_RATIO if form_named(self.form).structure is Structure.SERIES else math.inf

    def as_run(self, gains: PidGains) -> PidGains:
        """Return the controller that the three numbers make in the device, before rounding."""
        return replace(gains, Tf=0.0, b=self.b, N=self.N)

    def held(self, gains: PidGains, model: ProcessModel | None = None) -> HeldGains:
        """Return the gains as the device holds them, with margins on the model.

        Raises
        ------
        InputError
            The form, its steps, or a device without derivative action cannot hold them.
        """
        if gains.Td > 0.0 and not self.derivative:
            raise InputError(
                "cannot be held: the device has no derivative",
                field="gains.Td",
                value=gains.Td,
                remedy="Choose a rule of a PI controller, such as amigo_pi, or map gains.derivative.",
            )
        return held_by_device(
            gains, self.form, spans=self.spans, resolution=self.resolution, model=model, fixed_b=self.b, fixed_N=self.N
        )
