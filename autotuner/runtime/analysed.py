"""What a recording told: the value that comes back from the worker that analysed it (`autotuner.runtime.analysis`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from autotuner.core.diagnosis import Diagnosis
    from autotuner.core.held_out import HeldOut
    from autotuner.core.identification import Identification
    from autotuner.core.tuning import Tuning as Gains
    from autotuner.core.verdict import Verdict


@dataclass(frozen=True, slots=True)
class Analysis:
    """What a recording told, and the gains that follow.

    Attributes
    ----------
    identification : Identification
        Models with their errors.
    gains : Gains or None
        None when no model could be identified, or when there are no such gains for it.
    error : HeldOut or None
        Errors on the fitted and on the other part; None when the check was left out.
    refusal : Verdict or None
        Why the identified process has no gains of the kind that was asked.
    diagnosis : Diagnosis or None
        What the record shows that a model of the process alone lacks; None where it could not be made.
    sample_time_s : float
        Time between two samples, s, which is that of the controller as far as is known.
    """

    identification: Identification
    gains: Gains | None
    error: HeldOut | None = None
    refusal: Verdict | None = None
    diagnosis: Diagnosis | None = None
    sample_time_s: float = 0.0

    @property
    def verdict(self) -> Verdict:
        """The refusal, else the identification's verdict."""
        return self.refusal or self.identification.verdict

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings of all parts."""
        unchecked = "the check was left out: dead-band, friction and the like could not be seen"
        missed = self.error.warning if self.error else unchecked
        gains = self.gains.warnings if self.gains else ()
        return (*self.identification.warnings, *((missed,) if missed else ()), *self._lacking(), *gains)

    def _lacking(self) -> tuple[str, ...]:
        """Return what the diagnosis found missing, in a sentence with its advice."""
        if self.diagnosis is None or self.diagnosis.verdict == "adequate":
            return ()
        advice = "; ".join(effect.advice for effect in self.diagnosis.effects if effect.advice)
        return (f"diagnosis: {self.diagnosis.summary}" + (f": {advice}" if advice else ""),)

    def to_dict(self) -> dict[str, object]:
        """Return the identification's fields with `error`, `gains` and `tuning` beside them, JSON-ready."""
        return {
            **self.identification.to_dict(),
            "error": self.error.to_dict() if self.error else None,
            "gains": self.gains.gains.to_dict() if self.gains else None,
            "tuning": self.gains.to_dict() if self.gains else None,
            "diagnosis": self.diagnosis.to_dict() if self.diagnosis else None,
            "warnings": list(self.warnings),
        }
