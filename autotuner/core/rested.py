"""A loop at rest: what was measured there, and the relay that follows from it.

    hysteresis = 3 sigma, and the resolution of the sensor at least, unless it was given

`sigma` noise, PV units. A noise sample then crosses the dead zone once in 700, and a single step of the sensor's last
digit does not switch the relay.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from autotuner.core.relay import Relay

if TYPE_CHECKING:
    from autotuner.core.relay import Levels
    from autotuner.core.settings import ExperimentSettings
    from autotuner.core.signals.quiet import QuietMeasurement

NOISE_MULTIPLE = 3.0
PERCEPTIBLE = 1e-3
"""Share of the PV that counts as a move where neither noise nor resolution says what does."""
TINY = 1e-9


@dataclass(frozen=True, slots=True)
class Rested:
    """A loop at rest: what the later stages start from.

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
    """

    settings: ExperimentSettings
    output: float
    levels: Levels
    quiet: QuietMeasurement

    @property
    def hysteresis(self) -> float:
        """Half width of the relay's dead zone, PV units."""
        if self.settings.hysteresis is not None:
            return self.settings.hysteresis
        return max(NOISE_MULTIPLE * self.quiet.noise_sigma, self.quiet.resolution)

    @property
    def perceptible(self) -> float:
        """Smallest move of the PV that is taken for one, PV units, for a sensor that shows neither noise nor steps."""
        return max(PERCEPTIBLE * abs(self.quiet.pv), TINY)

    def relay_about(self, reference: float) -> Relay:
        """Return the relay that switches around `reference`, PV units."""
        direct = self.settings.direct
        return Relay(self.levels.low, self.levels.high, reference, self.hysteresis, direct=direct)
