"""What goes over the wire: requests, closed to unknown keys, and responses; units in names.

Rules of this file:

1. A request is read strictly: a text is no number, and neither is true.
2. A response is described in full, and the tests hold it to that; a client passes over a key that it does not know.
3. A number that is not finite is null, because JSON has no other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, JsonValue
from pydantic_core import CoreSchema, core_schema

from autotuner.configuration import GainsTable, LimitsTable, RelayTable  # noqa: TC001 - pydantic reads the annotations
from autotuner.core.phases import Phase  # noqa: TC001 - pydantic reads the annotations
from autotuner.core.process import STRUCTURES
from autotuner.core.recording_csv import SYNONYMS
from autotuner.core.settings import Side  # noqa: TC001 - pydantic reads the annotations
from autotuner.core.tuning import GOALS, rule_names
from autotuner.core.verdict import Outcome  # noqa: TC001 - pydantic reads the annotations

if TYPE_CHECKING:
    from collections.abc import Iterable

JsonObject = dict[str, JsonValue]


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
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]


class Request(BaseModel):
    """Base of requests."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class Response(BaseModel):
    """Base of responses."""

    model_config = ConfigDict(extra="allow", frozen=True)


class OnlineController(Request):
    """A controller in the ideal form that keeps running beside the relay; times in s."""

    Kp: float = Field(allow_inf_nan=False, description="Proportional gain, output/PV.")
    Ti: Positive | None = Field(default=None, description="Integral time, s; null: no integral action.")
    Td: NotNegative = Field(default=0.0, description="Derivative time, s.")
    Tf: NotNegative | None = Field(default=None, description="Filter time, s; null: a tenth of the derivative time.")
    b: float = Field(default=1.0, allow_inf_nan=False, description="Weight of the set point.")


