"""The events of a running tuning: a tagged union, JSON-ready.

Invariant: an event is self-contained; `type` is the tag for programs.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar

from autotuner.core.jsonable import jsonable
from autotuner.core.recording import Sample


@dataclass(frozen=True, slots=True)
class BaseEvent:
    """Base of every event: its tag, and its time, s from the start."""

    type: ClassVar[str]
    t: float

    def to_dict(self) -> dict[str, object]:
        """Return the tag and the fields; numbers that are not finite become None."""
        return {"type": self.type, **{field.name: jsonable(getattr(self, field.name)) for field in fields(self)}}


@dataclass(frozen=True, slots=True)
class SampleTaken(BaseEvent):
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
        """The sample."""
        return Sample(self.t, self.pv, self.output, self.set_point, self.lateness_s, self.written_s)


@dataclass(frozen=True, slots=True)
class PhaseChanged(BaseEvent):
    """The tuning entered a phase."""

    type: ClassVar[str] = "phase"
    phase: str


@dataclass(frozen=True, slots=True)
class EstimateUpdated(BaseEvent):
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
class ModelUpdated(BaseEvent):
    """A running model after a half period: parameters and their standard errors by name.

    `method` is `learned`, which is there first, or `least_squares`. `gains` are those of a rule on the cautious end of
    the model's errors; they hold until the whole record has been analysed.
    """

    type: ClassVar[str] = "model"
    structure: str
    parameters: dict[str, float]
    standard_error: dict[str, float]
    relative_error: float
    method: str
    gains: dict[str, object] | None = None


@dataclass(frozen=True, slots=True)
class LinkTrouble(BaseEvent):
    """A read or a write failed; the output held by the device is the one commanded before."""

    type: ClassVar[str] = "link"
    message: str


@dataclass(frozen=True, slots=True)
class OutputUnknown(BaseEvent):
    """The output could not be restored yet; the attempts continue."""

    type: ClassVar[str] = "output_unknown"
    attempts: int
    message: str


@dataclass(frozen=True, slots=True)
class OutputRestored(BaseEvent):
    """Output and mode are back; `verified` when the device confirmed it by read-back."""

    type: ClassVar[str] = "restored"
    output: float
    verified: bool


@dataclass(frozen=True, slots=True)
class LoopObserved(BaseEvent):
    """A reading before take-over, while the device's own controller drives the output; no sample of the record."""

    type: ClassVar[str] = "observed"
    pv: float
    output: float
    set_point: float


@dataclass(frozen=True, slots=True)
class ReleaseBump(BaseEvent):
    """The output jumped when the device's own controller drove it again: `output` from where it was released.

    `noise` is the largest change within noise, output units; `pv` is the change of the PV meanwhile.
    """

    type: ClassVar[str] = "bump"
    output: float
    noise: float
    pv: float

    def __str__(self) -> str:
        """Return it as a sentence's part."""
        jump = f"the output jumped by {self.output:+.4g} at release (noise {self.noise:.3g})"
        return f"{jump}; the PV moved by {self.pv:+.4g} meanwhile"


@dataclass(frozen=True, slots=True)
class Ended(BaseEvent):
    """The tuning is over and its result can be read."""

    type: ClassVar[str] = "ended"
    outcome: str
    code: str
    message: str
    remedy: str


Event = (
    SampleTaken
    | PhaseChanged
    | EstimateUpdated
    | ModelUpdated
    | LinkTrouble
    | LoopObserved
    | OutputUnknown
    | OutputRestored
    | ReleaseBump
    | Ended
)
