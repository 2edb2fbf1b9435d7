"""Schemas of requests, closed to unknown keys; units in names.

Invariant: strict types: a text is not a number, and neither is true.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from fastapi import Header, Query
from pydantic import BaseModel, ConfigDict, Field
from pydantic_core import CoreSchema, core_schema

from autotuner.core.design import GOALS, DesignSpec, rule_names
from autotuner.core.design.requirements import LARGEST_MS, SMALLEST_MS
from autotuner.core.experiment.settings import Side  # noqa: TC001 - pydantic reads the annotations
from autotuner.core.model.process import STRUCTURES
from autotuner.core.recording.csv_text import SYNONYMS

if TYPE_CHECKING:
    from collections.abc import Iterable


@dataclass(frozen=True, slots=True)
class OneOf:
    """Marks a text as one of the names of a table."""

    names: Iterable[str]

    def __get_pydantic_core_schema__(self, _: object, __: object) -> CoreSchema:
        """Return the names as literals, for the check and for the API document."""
        return core_schema.literal_schema(list(self.names))


Structure = Annotated[str, OneOf(("auto", *STRUCTURES))]
Goal = Annotated[str, OneOf(tuple(GOALS))]
Rule = Annotated[str, OneOf(rule_names())]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
Variable = Literal["set_point", "output"]
Sensitivity = Annotated[float, Field(ge=SMALLEST_MS, le=LARGEST_MS, allow_inf_nan=False)]
Controller = Literal["P", "PI", "PID"]
Purpose = Literal["load", "set_point"]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
PresentOutput = Annotated[
    float | None, Query(allow_inf_nan=False, description="Present output, output units, where known.")
]
IdempotencyKey = Annotated[
    str | None,
    Header(
        min_length=8,
        max_length=200,
        pattern=r"^[!-~]+$",
        description="Made by the client for this one start: sent again with it, the request starts nothing new.",
    ),
]


class Request(BaseModel):
    """Base of requests."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class OnlineController(Request):
    """A controller in the ideal form in parallel with the relay; times in s."""

    Kp: float = Field(allow_inf_nan=False, description="Proportional gain, output/PV.")
    Ti: Positive | None = Field(default=None, description="Integral time, s; null: no integral action.")
    Td: NotNegative = Field(default=0.0, description="Derivative time, s.")
    Tf: NotNegative | None = Field(default=None, description="Filter time, s; null: a tenth of the derivative time.")
    b: float = Field(default=1.0, allow_inf_nan=False, description="Weight of the set point.")


class GainsSpec(BaseModel):
    """The requested design."""

    goal: Goal = Field(default="balanced", description="Goal of the gains; ignored when a rule or Ms is given.")
    rule: Rule | None = Field(default=None, description="A tuning rule instead of a goal.")
    Ms: Sensitivity | None = Field(
        default=None, description="Largest sensitivity and complementary sensitivity, instead of the goal's."
    )
    controller: Controller = Field(default="PID", description="Parts that the controller may have.")
    purpose: Purpose = Field(default="load", description="After which step the error is made small.")
    tau_c_s: Positive | None = Field(
        default=None, description="Wanted closed-loop time constant, s: for rules that take one, else as far as robust."
    )
    jitter: Positive | None = Field(
        default=None,
        description="Largest standard deviation of the output that the measured noise may cause, output units.",
    )

    def spec(self) -> DesignSpec:
        """Return the requested values."""
        return DesignSpec(**{name: getattr(self, name) for name in GainsSpec.model_fields})


class TuningStart(Request, GainsSpec):
    """Options of a tuning; by default they follow from the configuration of the loop and from the measured noise."""

    amplitude: Positive | None = Field(default=None, description="Half the relay swing, output units.")
    ratio: float | None = Field(
        default=None, ge=1.0, le=5.0, description="Upper over lower part of the swing; 1: symmetric."
    )
    pv_amplitude: Positive | None = Field(
        default=None,
        description="Requested amplitude of the PV, zero to peak, to which the relay amplitude is adapted.",
    )
    max_amplitude: Positive | None = Field(
        default=None, description="Largest relay amplitude that adaptation may reach, output units."
    )
    side: Side | None = Field(
        default=None, description="Side of output zero on which the relay stays, where the output heats and cools."
    )
    drift_compensation: bool | None = Field(
        default=None, description="Whether a PV that drifts at rest is followed instead of refused."
    )
    hysteresis: NotNegative | None = Field(default=None, description="Half width of the relay's dead zone, PV units.")
    quiet_s: Positive | None = Field(default=None, description="Time to watch the loop at rest, s.")
    min_periods: int | None = Field(default=None, ge=2, le=1000, description="Fewest full periods.")
    max_periods: int | None = Field(default=None, ge=2, le=1000, description="Most full periods.")
    accuracy: float | None = Field(
        default=None, gt=0.0, le=1.0, description="Relative standard error at which to stop."
    )
    check: bool | None = Field(
        default=None, description="Whether the check for effects that a relay does not show follows."
    )
    response_limit_s: Positive | None = Field(
        default=None, description="Longest wait for the first answer of the PV, s."
    )
    time_limit_s: Positive | None = Field(default=None, description="Longest time for everything, s.")
    online: OnlineController | None = Field(default=None, description="Controller in parallel with the relay.")
    structure: Structure = Field(default="auto", description="Process structure to identify.")
    budget_ms: Positive | None = Field(
        default=None,
        description="Processor time of the analysis, ms: where least squares needs more, the gains are those of the "
        "learned correction. Null: no limit.",
    )
    apply: bool = Field(default=False, description="Whether the gains are written into the device at the end.")
    verify: bool = Field(
        default=False, description="Whether they are then verified by a small step, and go back unless that passes."
    )

    def overrides(self) -> dict[str, object]:
        """Return the settings of the experiment that were given."""
        others = {"structure", "budget_ms", "apply", "verify", *GainsSpec.model_fields}
        return self.model_dump(exclude=others, exclude_none=True)


