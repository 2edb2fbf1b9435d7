"""Schemas of a monitored loop."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from autotuner.core.monitoring.changes import CODES
from autotuner.service.schemas.requests import OneOf
from autotuner.service.schemas.resources import Response


class Oscillation(Response):
    """A regular oscillation of the control error; period in s, amplitude in PV units."""

    period_s: float
    amplitude: float
    regularity: float = Field(description="Over 1: its periods are alike.")


class ProcessChange(Response):
    """A parameter of the process as it was tuned for, and as this window shows it."""

    expected: float
    found: float
    interval95: tuple[float, float]


class Findings(Response):
    """The judgement of the last window; errors in PV units."""

    code: Annotated[str, OneOf(sorted(CODES))]
    message: str
    remedy: str
    error: float = Field(description="Root mean square of measured minus expected PV.")
    noise: float
    oscillation: Oscillation | None
    process: dict[str, ProcessChange] = Field(description="Empty where the window could not show the process.")
    Ms: tuple[float | None, float | None] | None = Field(
        description="With the gains in the device, on the process expected and on the one found; null: unstable."
    )
    effects: dict[str, dict[str, float]] = Field(description="Friction with its sizes, output units.")
    notes: list[str]


class Monitoring(Response):
    """Whether and how a loop is watched; `state` is off where it is not, and everything else null."""

    loop: str
    state: Literal["watching", "off"]
    tuning_id: str | None = Field(default=None, description="The tuning whose model gives the expected behaviour.")
    started_at: str | None = None
    every_s: float | None = Field(default=None, description="Time between two samples.")
    window_s: float | None = Field(default=None, description="Length of the compared window, s.")
    seen_s: float | None = Field(default=None, description="How much of it there is.")
    judged_at: str | None = None
    findings: Findings | None = Field(default=None, description="Null until the first window is judged.")
    trouble: str | None = Field(default=None, description="Why nothing is read or judged now.")
