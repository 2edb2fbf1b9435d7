"""A tuning of an earlier run of the service: its result, its recording and its events, to be read.

Invariant: the same read interface as `TuningRun`, without any write.
"""

from __future__ import annotations

from collections.abc import AsyncIterator  # noqa: TC003 - the service reads this annotation
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from autotuner.control.reporting.events import SampleTaken
from autotuner.core.design import design_spec_from
from autotuner.core.model.process import model_from_dict
from autotuner.core.recording import Recording
from autotuner.core.verdict import Outcome, Verdict

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.design import DesignSpec
    from autotuner.core.model.process import ProcessModel
    from autotuner.service.archive.archive_record import KeptTuning

LOST = Verdict(
    Outcome.FAILED,
    "interrupted",
    "the program ended before the result of this tuning was stored",
    "Check that the loop was released: the next start does that from its journal.",
)
BEFORE_ANYTHING: dict[str, Any] = {
    "phase": "arm",
    "settings": {},
    **dict.fromkeys(("before", "restored", "lateness", "device_gains", "applied", "verification")),
    "warnings": [],
    "notes": [],
}
"""The result of a tuning that was killed before it reported any."""


@dataclass(frozen=True, slots=True)
class ArchivedEvent:
    """An event as it was published."""

    data: dict[str, Any]

    @property
    def type(self) -> str:
        """Its tag."""
        return str(self.data["type"])

    def to_dict(self) -> dict[str, Any]:
        """Return the tag and the fields."""
        return self.data


@dataclass(frozen=True, slots=True)
class ArchivedTuning:
    """Content of the database for a tuning, and its later changes `since`."""

    kept: KeptTuning
    since: Mapping[str, Any] = field(default_factory=dict)

    @property
    def id(self) -> str:
        """Its identifier."""
        return self.kept.head.id

    @property
    def loop(self) -> str:
        """Name of its loop."""
        return self.kept.head.loop

    @property
    def end_published(self) -> bool:
        """Whether no further event follows."""
        return True

    @property
    def spec(self) -> DesignSpec:
        """The requested design."""
        return design_spec_from(self.kept.head.request)

    @property
    def model(self) -> ProcessModel | None:
        """The identified process."""
        reported = self.kept.reported
        return model_from_dict(reported["model"], reported["structure"]) if reported.get("model") else None

    @property
    def events(self) -> list[SampleTaken | ArchivedEvent]:
        """Everything that happened, in its order: the samples are where no other event is."""
        others = dict(self.kept.events)
        samples = iter(self.kept.samples)
        number, found = 0, list[SampleTaken | ArchivedEvent]()
        while True:
            if number in others:
                found.append(ArchivedEvent(others[number]))
            elif (sample := next(samples, None)) is not None:
                found.append(SampleTaken.of(sample))
            else:
                return found
            number += 1

    async def follow(self) -> AsyncIterator[SampleTaken | ArchivedEvent]:
        """Yield every event, as `TuningRun.follow` does for one that has ended."""
        for event in self.events:
            yield event

    def recording(self) -> Recording:
        """Return the recording; raise `RecordingError` before the second sample."""
        return Recording.from_samples(self.kept.samples, self.kept.recording_settings)

    def to_dict(self) -> dict[str, Any]:
        """Return the last result of the tuning; one that was cut off states that."""
        reported, head = BEFORE_ANYTHING | self.kept.reported | dict(self.since), self.kept.head
        known = {"id": head.id, "loop": head.loop, "started_at": head.started_at, "actor": head.actor}
        verdict = reported.get("verdict") or LOST.to_dict()
        return {
            **reported,
            **known,
            "samples": len(self.kept.samples),
            "state": "ended",
            "verdict": verdict,
        }
