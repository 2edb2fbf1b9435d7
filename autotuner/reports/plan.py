"""Plan of a test: its effect on the process, before it starts.

Invariant: levels and times are those of the experiment itself (`place_levels`, `ExperimentSettings`); the plan
states where they depend on measurements at rest, instead of a guess.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from autotuner.core.experiment.phases import Phase
from autotuner.core.experiment.relay import place_levels

if TYPE_CHECKING:
    from autotuner.core.experiment.relay import Levels
    from autotuner.core.experiment.settings import ExperimentSettings


@dataclass(frozen=True, slots=True)
class PlannedStep:
    """One phase with its description."""

    phase: Phase
    text: str


@dataclass(frozen=True, slots=True)
class Plan:
    """Plan of a test.

    Attributes
    ----------
    output : float or None
        Present output, output units; None when it is not known.
    levels : Levels or None
        The relay's levels around it; None when it is not known, or leaves no room.
    amplitude : float
        Half the swing that the relay starts with, output units.
    quiet_s, longest_s : float
        Time at rest, and the longest time for everything, s.
    steps : tuple of PlannedStep
        The phases in their order.
    """

    output: float | None
    levels: Levels | None
    amplitude: float
    quiet_s: float
    longest_s: float
    steps: tuple[PlannedStep, ...]

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return {**asdict(self), "steps": [{"phase": step.phase.value, "text": step.text} for step in self.steps]}


def plan(settings: ExperimentSettings, output: float | None, output_unit: str = "", pv_unit: str = "") -> Plan:
    """Return the plan of an experiment from the present output, None when that is not known."""
    levels = None
    if output is not None:
        levels = place_levels(output, settings.half_swing, settings.ratio, settings.relay_limits)
    steps = (
        PlannedStep(Phase.QUIET, _quiet(settings)),
        PlannedStep(Phase.RELAY, _relay(settings, levels, output_unit, pv_unit)),
        PlannedStep(Phase.CHECK, _check(settings)),
        PlannedStep(Phase.RESTORE, _restore(output, output_unit)),
    )
    return Plan(output, levels, settings.half_swing, settings.quiet_duration_s, settings.time_limit_s, steps)


def _quiet(settings: ExperimentSettings) -> str:
    return (
        f"Nothing moves for {settings.quiet_duration_s:g} s: noise and drift of the PV are measured. "
        "A PV that drifts is refused, with advice."
    )


def _relay(settings: ExperimentSettings, levels: Levels | None, output_unit: str, pv_unit: str) -> str:
    swing = f"by {2.0 * settings.half_swing:g} {output_unit}".rstrip()
    if levels is not None:
        swing = f"between {levels.low:.4g} and {levels.high:.4g} {output_unit}".rstrip()
    dead_zone = "three times the measured noise"
    if settings.hysteresis is not None:
        dead_zone = f"{settings.hysteresis:g} {pv_unit}".rstrip()
    return (
        f"The output switches {swing} whenever the PV leaves a band of half width {dead_zone}, for "
        f"{settings.min_periods} to {settings.max_periods} periods of oscillation, until period and amplitude are "
        f"known to {100.0 * settings.accuracy:g} %."
    )


def _check(settings: ExperimentSettings) -> str:
    if not settings.check:
        return "Left out on request: dead-band, friction and the like cannot be seen."
    return (
        "The relay at half its amplitude, a staircase of small holds, and a short tail that no model is fitted to: "
        "they show what a relay does not."
    )


def _restore(output: float | None, output_unit: str) -> str:
    where = "where it was" if output is None else f"{output:.4g} {output_unit}".rstrip()
    return f"The output goes back to {where}, whatever ended the test, and is read back where the device allows it."