class TuningStart(Request):
    """How to tune; what is left out follows from the configuration of the loop and from the measured noise."""

    amplitude: Positive | None = Field(default=None, description="Half the relay swing, output units.")
    ratio: float | None = Field(
        default=None, ge=1.0, le=5.0, description="Upper over lower part of the swing; 1: symmetric."
    )
    pv_amplitude: Positive | None = Field(
        default=None, description="Wished amplitude of the PV, zero to peak, to which the relay amplitude is adapted."
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
    check: bool | None = Field(default=None, description="Whether the check for what a relay does not show follows.")
    response_limit_s: Positive | None = Field(
        default=None, description="Longest wait for the first answer of the PV, s."
    )
    time_limit_s: Positive | None = Field(default=None, description="Longest time for everything, s.")
    online: OnlineController | None = Field(default=None, description="Controller beside the relay.")
    structure: Structure = Field(default="auto", description="Process structure to identify.")
    goal: Goal = Field(default="balanced", description="Goal of the gains; not looked at when a rule is given.")
    rule: Rule | None = Field(default=None, description="A tuning rule instead of a goal.")

    def overrides(self) -> dict[str, object]:
        """Return the settings of the experiment that were given."""
        return self.model_dump(exclude={"structure", "goal", "rule"}, exclude_none=True)


class GainsChoice(Request):
    """Which gains to compute from the identified model."""

    goal: Goal = Field(default="balanced", description="Goal of the gains; not looked at when a rule is given.")
    rule: Rule | None = Field(default=None, description="A tuning rule instead of a goal.")
    tau_c_s: Positive | None = Field(
        default=None, description="Wanted closed-loop time constant, s, for rules that take one."
    )


class IdentificationChoice(BaseModel):
    """How to read and identify an uploaded recording; a column is named by its title, or by its number from 1."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    structure: Structure = Field(default="auto", description="Process structure to identify.")
    known_gain: float | None = Field(
        default=None, allow_inf_nan=False, description="Static gain where it is known, PV/output."
    )
    goal: Goal = Field(default="balanced", description="Goal of the gains; not looked at when a rule is given.")
    rule: Rule | None = Field(default=None, description="A tuning rule instead of a goal.")
    t_column: str | None = Field(default=None, description="Column of the time, s or ISO 8601.")
    output_column: str | None = Field(default=None, description="Column of the controller output.")
    pv_column: str | None = Field(default=None, description="Column of the process variable.")
    set_point_column: str | None = Field(default=None, description="Column of the set point.")
    written_column: str | None = Field(default=None, description="Column of the times from which the output acts, s.")

    def columns(self) -> dict[str, str]:
        """Return the chosen columns by what they mean."""
        chosen = {role: getattr(self, f"{role}_column") for role in SYNONYMS}
        return {role: column for role, column in chosen.items() if column is not None}


class GainsToApply(Request):
    """Which gains to write to the device: those of the tuning, or others from its model."""

    goal: Goal | None = Field(default=None, description="Another goal than the tuning's.")
    rule: Rule | None = Field(default=None, description="A tuning rule instead of a goal.")


class Undo(Request):
    """How to put the old gains back."""

    force: bool = Field(default=False, description="Also over gains that somebody else has set since.")


class Links(Response):
    """Paths of a tuning and of what can be done with it."""

    self: str
    loop: str
    events: str
    recording: str
    abort: str
    gains: str
    apply: str
    rollback: str


class LoopLinks(Response):
    """Paths of a loop."""

    self: str
    tunings: str
    gains: str


class Loop(Response):
    """A configured loop."""

    name: str
    driver: str
    sample_time_s: float
    action: Literal["direct", "reverse"]
    pv_unit: str
    output_unit: str
    limits: LimitsTable
    relay: RelayTable
    gains: GainsTable | None = Field(description="How the device states its gains; null where that is not told.")
    tuning_id: str | None = Field(description="The tuning that holds the loop.")
    links: LoopLinks


class Loops(Response):
    """All loops."""

    loops: list[Loop]


class Verdict(Response):
    """How it ended; `code` is stable and meant for programs."""

    outcome: Outcome
    code: str
    message: str
    remedy: str


class PidGains(Response):
    """A PID controller in the ideal form; `Ti`, `Td`, `Tf` in s, `Ti` null without integral action."""

    controller: str
    Kp: float
    Ti: float | None
    Td: float
    Tf: float
    b: float


class Margins(Response):
    """Robustness on the model; null where it is infinite or the loop is unstable."""

    stable: bool
    Ms: float | None
    Mt: float | None
    gain_margin: float | None
    gain_reduction_margin: float | None
    phase_margin_deg: float | None
    delay_margin_s: float | None
    noise_gain: float | None


class Candidate(Response):
    """What one rule gives."""

    rule: str
    title: str
    source: str
    gains: PidGains
    margins: Margins | None
    iae: float | None = Field(description="Integral of the absolute error after a unit load step, PV s/output.")
    overshoot: float | None = Field(description="Overshoot after a set-point step, share of the step.")
    warnings: list[str]


class Gains(Response):
    """The gains recommended, and what they were chosen from."""

    goal: str | None
    rule: str
    gains: PidGains
    margins: Margins | None
    iae: float | None = Field(description="Integral of the absolute error after a unit load step, PV s/output.")
    overshoot: float | None = Field(description="Overshoot after a set-point step, share of the step.")
    intervals: dict[str, tuple[float | None, float | None]] = Field(description="95 % intervals of the gains.")
    alternatives: list[Candidate]
    warnings: list[str]


class DeviceGains(Response):
    """Gains in a device: the number of each signal, and the controller that they make (null: none)."""

    values: dict[str, float]
    gains: PidGains | None = None


class Change(Response):
    """The change of the gains that a rollback would undo."""

    tuning_id: str | None
    at: str
    old: dict[str, float]


class LoopGains(DeviceGains):
    """What a loop's device holds now, in its own form."""

    loop: str
    form: str
    action: Literal["direct", "reverse"]
    undo: Change | None = Field(description="What a rollback would undo.")


class Applied(Response):
    """Gains that were written and read back; `labels` are the numbers under the device's own names."""

    loop: str
    tuning_id: str | None
    at: str
    old: DeviceGains
    now: DeviceGains
    form: str
    labels: dict[str, float]
    action: Literal["direct", "reverse"]
    margins: Margins | None
    warnings: list[str]


class RolledBack(Response):
    """Gains that were put back and read back."""

    loop: str
    tuning_id: str | None
    at: str
    was: DeviceGains
    now: DeviceGains


class Result(Response):
    """What a recording told: the process, its limit cycle, every estimate, and gains; null where there is none."""

    structure: str | None = None
    model: JsonObject | None = None
    limit_cycle: JsonObject | None = None
    estimates: JsonObject | None = None
    recommended: str | None = None
    fit: JsonObject | None = None
    error: JsonObject | None = None
    gains: PidGains | None = None
    tuning: Gains | None = None
    warnings: list[str] = []
    verdict: Verdict | None = None


class Before(Response):
    """How the loop was found; `auto` is null where the device does not tell."""

    output: float
    auto: float | None


class Lateness(Response):
    """How late the samples came: median, 99th percentile and largest, s."""

    p50_s: float
    p99_s: float
    max_s: float


class Tuning(Result):
    """A tuning with all that is known of it now."""

    id: str
    loop: str
    state: Literal["running", "ended"]
    phase: Phase
    started_at: str
    samples: int
    settings: JsonObject
    before: Before | None
    restored: bool | None
    lateness: Lateness | None
    device_gains: dict[str, float] | None = Field(description="Numbers of the device's gains, by signal.")
    applied: Applied | None = Field(description="Gains of this tuning that the device holds.")
    links: Links


class TuningSummary(Response):
    """A tuning in a list."""

    id: str
    loop: str
    state: Literal["running", "ended"]
    phase: Phase
    started_at: str
    outcome: Outcome | None
    code: str | None
    links: Links


class Tunings(Response):
    """Tunings, the newest first."""

    tunings: list[TuningSummary]


class Recording(Response):
    """A recording by columns; `set_point` is null where the loop was open.

    `written_s` has the times from which the outputs act; it is null where these are `t_s`.
    """

    t_s: list[float]
    output: list[float]
    pv: list[float]
    written_s: list[float] | None
    set_point: list[float | None] | None
    settings: JsonObject
    notes: list[str]


class Identification(Result):
    """What an uploaded recording told."""

    samples: int
    duration_s: float
    notes: list[str]


class Health(Response):
    """Whether the service runs."""

    status: Literal["ok"] = "ok"


class ProblemType(Response):
    """A kind of problem."""

    type: str
    title: str
    status: int


class Problem(Response):
    """Problem details (RFC 9457)."""

    type: str = Field(description="A path of this service that lists the kinds of problems; about:blank: none of ours.")
    title: str
    status: int
    detail: str
    instance: str
    field: str | None = Field(default=None, description="Name of what was refused.")
    value: str | None = Field(default=None, description="What was refused.")
    remedy: str = Field(description="What to do next.")
    tuning_id: str | None = Field(default=None, description="The tuning in the way.")
    errors: list[JsonObject] | None = Field(
        default=None, description="Every value that was refused, when several were."
    )
