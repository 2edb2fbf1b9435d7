"""Verdict: the end of a tuning as a value with its numbers and the next action.

A refused, aborted or tripped experiment is not a failure of the program: it ends with a verdict. `code` is stable
and meant for programs, `message` has the numbers, `remedy` the advice.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from enum import StrEnum


class Outcome(StrEnum):
    """The four ways in which a tuning ends."""

    DONE = "done"
    REFUSED = "refused"
    ABORTED = "aborted"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class Verdict:
    """The end of a tuning.

    Attributes
    ----------
    outcome : Outcome
        ``done``: gains may be used. ``refused``: the process or the settings do not allow a result. ``aborted``:
        stopped by a caller or by a safety limit. ``failed``: a device or the program failed.
    code : str
        Stable name such as ``no_oscillation``.
    message : str
        What was found, with numbers and units.
    remedy : str
        What to do next; empty when nothing is needed.
    """

    outcome: Outcome
    code: str
    message: str
    remedy: str = ""

    def because(self, cause: str, remedy: str) -> Verdict:
        """Return this verdict with its cause, and the remedy of the cause first."""
        return replace(self, message=f"{self.message}: {cause}", remedy=f"{remedy} {self.remedy}")

    def to_dict(self) -> dict[str, str]:
        """Return JSON-ready values."""
        return {**asdict(self), "outcome": self.outcome.value}


def refused(code: str, message: str, remedy: str) -> Verdict:
    """Return a refusal; `remedy` is mandatory: a refusal without advice is useless."""
    return Verdict(Outcome.REFUSED, code, message, remedy)


def aborted(code: str, message: str, remedy: str) -> Verdict:
    """Return the verdict of a tuning that was stopped by a caller or by a safety limit."""
    return Verdict(Outcome.ABORTED, code, message, remedy)


def failed(code: str, message: str, remedy: str) -> Verdict:
    """Return the verdict of a tuning that ended because a device or the program failed."""
    return Verdict(Outcome.FAILED, code, message, remedy)
