"""Operating point: measurements of a loop at rest, and the relay that follows from them.

    hysteresis = 3 s, and the resolution of the sensor at least, unless it was given

`s` standard deviation of the PV at rest, slow noise included, PV units. A noise sample then crosses the dead zone once
in 700, and a single step of the sensor's last digit does not switch the relay.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from autotuner.core.experiment.relay import Relay

if TYPE_CHECKING:
    from autotuner.core.experiment.relay import Levels
    from autotuner.core.experiment.settings import ExperimentSettings
    from autotuner.core.signals.quiet import QuietMeasurement

NOISE_MULTIPLE = 3.0
"""Standard deviations of the PV at rest that are no move: 0.3 % of normal samples lie beyond."""
PERCEPTIBLE = 1e-3
"""Share of the PV that counts as a move where neither noise nor resolution sets a scale."""
TINY = 1e-9
"""Smallest perceptible move, PV units, of a PV that rests at exactly 0 without noise."""


@dataclass(frozen=True, slots=True)
class OperatingPoint:
    """A loop at rest: initial values of the later stages.

    Attributes
    ----------
    settings : ExperimentSettings
        How the experiment is run.
    output : float
        Output at rest, output units.
    levels : Levels
        Relay levels placed around it.
    quiet : QuietMeasurement
        What was measured at rest.
    drift : QuietMeasurement or None
        Rest of a PV that drifts, where the drift must be small compared with the relay's oscillation; else None.
    is_followed : bool
        Whether the reference of the relay moves with that drift.
    half_s : float
        Longest half period under an earlier relay, s; 0 without one.
    """

    settings: ExperimentSettings
    output: float
    levels: Levels
    quiet: QuietMeasurement
    drift: QuietMeasurement | None = None
    is_followed: bool = True
    half_s: float = 0.0

    @property
    def hysteresis(self) -> float:
        """Half width of the relay's dead zone, PV units."""
        if self.settings.hysteresis is not None:
            return self.settings.hysteresis
        return max(NOISE_MULTIPLE * self.quiet.disturbance_sigma, self.quiet.resolution)

    @property
    def perceptible(self) -> float:
        """Smallest move of the PV that is taken for one, PV units, for a sensor that shows neither noise nor steps."""
        return max(PERCEPTIBLE * abs(self.quiet.pv), TINY)

    def relay_about(self, reference: float) -> Relay:
        """Return the relay that switches around `reference`, PV units."""
        direct = self.settings.direct
        return Relay(self.levels.low, self.levels.high, reference, self.hysteresis, direct=direct)
