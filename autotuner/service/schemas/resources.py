"""Schemas of answers; units in names.

Invariants:

1. A response is described in full, and the tests hold it to that; a client passes over a key that it does not know.
2. A number that is not finite is null, because JSON has no other.
"""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, JsonValue

from autotuner.configuration import GainsTable, LimitsTable, RelayTable  # noqa: TC001 - pydantic reads the annotations
from autotuner.control.verification.verification_events import VerificationPhase  # noqa: TC001 - pydantic reads the annotations
from autotuner.core.experiment.phases import Phase  # noqa: TC001 - pydantic reads the annotations
from autotuner.core.verdict import Outcome  # noqa: TC001 - pydantic reads the annotations

JsonObject = dict[str, JsonValue]


class Response(BaseModel):
    """Base of responses."""

    model_config = ConfigDict(extra="allow", frozen=True)


OLD_NAME = "The same under its old name, for one version."


class Links(Response):
    """Paths of a tuning and of its operations."""

    self: str
    loop: str
    events: str
    recording: str
    report: str
    export: str
    abort: str
    gains: str
    apply: str
    verify: str
    verification_events: str = ""
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
    process_action: Literal["direct", "reverse"] = Field(
        description="Of the process: direct where a higher output raises the PV. Its controller is of the other action."
    )
    action: Literal["direct", "reverse"] = Field(description=OLD_NAME)
    pv_unit: str
    output_unit: str
    limits: LimitsTable
    relay: RelayTable
    gains: GainsTable | None = Field(description="How the device states its gains; null where that is not known.")
    tuning_id: str | None = Field(description="The tuning that holds the loop.")
    can_verify: bool = Field(
        default=False, description="Whether a step can be made: set point writable; PV, output and auto readable."
    )
    links: LoopLinks


class Loops(Response):
    """All loops."""

    loops: list[Loop]


class Reading(Response):
    """Present values of a loop: the last sample of a tuning, else the last poll of the device."""

    loop: str
    tuning_id: str | None = Field(description="The tuning that holds the loop.")
    at: str | None = Field(description="When that was, ISO 8601 in UTC.")
    pv: float | None
    output: float | None
    set_point: float | None
    auto: float | None
    error: str | None = Field(description="Error of the last poll.")
    link: Literal["up", "down", "unknown"] = Field(
        default="unknown", description="`unknown` before the first poll, and for a device that is not polled."
    )
    watch: str | None = Field(description="Of a loop that is watched: the judgement of its last window, or `watching`.")


class Readings(Response):
    """Present values of the loops."""

    readings: list[Reading]


class Verdict(Response):
    """Verdict; `code` is stable and meant for programs."""

    outcome: Outcome
    code: str
    message: str
    remedy: str


JITTER = "Standard deviation of the output that noise and resolution of the PV cause, output units; null: none known."
JITTER_LIMIT = "Limit of `jitter`: as requested, or the goal's share of the output's span; null: none."
CONTROLLER_ACTION = "Of the controller: reverse where a rising PV lowers the output, as a direct process needs."
IN_DEVICE = "In the device's form; null where that is not known, or it cannot hold them."


class PidGains(Response):
    """A PID controller in the ideal form; `Ti`, `Td`, `Tf` in s, `Ti` null without integral action."""

    controller: str
    Kp: float
    Ti: float | None
    Td: float
    Tf: float
    b: float
    N: float | None = Field(default=None, description="Filter Td/N of the derivative alone; null: none.")


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
    """Gains of one rule."""

    rule: str
    title: str
    source: str
    gains: PidGains
    margins: Margins | None
    iae: float | None = Field(description="Integral of the absolute error after a unit load step, PV s/output.")
    overshoot: float | None = Field(description="Overshoot after a set-point step, share of the step.")
    settling_time_s: float | None = Field(default=None, description="Until within 2 % of the step, s.")
    jitter: float | None = Field(default=None, description=JITTER)
    warnings: list[str]


class HeldGains(Response):
    """Gains as held by the device, in its own form, rounded to its resolution, with their margins."""

    form: str
    values: dict[str, float]
    controller_action: Literal["direct", "reverse"] = Field(description=CONTROLLER_ACTION)
    action: Literal["direct", "reverse"] = Field(description=OLD_NAME)
    gains: PidGains
    margins: Margins | None
    warnings: list[str]


