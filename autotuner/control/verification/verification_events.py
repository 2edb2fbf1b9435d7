"""Events of a verification: a tagged union, JSON-ready, as those of a tuning are.

    verification_phase -> gains_written -> sample ... -> step_made -> sample ... -> verification_ended

Invariants: `t` is in seconds from the start of the verification, in every event, so that a picture needs one
time axis; times inside `predicted` and `predicted_output` are from the step.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar

from autotuner.control.reporting.events import BaseEvent, SampleTaken


class VerificationPhase(StrEnum):
    """Phase of a verification."""

    WRITE = "write"
    SETTLE = "settle"
    REST = "rest"
    PREDICT = "predict"
    STEP = "step"
    RESTORE = "restore"
    ENDED = "ended"


@dataclass(frozen=True, slots=True)
class VerificationPhaseChanged(BaseEvent):
    """The verification entered a phase, which takes `expected_s` at least; NaN where that is not known."""

    type: ClassVar[str] = "verification_phase"
    phase: str
    expected_s: float


@dataclass(frozen=True, slots=True)
class GainsWritten(BaseEvent):
    """The gains under test: the numbers of the device before, as written, and as read back."""

    type: ClassVar[str] = "gains_written"
    form: str
    before: dict[str, float]
    written: dict[str, float]
    read_back: dict[str, float]


@dataclass(frozen=True, slots=True)
class StepMade(BaseEvent):
    """The set point was moved by `step` to `set_point`; the response is judged for `duration_s`.

    `predicted` and `predicted_output` hold rows of time from the step, lowest and highest value of the band.
    """

    type: ClassVar[str] = "step_made"
    step: float
    set_point: float
    duration_s: float
    rest_pv: float
    rest_output: float
    predicted: list[list[float]]
    predicted_output: list[list[float]]


@dataclass(frozen=True, slots=True)
class VerificationEnded(BaseEvent):
    """The verification is over; `rolled_back` where the gains before are in the device again."""

    type: ClassVar[str] = "verification_ended"
    outcome: str
    code: str
    message: str
    remedy: str
    passed: bool
    rolled_back: bool


VerificationEvent = SampleTaken | VerificationPhaseChanged | GainsWritten | StepMade | VerificationEnded
