"""A tuning of an earlier run of the service: what it told, its recording and its events, to look at.

Rule of this file: it offers what `autotuner.runtime.tuning.Tuning` offers for looking, and nothing that moves anything.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from autotuner.core.process import model_from_dict
from autotuner.core.recording import Recording
from autotuner.core.verdict import Outcome, Verdict

if TYPE_CHECKING:
    from autotuner.core.process import ProcessModel
    from autotuner.core.recording import Sample
    from autotuner.store.database import Kept

LOST = Verdict(
    Outcome.FAILED,
    "interrupted",
    "the program ended in the middle of this tuning",
    "Look whether the loop was given back: its journal does that with the next start.",
)


@dataclass(frozen=True, slots=True)
class PastTuning:
    """What the database holds of a tuning.

    Attributes
    ----------
    kept : Kept
        The tuning.
    samples : list of Sample
        What was recorded.
    """

    kept: Kept
    samples: list[Sample]

    @property
    def id(self) -> str:
        """Its identifier."""
        return self.kept.id

    @property
    def loop(self) -> str:
        """Name of its loop."""
        return self.kept.loop

    @property
    def model(self) -> ProcessModel | None:
        """The identified process."""
        told = self.kept.told
        return model_from_dict(told["model"], told["structure"]) if told.get("model") else None

    def recording(self) -> Recording:
        """Return what was recorded; raise `RecordingError` before the second sample."""
        return Recording.from_samples(self.samples, self.kept.recording_settings)

    def to_dict(self) -> dict[str, Any]:
        """Return what the tuning told last; one that was cut off tells so."""
        verdict = self.kept.told.get("verdict") or LOST.to_dict()
        return {**self.kept.told, "samples": len(self.samples), "state": "ended", "verdict": verdict}
