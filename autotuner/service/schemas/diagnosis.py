"""Schemas of a diagnosis."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from autotuner.core.model.process import STRUCTURES
from autotuner.core.recording.csv_text import SYNONYMS
from autotuner.service.schemas.resources import JsonObject, Response

PARAMETERS = ("K", "T", "T1", "T2", "T3", "m", "n", "Z", "D")


class DiagnosisChoice(BaseModel):
    """Columns of an uploaded recording, and the declared model: structure and parameters, or nothing."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    structure: str | None = Field(default=None, description=f"Of the declared model: {', '.join(STRUCTURES)}.")
    K: float | None = Field(default=None, allow_inf_nan=False, description="Static gain, PV/output.")
    T: float | None = Field(default=None, allow_inf_nan=False, description="Time constant, s.")
    T1: float | None = Field(default=None, allow_inf_nan=False, description="Larger time constant, s.")
    T2: float | None = Field(default=None, allow_inf_nan=False, description="Smaller time constant, s.")
    T3: float | None = Field(default=None, allow_inf_nan=False, description="Smallest of three time constants, s.")
    m: float | None = Field(default=None, allow_inf_nan=False, description="Coefficient of s^2, s^2.")
    n: float | None = Field(
        default=None, allow_inf_nan=False, description="Coefficient of s, s; or number of equal lags."
    )
    Z: float | None = Field(default=None, allow_inf_nan=False, description="Right-half-plane zero, s.")
    D: float | None = Field(default=None, allow_inf_nan=False, description="Dead time, s.")
    t_column: str | None = Field(default=None, description="Column of the time, s or ISO 8601.")
    output_column: str | None = Field(default=None, description="Column of the controller output.")
    pv_column: str | None = Field(default=None, description="Column of the process variable.")
    set_point_column: str | None = Field(default=None, description="Column of the set point.")

    points: int | None = Field(
        default=None, ge=100, le=20000, description="Most points of curves to draw; left out: no curves."
    )
    time_limit_s: float | None = Field(
        default=None,
        gt=0.0,
        allow_inf_nan=False,
        description="Time limit of the search, s; after it the verdict is `unexplained` with the best so far.",
    )

    def columns(self) -> dict[str, str]:
        """Return the chosen columns by their meaning."""
        chosen = {role: getattr(self, f"{role}_column", None) for role in SYNONYMS}
        return {role: column for role, column in chosen.items() if column is not None}

    def declared(self) -> dict[str, object] | None:
        """Return the declared model by its parameters; None when nothing was declared."""
        values = {name: getattr(self, name) for name in PARAMETERS if getattr(self, name) is not None}
        if not values and self.structure is None:
            return None
        return {"structure": self.structure, **values} if self.structure is not None else dict(values)


class FoundEffect(Response):
    """One effect that the record shows; a value may be null where it is not finite."""

    name: str
    place: Literal["actuator", "process", "disturbance", "sensor"]
    form: str
    parameters: dict[str, float | None]
    interval95: dict[str, tuple[float | None, float | None]]
    units: dict[str, str] = Field(default={}, description="In terms of `output` and `PV`; empty for ratios.")
    confidence: float | None
    indistinguishable: list[str]
    advice: str


class Misfit(Response):
    """Root mean square errors on one part of the record, PV units."""

    before: float | None
    after: float | None
    noise: float | None
    expected: float | None = Field(
        default=None,
        description="What a perfect model leaves: noise, the sensor's effects, unknown latenesses.",
    )


class DiagnosisCurves(Response):
    """Measured PV, and the simulated one without and with the effects; from `held_out_from_s` on nothing was fitted."""

    t_s: list[float]
    output: list[float]
    pv: list[float]
    before: list[float | None]
    after: list[float | None]
    residual_before: list[float | None]
    residual_after: list[float | None]
    held_out_from_s: float


class Diagnosis(Response):
    """The diagnosis of a recording: fit of the model, and effects that the model lacks."""

    verdict: Literal["adequate", "explained", "partly_explained", "unexplained"]
    summary: str
    effects: list[FoundEffect]
    runner_up: JsonObject | None
    error: dict[Literal["fitted", "selection", "held_out"], Misfit]
    missing: list[JsonObject] = Field(
        default=[],
        description="Without an explanation: dependence of the residual on single variables, with shares and shapes.",
    )
    blocks: list[Misfit] = Field(default=[], description="Errors of five equal parts of a long record, in time.")
    model: JsonObject
    gains: JsonObject
    notes: list[str]
    curves: DiagnosisCurves | None = Field(default=None, description="Where points were requested.")