class Predicted(Response):
    """Predicted response of the loop with the controller that holds the gains; sizes in PV and output units."""

    set_point_step: float
    load_step: float
    overshoot: float = Field(description="Share of the step.")
    settling_time_s: float | None = Field(
        description="Until within 2 % of the step, s; null: not in the time simulated."
    )
    output_move: float
    load_deviation: float
    load_iae: float


class ControllerAdvice(Response):
    """Parts of a PID controller that the process needs, and the cost of fewer parts."""

    controller: Literal["PI", "PID"]
    filtered: bool = Field(description="Whether a PID controller needs a slow measurement filter.")
    costs: dict[str, float | None] = Field(
        description="PI: error after a load step by that of PID. P: share of a load's effect that remains."
    )
    text: str


class Gains(Response):
    """Recommended gains, and the alternatives."""

    goal: str | None
    rule: str
    gains: PidGains
    margins: Margins | None
    iae: float | None = Field(description="Integral of the absolute error after a unit load step, PV s/output.")
    overshoot: float | None = Field(description="Overshoot after a set-point step, share of the step.")
    intervals: dict[str, tuple[float | None, float | None]] = Field(description="95 % intervals of the gains.")
    jitter: float | None = Field(description=JITTER)
    jitter_limit: float | None = Field(default=None, description=JITTER_LIMIT)
    device: HeldGains | None = Field(default=None, description=IN_DEVICE)
    predicted: Predicted | None = Field(default=None, description="Null for a loop that is unstable on the model.")
    advice: ControllerAdvice | None = Field(default=None, description="Null where parts cannot be compared.")
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
    """Present gains of a loop's device, in its own form."""

    loop: str
    form: str
    controller_action: Literal["direct", "reverse"] = Field(description=CONTROLLER_ACTION)
    action: Literal["direct", "reverse"] = Field(description=OLD_NAME)
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
    controller_action: Literal["direct", "reverse"] = Field(description=CONTROLLER_ACTION)
    action: Literal["direct", "reverse"] = Field(description=OLD_NAME)
    margins: Margins | None
    warnings: list[str]


class GainsUnderTest(Response):
    """Gains of a verification, as numbers of the device by signal."""

    form: str
    before: dict[str, float]
    written: dict[str, float]
    read_back: dict[str, float]


class RestBefore(Response):
    """The loop at rest before the step of a verification."""

    pv: float
    output: float
    noise_sigma: float


class VerificationResult(Response):
    """A step of the set point under applied gains: prediction and measurement."""

    state: Literal["running", "ended"]
    phase: VerificationPhase | None = Field(default=None, description="Null in a result of an earlier version.")
    actor: str | None = Field(default=None, description="The name of a token, `local`, or a user of the shell.")
    started_at: str | None = None
    ended_at: str | None = None
    gains: GainsUnderTest | None = Field(
        default=None, description="Written gains, and the previous gains of the device."
    )
    passed: bool | None = Field(description="Whether the loop followed the prediction; null while it runs.")
    rolled_back: bool = Field(description="Whether the old gains are restored because of it.")
    verdict: Verdict | None
    step: float | None = Field(description="Step of the set point, PV units.")
    duration_s: float | None
    rest: RestBefore | None = None
    overshoot: float | None = Field(description="Measured, share of the step.")
    predicted_overshoot: float | None
    response: list[list[float]] = Field(description="Points of time from the step, s, PV, output.")
    predicted: list[list[float]] = Field(description="Points of time from the step, s, lowest and highest PV.")
    predicted_output: list[list[float]] = Field(
        default=[], description="Points of time from the step, s, lowest and highest output."
    )


class ScheduleRow(Response):
    """Gains at one operating point."""

    value: float = Field(description="Of the variable, at which the gains were tuned.")
    gains: PidGains


class Schedule(Response):
    """Gains over a variable: a row gives way to the next when its border has been passed by the hysteresis."""

    rows: list[ScheduleRow]
    borders: list[float]
    hysteresis: float


