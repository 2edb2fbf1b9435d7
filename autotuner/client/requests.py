"""The parameters of each call: names, types and units as in the service's API document."""

from __future__ import annotations

from typing import Required, TypedDict


class OnlineController(TypedDict, total=False):
    """A controller in the ideal form in parallel with the relay; times in s."""

    Kp: float
    Ti: float | None
    Td: float
    Tf: float | None
    b: float


class GainsSpec(TypedDict, total=False):
    """The requested design."""

    goal: str
    rule: str | None
    Ms: float | None
    controller: str
    purpose: str
    tau_c_s: float | None
    jitter: float | None


class TuningStart(GainsSpec, total=False):
    """Options of a tuning; by default they follow from the loop's configuration and from the measured noise."""

    amplitude: float | None
    ratio: float | None
    pv_amplitude: float | None
    max_amplitude: float | None
    side: str | None
    drift_compensation: bool | None
    hysteresis: float | None
    quiet_s: float | None
    min_periods: int | None
    max_periods: int | None
    accuracy: float | None
    check: bool | None
    response_limit_s: float | None
    time_limit_s: float | None
    online: OnlineController | None
    structure: str
    budget_ms: float | None
    apply: bool
    verify: bool


class GainsChoice(GainsSpec, total=False):
    """Which gains to compute from the identified model."""


class GainsToApply(GainsSpec, total=False):
    """Which gains to write: those of the tuning, or, where a design is requested, others from its model."""


class IdentificationChoice(GainsSpec, total=False):
    """Options for an uploaded recording; a column is named by its title, or by its number from 1."""

    structure: str
    known_gain: float | None
    t_column: str | None
    output_column: str | None
    pv_column: str | None
    set_point_column: str | None
    written_column: str | None
    moments: str
    disturbance: list[str]
    start_s: float | None
    end_s: float | None
    points: int | None


class DiagnosisChoice(TypedDict, total=False):
    """Columns of a recording, and the declared model: structure and parameters, or nothing."""

    structure: str | None
    K: float | None
    T: float | None
    T1: float | None
    T2: float | None
    T3: float | None
    m: float | None
    n: float | None
    Z: float | None
    D: float | None
    t_column: str | None
    output_column: str | None
    pv_column: str | None
    set_point_column: str | None
    points: int | None
    time_limit_s: float | None


class ScheduleStart(GainsSpec, total=False):
    """Operating points, and how to tune at each."""

    set_points: Required[list[float]]
    variable: str
    hysteresis: float | None
    check: bool | None
    structure: str


class TuningsToCombine(TypedDict, total=False):
    """Tunings at several operating points of one loop."""

    tuning_ids: Required[list[str]]
    variable: str
    hysteresis: float | None


class MonitorStart(TypedDict, total=False):
    """Expected behaviour of a loop and length of the window; by default: its last tuning, some hundred periods."""

    tuning_id: str | None
    window_s: float | None