class GainsChoice(Request, GainsSpec):
    """Which gains to compute from the identified model."""


class IdentificationChoice(GainsSpec):
    """Options for an uploaded recording; a column is named by its title, or by its number from 1."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    structure: Structure = Field(default="auto", description="Process structure to identify.")
    known_gain: float | None = Field(
        default=None, allow_inf_nan=False, description="Static gain where known, PV/output."
    )
    moments: Literal["auto", "exact", "between"] = Field(
        default="auto", description="When the output changed: at its samples, or between them (sampled afterwards)."
    )
    disturbance: list[str] = Field(
        default=[], max_length=8, description="Further columns that move the PV too, such as another heater."
    )
    start_s: float | None = Field(default=None, allow_inf_nan=False, description="Only samples from then on, s.")
    end_s: float | None = Field(default=None, allow_inf_nan=False, description="Only samples until then, s.")
    t_column: str | None = Field(default=None, description="Column of the time, s or ISO 8601.")
    output_column: str | None = Field(default=None, description="Column of the controller output.")
    pv_column: str | None = Field(default=None, description="Column of the process variable.")
    set_point_column: str | None = Field(default=None, description="Column of the set point.")
    written_column: str | None = Field(default=None, description="Column of the times from which the output acts, s.")
    points: int | None = Field(
        default=None, ge=100, le=20000, description="Also return curves with at most this many points, and every goal."
    )

    def window_s(self) -> tuple[float, float] | None:
        """Return start and end of the requested part, s; None for everything."""
        if self.start_s is None and self.end_s is None:
            return None
        return (
            -math.inf if self.start_s is None else self.start_s,
            math.inf if self.end_s is None else self.end_s,
        )

    def columns(self) -> dict[str, str]:
        """Return the chosen columns by their meaning."""
        chosen = {role: getattr(self, f"{role}_column") for role in SYNONYMS}
        return {role: column for role, column in chosen.items() if column is not None}


class GainsToApply(Request, GainsSpec):
    """Which gains to write to the device: those of the tuning or, for a requested design, others from its model."""

    def is_as_tuned(self) -> bool:
        """Return whether no design is requested."""
        return not self.model_fields_set & set(GainsSpec.model_fields)


class MonitorStart(Request):
    """Expected behaviour of a loop, and length of the window."""

    tuning_id: str | None = Field(
        default=None,
        description="The tuning whose model gives the expected behaviour; null: the last one of this run with a model.",
    )
    window_s: Positive | None = Field(
        default=None, description="Length of the compared window, s; null: some hundred periods of the loop."
    )


class VerificationStart(Request):
    """Options for the verification of applied gains."""

    step: Positive | None = Field(default=None, description="Step of the set point, PV units; null: from the noise.")


class ScheduleStart(Request, GainsSpec):
    """Operating points, and how to tune at each."""

    set_points: list[Annotated[float, Field(allow_inf_nan=False)]] = Field(
        min_length=2, max_length=20, description="Operating points in the order in which they are visited, PV units."
    )
    variable: Variable = Field(default="set_point", description="What the gains are scheduled by.")
    hysteresis: NotNegative | None = Field(
        default=None, description="Of the schedule, units of the variable; null: a tenth of the smallest distance."
    )
    check: bool | None = Field(
        default=None, description="Whether the check for effects that a relay does not show follows."
    )
    structure: Structure = Field(default="auto", description="Process structure to identify.")


class TuningsToCombine(Request):
    """Tunings at several operating points of one loop."""

    tuning_ids: list[str] = Field(min_length=2, max_length=50, description="Tunings of one loop that ended with gains.")
    variable: Variable = Field(default="output", description="What the gains are scheduled by.")
    hysteresis: NotNegative | None = Field(
        default=None, description="Of the schedule, units of the variable; null: a tenth of the smallest distance."
    )


class Undo(Request):
    """Options for the restore of the previous gains."""

    force: bool = Field(default=False, description="Overwrite gains that were changed by others.")
