"""What a tuning tells while it runs: a tagged union, JSON-ready.

Rule of this file: an event says what happened, complete in itself; `type` is the tag that a program switches on.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar

from autotuner.core.jsonable import jsonable
from autotuner.core.recording import Sample


@dataclass(frozen=True, slots=True)
class _Event:
    type: ClassVar[str]
    t: float

    def to_dict(self) -> dict[str, object]:
        """Return the tag and the fields; numbers that are not finite become None."""
        return {"type": self.type, **{one.name: jsonable(getattr(self, one.name)) for one in fields(self)}}


@dataclass(frozen=True, slots=True)
class SampleTaken(_Event):
    """A sample was read and the output for it was written, at `written_s`; None where it stayed as it was."""

    type: ClassVar[str] = "sample"
    pv: float
    output: float
    set_point: float
    lateness_s: float
    written_s: float

    @classmethod
    def of(cls, sample: Sample) -> SampleTaken:
        """Return the event of a sample."""
        return cls(sample.t, sample.pv, sample.output, sample.set_point, sample.lateness_s, sample.written_s)

    @property
    def sample(self) -> Sample:
        """What was taken."""
        return Sample(self.t, self.pv, self.output, self.set_point, self.lateness_s, self.written_s)


@dataclass(frozen=True, slots=True)
class PhaseChanged(_Event):
    """The tuning entered a phase."""

    type: ClassVar[str] = "phase"
    phase: str


@dataclass(frozen=True, slots=True)
class EstimateUpdated(_Event):
    """The running estimate after a half period.

    `period_s` is Pu, `peak` A, `fundamental` A1, `ultimate_gain` Ku = 4 h / (pi A).
    """

    type: ClassVar[str] = "estimate"
    half_period: int
    period_s: float
    peak: float
    fundamental: float
    ultimate_gain: float


@dataclass(frozen=True, slots=True)
class ModelUpdated(_Event):
    """A running model after a half period: parameters and their standard errors by name.

    `method` is `learned`, which is there first, or `least_squares`.
    """

    type: ClassVar[str] = "model"
    structure: str
    parameters: dict[str, float]
    standard_error: dict[str, float]
    relative_error: float
    method: str


@dataclass(frozen=True, slots=True)
class LinkTrouble(_Event):
    """A read or a write failed; the output held by the device is the one commanded before."""

    type: ClassVar[str] = "link"
    message: str


@dataclass(frozen=True, slots=True)
class OutputUnknown(_Event):
    """The output could not be restored yet; the attempts go on."""

    type: ClassVar[str] = "output_unknown"
    attempts: int
    message: str


@dataclass(frozen=True, slots=True)
class OutputRestored(_Event):
    """Output and mode are back; `verified` when the device confirmed it by read-back."""

    type: ClassVar[str] = "restored"
    output: float
    verified: bool


@dataclass(frozen=True, slots=True)
class Ended(_Event):
    """The tuning is over and its result can be read."""

    type: ClassVar[str] = "ended"
    outcome: str
    code: str
    message: str
    remedy: str


Event = (
    SampleTaken | PhaseChanged | EstimateUpdated | ModelUpdated | LinkTrouble | OutputUnknown | OutputRestored | Ended
)
