"""From a recording to gains: the pure part of a tuning, made to be sent to a worker process."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from autotuner.core.held_out import HeldOut, held_out_error
from autotuner.core.identification import identify
from autotuner.core.tuning import tune

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.identification import Identification
    from autotuner.core.recording import Recording
    from autotuner.core.tuning import Tuning as Gains
    from autotuner.core.verdict import Verdict

FIRST_HELD_OUT = "half_relay"
"""The first part of the record that the model is judged on and not fitted to."""


@dataclass(frozen=True, slots=True)
class Analysis:
    """What a recording told, and the gains that follow.

    Attributes
    ----------
    identification : Identification
        Models with their errors.
    gains : Gains or None
        None when no model could be identified.
    error : HeldOut or None
        Errors on the fitted and on the other part; None when the check was left out.
    """

    identification: Identification
    gains: Gains | None
    error: HeldOut | None = None

    @property
    def verdict(self) -> Verdict:
        """The identification's verdict."""
        return self.identification.verdict

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings of all parts."""
        unchecked = "the check was left out: dead-band, friction and the like could not be seen"
        missed = self.error.warning if self.error else unchecked
        gains = self.gains.warnings if self.gains else ()
        return (*self.identification.warnings, *((missed,) if missed else ()), *gains)

    def to_dict(self) -> dict[str, object]:
        """Return the identification's fields with `error`, `gains` and `tuning` beside them, JSON-ready."""
        return {
            **self.identification.to_dict(),
            "error": self.error.to_dict() if self.error else None,
            "gains": self.gains.gains.to_dict() if self.gains else None,
            "tuning": self.gains.to_dict() if self.gains else None,
            "warnings": list(self.warnings),
        }


def analyse(recording: Recording, structure: str = "auto", goal: str = "balanced", rule: str | None = None) -> Analysis:
    """Identify the process on the relay part of a tuning's record, judge the model on the rest, and choose gains.

    Parameters
    ----------
    recording : Recording
        Samples of the experiment; its settings name the parts.
    structure : str
        Process structure, or ``auto``.
    goal : str
        Goal of the gains.
    rule : str, optional
        A tuning rule by name instead of the goal.
    """
    until_s = _segments(recording).get(FIRST_HELD_OUT)
    fitted = recording if until_s is None else recording.window(float(recording.t[0]), until_s)
    identification = identify(fitted, structure=structure)
    if identification.model is None:
        return Analysis(identification, None)
    gains = gains_for(identification, goal, rule)
    if until_s is None:
        return Analysis(identification, gains)
    noise = float(identification.fit.noise_sigma)
    return Analysis(identification, gains, held_out_error(identification.model, recording, until_s, noise))


def gains_for(
    identification: Identification, goal: str = "balanced", rule: str | None = None, tau_c_s: float | None = None
) -> Gains:
    """Return gains for an identified process: the same whether they are asked for with a tuning or after it.

    Parameters
    ----------
    identification : Identification
        One with a model.
    goal, rule, tau_c_s
        As in `autotuner.core.tuning.tune`.
    """
    return tune(identification.model, goal=goal, rule=rule, tau_c_s=tau_c_s)


def _segments(recording: Recording) -> Mapping[str, float]:
    segments = recording.settings.get("segments")
    return segments if isinstance(segments, dict) else {}
