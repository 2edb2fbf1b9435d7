"""What tuning gives: the gains recommended, and what they were chosen from."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from autotuner.core.tuning.gains import PidGains
    from autotuner.core.tuning.loop_margins import Margins
    from autotuner.core.tuning.uncertainty import Interval


@dataclass(frozen=True, slots=True)
class Candidate:
    """One controller with what it does on the model; robustness and errors are None when no model is known.

    Attributes
    ----------
    rule, title, source : str
        Where the gains come from.
    gains : PidGains
        The controller.
    margins : Margins or None
        Its robustness.
    iae : float or None
        Integral of the absolute error after a unit load step, PV s/output; None also without integral action.
    overshoot : float or None
        Largest excess of the PV over a set-point step, share of the step.
    warnings : tuple of str
        What the rule has to say.
    """

    rule: str
    title: str
    source: str
    gains: PidGains
    margins: Margins | None
    iae: float | None = None
    overshoot: float | None = None
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return {
            "rule": self.rule,
            "title": self.title,
            "source": self.source,
            "gains": self.gains.to_dict(),
            "margins": self.margins.to_dict() if self.margins else None,
            "iae": self.iae,
            "overshoot": self.overshoot,
            "warnings": list(self.warnings),
        }


@dataclass(frozen=True, slots=True)
class Tuning:
    """The gains recommended for a process, and what they were chosen from.

    Attributes
    ----------
    goal : str or None
        Goal that was asked; None when a rule was.
    rule : str
        ``robust``, or the rule that gave the gains.
    gains : PidGains
        The recommended controller.
    margins : Margins or None
        Its robustness on the model; None without a model.
    iae, overshoot : float or None
        As in `Candidate`.
    intervals : dict of str to Interval
        95 % intervals of the gains; empty without a covariance of the model.
    jitter : float or None
        Standard deviation of the output that the measured noise causes, output units; None where no noise is known.
    alternatives : tuple of Candidate
        Every rule that can be applied, in the order of the table.
    warnings : tuple of str
        What the user must know before using the gains.
    """

    goal: str | None
    rule: str
    gains: PidGains
    margins: Margins | None
    alternatives: tuple[Candidate, ...]
    warnings: tuple[str, ...]
    iae: float | None = None
    overshoot: float | None = None
    intervals: dict[str, Interval] = field(default_factory=dict)
    jitter: float | None = None

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return {
            "goal": self.goal,
            "rule": self.rule,
            "gains": self.gains.to_dict(),
            "margins": self.margins.to_dict() if self.margins else None,
            "iae": self.iae,
            "overshoot": self.overshoot,
            "intervals": {name: [interval.low, interval.high] for name, interval in self.intervals.items()},
            "jitter": self.jitter,
            "alternatives": [candidate.to_dict() for candidate in self.alternatives],
            "warnings": list(self.warnings),
        }