class ScheduleRun(Response):
    """Tunings at several operating points, one after the other."""

    id: str
    loop: str
    started_at: str
    state: Literal["running", "ended"]
    set_points: list[float]
    variable: Literal["set_point", "output"]
    tuning_ids: list[str] = Field(description="Those that were begun, one a point.")
    schedule: Schedule | None = Field(description="The gain schedule; null until all have ended with gains.")
    verdict: Verdict | None


class RolledBack(Response):
    """Gains that were restored and read back."""

    loop: str
    tuning_id: str | None
    at: str
    was: DeviceGains
    now: DeviceGains


class Result(Response):
    """Analysis of a recording: the process, its limit cycle, every estimate, and gains; null without any."""

    structure: str | None = None
    model: JsonObject | None = None
    limit_cycle: JsonObject | None = None
    estimates: JsonObject | None = None
    recommended: str | None = None
    points: list[JsonObject] | None = None
    fit: JsonObject | None = None
    error: JsonObject | None = None
    disturbances: list[JsonObject] = Field(default=[], description="How those that were named move the PV.")
    gains: PidGains | None = None
    tuning: Gains | None = None
    warnings: list[str] = Field(default=[], description="Findings that require action.")
    notes: list[str] = Field(default=[], description="Findings for information; the gains allow for them.")
    verdict: Verdict | None = None


class Before(Response):
    """State in which the loop was found; `auto` is null where the device does not report it."""

    output: float
    auto: float | None


class Lateness(Response):
    """Lateness of the samples: median, 99th percentile and largest, s."""

    p50_s: float
    p99_s: float
    max_s: float


class Tuning(Result):
    """Present state of a tuning."""

    context: JsonObject | None = Field(default=None, description="What was known of the loop for gains.")
    diagnosis: JsonObject | None = Field(
        default=None, description="What the record shows that the model lacks, as in the answer of POST /v1/diagnoses."
    )
    id: str
    loop: str
    state: Literal["running", "ended"]
    current: bool = Field(
        default=True, description="Whether this run of the service conducted it: only then its gains can be written."
    )
    actor: str = Field(default="local", description="Who started it: the name of a token, or `local`.")
    phase: Phase
    started_at: str
    samples: int
    settings: JsonObject
    before: Before | None
    restored: bool | None
    lateness: Lateness | None
    early_gains: JsonObject | None = Field(
        default=None,
        description="Gains of a rule on the model so far, at the cautious bound of its errors; null with `gains`.",
    )
    device_gains: dict[str, float] | None = Field(description="Numbers of the device's gains, by signal.")
    applied: Applied | None = Field(description="Gains of this tuning that the device holds.")
    verification: VerificationResult | None = Field(description="The latest step under these gains.")
    links: Links


class ListedGains(Response):
    """The gains of a tuning in a list: ideal form, times in s."""

    controller: str
    Kp: float
    Ti: float | None
    Td: float


class TuningSummary(Response):
    """A tuning in a list; missing results are null, also those that an earlier version did not store."""

    id: str
    loop: str
    state: Literal["running", "ended"]
    phase: Phase
    started_at: str
    outcome: Outcome | None
    code: str | None
    actor: str = Field(default="local", description="Who started it: the name of a token, or `local`.")
    structure: str | None = None
    model: JsonObject | None = None
    gains: ListedGains | None = None
    goal: str | None = Field(default=None, description="The goal of the gains, or the rule.")
    applied: bool | None = Field(default=None, description="Whether the device holds its gains, as far as known.")
    verified: bool | None = Field(default=None, description="Whether they passed a verification; null: none was made.")
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


class Problem(Response):
    """Problem details (RFC 9457)."""

    type: str = Field(description="A path of this service that lists the kinds of problems; about:blank: none of ours.")
    title: str
    status: int
    detail: str
    instance: str
    field: str | None = Field(default=None, description="Name of the refused item.")
    value: str | None = Field(default=None, description="What was refused.")
    remedy: str = Field(description="What to do next.")
    tuning_id: str | None = Field(default=None, description="The tuning that holds the loop.")
    errors: list[JsonObject] | None = Field(
        default=None, description="Every value that was refused, when several were."
    )
