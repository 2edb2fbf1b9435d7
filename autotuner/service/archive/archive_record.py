"""Archived tunings and audit entries, as plain values.

Invariant: independent of the database, whose library is loaded with the first record.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from autotuner.core.recording import Sample

JsonObject = dict[str, Any]

DONE, BEGUN, STOPPED, FAILED = 200, 202, 499, 500
"""Status of an action in the audit: the HTTP status that its answer has, or would have had."""
WITHOUT_EFFECT = range(400, 500)
"""Statuses of an action that was refused, or stopped before it began."""


@dataclass(frozen=True, slots=True)
class Head:
    """Properties of a tuning from its start; `request` is JSON-ready."""

    id: str
    loop: str
    started_at: str
    actor: str
    request: JsonObject


@dataclass(frozen=True, slots=True)
class TuningSnapshot:
    """Result of a tuning at a time: `whole` as of `TuningRun.to_dict`, and the fields of a list."""

    whole: Mapping[str, Any]
    recording_settings: Mapping[str, Any]
    outcome: str | None
    code: str | None
    phase: str
    versions: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class GainsChange:
    """Gains of a device before and after: the number of each signal."""

    loop: str
    at: str
    action: str
    before: Mapping[str, float]
    after: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Deed:
    """An entry of the audit: actor, action and status.

    Attributes
    ----------
    at : str
        When, UTC.
    actor : str
        Who: the name of a token, `local`, or `shell:` and a user.
    action : str
        The request, or the command.
    status : int
        Status of the answer, or the one that an answer would have had.
    loop, tuning_id : str or None
        What it was done to.
    """

    at: str
    actor: str
    action: str
    status: int
    loop: str | None = None
    tuning_id: str | None = None


@dataclass(frozen=True, slots=True)
class News:
    """Changes of a tuning to be written.

    Attributes
    ----------
    tuning_id : str
        Whose it is.
    first : int
        Number of the first sample of `samples` in its recording.
    samples : sequence of Sample
        Those that are new.
    events : sequence of (int, dict)
        Events besides the samples, JSON-ready, with the number of each among all events.
    reported : TuningSnapshot or None
        Its result now, where that has changed.
    changes : sequence of GainsChange
        Gains that it put into its device, or took out of it.
    since : mapping
        What has changed of its last result, where an earlier program reported that.
    """

    tuning_id: str
    first: int = 0
    samples: Sequence[Sample] = ()
    events: Sequence[tuple[int, JsonObject]] = ()
    reported: TuningSnapshot | None = None
    changes: Sequence[GainsChange] = ()
    since: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Progress:
    """Size of an archived tuning, and its `number` among all: a later one has a larger number.

    Of it: samples, events (the samples among them), and the code of its end.
    """

    number: int
    samples: int = 0
    events: int = 0
    code: str | None = None

    @property
    def ended(self) -> bool:
        """Whether its end is archived."""
        return self.code is not None


@dataclass(frozen=True, slots=True)
class Summary:
    """Entry of a tuning in a list; `outcome` and `code` are None when its end is not archived.

    `result` is as of `result_of`; empty where an earlier version of the program kept the tuning.
    """

    id: str
    loop: str
    started_at: str
    actor: str
    outcome: str | None
    code: str | None
    phase: str
    number: int
    result: JsonObject = field(default_factory=dict)


def result_of(whole: Mapping[str, Any]) -> JsonObject:
    """Return the fields of a list from the result of a tuning."""
    design, gains = whole.get("tuning") or {}, whole.get("gains") or {}
    return {
        "structure": whole.get("structure"),
        "model": whole.get("model"),
        "gains": {name: gains.get(name) for name in ("controller", "Kp", "Ti", "Td")} if gains else None,
        "goal": design.get("goal") or design.get("rule"),
        "applied": bool(whole.get("applied")),
        "verified": (whole.get("verification") or {}).get("passed"),
    }


@dataclass(frozen=True, slots=True)
class KeptTuning:
    """A tuning as the database holds it; `reported` is its last result."""

    head: Head
    reported: JsonObject
    recording_settings: JsonObject
    versions: dict[str, str]
    samples: list[Sample] = field(repr=False)
    events: list[tuple[int, JsonObject]] = field(repr=False)
