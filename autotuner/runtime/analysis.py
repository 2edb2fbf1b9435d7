"""From a recording to gains: the pure part of a tuning, made to be sent to a worker process."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from autotuner.core.identification import identify
from autotuner.core.tuning import tune

if TYPE_CHECKING:
    from autotuner.core.identification import Identification
    from autotuner.core.recording import Recording
    from autotuner.core.tuning import Tuning as Gains
    from autotuner.core.verdict import Verdict


@dataclass(frozen=True, slots=True)
class Analysis:
    """What a recording told, and the gains that follow."""

    identification: Identification
    gains: Gains | None

    @property
    def verdict(self) -> Verdict:
        """The identification's verdict."""
        return self.identification.verdict

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings of both parts."""
        return (*self.identification.warnings, *(self.gains.warnings if self.gains else ()))

    def to_dict(self) -> dict[str, object]:
        """Return the identification's fields with `gains` and `tuning` beside them, JSON-ready."""
        return {
            **self.identification.to_dict(),
            "gains": self.gains.gains.to_dict() if self.gains else None,
            "tuning": self.gains.to_dict() if self.gains else None,
            "warnings": list(self.warnings),
        }


def analyse(recording: Recording, structure: str = "auto", goal: str = "balanced", rule: str | None = None) -> Analysis:
    """Identify the process and choose gains.

    Parameters
    ----------
    recording : Recording
        Samples of the experiment.
    structure : str
        Process structure, or ``auto``.
    goal : str
        Goal of the gains.
    rule : str, optional
        A tuning rule by name instead of the goal.
    """
    identification = identify(recording, structure=structure)
    gains = None if identification.model is None else tune(identification.model, goal=goal, rule=rule)
    return Analysis(identification, gains)
