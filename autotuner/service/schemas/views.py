"""Schemas for display: plans, curves, gains of every goal, the analysis of an uploaded recording."""

from __future__ import annotations

from pydantic import Field

from autotuner.core.experiment.phases import Phase  # noqa: TC001 - pydantic reads the annotations
from autotuner.service.schemas.resources import (
    IN_DEVICE,
    JITTER,
    JITTER_LIMIT,
    ControllerAdvice,
    HeldGains,
    JsonObject,
    Margins,
    PidGains,
    Predicted,
    Response,
    Result,
)


class RelayLevels(Response):
    """The two levels of the relay, output units; `one_sided` where the present output leaves no room on one side."""

    low: float
    high: float
    one_sided: bool


class PlannedStep(Response):
    """One phase of a test with its description."""

    phase: Phase
    text: str


class Plan(Response):
    """Plan of a tuning; `output` and `levels` are null without the present output."""

    output: float | None
    levels: RelayLevels | None
    amplitude: float
    quiet_s: float
    longest_s: float
    steps: list[PlannedStep]
    settings: JsonObject


class Curves(Response):
    """Measured and simulated PV by columns; null where the loop was open, and where there is no model."""

    t_s: list[float]
    output: list[float]
    pv: list[float]
    set_point: list[float | None] | None
    model: list[float] | None
    residual: list[float] | None
    settings: JsonObject


class LoopResponses(Response):
    """Predicted responses to a step of the set point and of the load, deviations from rest."""

    t_s: list[float]
    step_pv: list[float | None]
    step_output: list[float | None]
    load_pv: list[float | None]
    load_output: list[float | None]
    set_point_step: float = Field(description="Size of the step of the set point, PV units.")
    load_step: float = Field(description="Size of the step of the load, output units.")
    effects: list[str] = Field(description="Effects between output and process that take part.")


class Choice(Response):
    """Gains of one goal, or of another requested design, with their predicted response."""

    name: str
    asked: dict[str, str | float] = Field(description="Body of a request for these gains.")
    goal: str | None
    rule: str
    gains: PidGains
    margins: Margins | None
    iae: float | None
    overshoot: float | None
    intervals: dict[str, tuple[float | None, float | None]]
    jitter: float | None = Field(description=JITTER)
    jitter_limit: float | None = Field(default=None, description=JITTER_LIMIT)
    warnings: list[str]
    responses: LoopResponses
    device: HeldGains | None = Field(default=None, description=IN_DEVICE)
    predicted: Predicted | None = None
    advice: ControllerAdvice | None = Field(default=None, description="Null where parts cannot be compared.")


class Choices(Response):
    """The gains to choose from."""

    choices: list[Choice]


class Identification(Result):
    """The analysis of an uploaded recording."""

    samples: int
    duration_s: float
    notes: list[str]
    curves: Curves | None = Field(default=None, description="Where points were requested.")
    choices: list[Choice] | None = Field(default=None, description="Where points were requested.")
