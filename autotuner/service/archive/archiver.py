"""Tracks the parts of a tuning that are written to the archive.

Invariants:

1. Changes count as written only after `written`: a disk that is full for a while loses
   nothing that is still in memory.
2. An interrupted tuning continues after the content of the database; further events of its journal are added.
3. For an ended tuning whose verification or recovery was left to a later program, only the changes of
   that are written.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from autotuner.control.reporting.events import Ended, OutputRestored, PhaseChanged, SampleTaken
from autotuner.service.archive.archive_record import GainsChange, Head, KeptTuning, News, TuningSnapshot

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.application.tuning_run import TuningRun
    from autotuner.control.gains.apply import Applied
    from autotuner.control.reporting.events import Event
    from autotuner.service.archive.archive_record import Progress

CHANGING = (PhaseChanged, OutputRestored, Ended)
"""Events that change the result of a tuning."""
ROLLED_BACK = "rolled back"
VERSIONS = {name: version(name) for name in ("relay-autotuner", "numpy", "scipy", "scikit-learn")}
"""Computation of analyses."""


@dataclass(frozen=True, slots=True)
class Position:
    """Archived part of a tuning: its events in memory, its samples, and the number of its next event."""

    seen: int = 0
    samples: int = 0
    number: int = 0


@dataclass(slots=True)
class Archiver:
    """Follows one tuning.

    Attributes
    ----------
    tuning : TuningRun
        The tuning.
    number : int or None
        Its number in the database; None before its first write.
    done : bool
        Whether it was complete before it was taken over: then only the changes of its verification are
        written.
    """

    tuning: TuningRun
    number: int | None = None
    done: bool = False
    _at: Position = Position()
    _next: Position = Position()
    _applied: Applied | None = None
    _next_applied: Applied | None = None
    _state: tuple[object, ...] = field(default=())
    _next_state: tuple[object, ...] = field(default=())
    _code: str | None = None
    _since_written: bool = False
    _next_since: bool = False

    @property
    def head(self) -> Head:
        """Properties from the start."""
        tuning, request = self.tuning, self.tuning.request
        return Head(tuning.id, tuning.loop, tuning.started_at, request.actor, request.analysed_by())

    def go_on(self, kept: Progress) -> None:
        """Continue after the content of the database."""
        self.number = kept.number
        self.done = kept.ended
        self._code = kept.code
        if kept.events:
            self._at = Position(min(kept.samples, len(self.tuning.samples)), kept.samples, kept.events)

    def news(self) -> News | None:
        """Return the changes since the last write; None when there are none."""
        if self.done:
            return self._since()
        new = self.tuning.events[self._at.seen :]
        state = self._state_now()
        other = len(state) != len(self._state) or any(
            now is not was for now, was in zip(state, self._state, strict=True)
        )
        is_changed = other or any(isinstance(event, CHANGING) for event in new)
        if not new and not is_changed:
            return None
        samples = [event.sample for event in new if isinstance(event, SampleTaken)]
        self._next_state, self._next_applied = state, self.tuning.applied
        at, self._next = self._at, self._behind(new, len(samples))
        reported = snapshot_of(self.tuning) if is_changed else None
        return News(self.tuning.id, at.samples, samples, self._numbered(new), reported, self._changes())

    def _since(self) -> News | None:
        """Return the unwritten outcome of the part that was left to a later program, once known."""
        since = since_of(self.tuning)
        known = "verdict" in since and since["verdict"]["code"] == self._code
        if self._since_written or known or not since:
            return None
        self._next_since = True
        run = self.tuning.verification
        back = run.back if run else None
        changes = [GainsChange(back.loop, back.at, ROLLED_BACK, back.was, back.now)] if back else []
        return News(self.tuning.id, changes=changes, since=since)

    def written(self) -> None:
        """Mark the latest changes as written."""
        self._since_written = self._next_since
        self._at, self._state, self._applied = self._next, self._next_state, self._next_applied

    def _state_now(self) -> tuple[object, ...]:
        """Return the state besides the events that changes when gains are written, verified or restored."""
        tuning = self.tuning
        return tuning.applied, tuning.verification, tuning.verifier is None, tuning.trouble, tuning.ended

    def _behind(self, new: Sequence[Event], samples: int) -> Position:
        return Position(self._at.seen + len(new), self._at.samples + samples, self._at.number + len(new))

    def _numbered(self, new: Sequence[Event]) -> list[tuple[int, dict[str, object]]]:
        numbered = enumerate(new, self._at.number)
        return [(number, event.to_dict()) for number, event in numbered if not isinstance(event, SampleTaken)]

    def _changes(self) -> list[GainsChange]:
        was, now, tuning = self._applied, self._next_applied, self.tuning
        if was is now:
            return []
        if now is not None:
            return [GainsChange(now.loop, now.at, "applied", now.old, now.now)]
        assert was is not None  # noqa: S101 - they differ
        back = tuning.device_gains or dict(was.old)
        return [GainsChange(was.loop, was.at, ROLLED_BACK, was.now, back)]


def since_of(tuning: TuningRun) -> dict[str, Any]:
    """Return the changes of an earlier program's result: the end of its verification or recovery.

    Empty while that is not known, and where nothing of the tuning was left to a later program.
    """
    run, since = tuning.verification, dict[str, Any]()
    if tuning.ended_before and run is not None and run.verdict is not None:
        since |= {"verification": run.to_dict(), **({"applied": None} if run.rolled_back else {})}
    if tuning.kept is not None and run is None and tuning.verdict is not None:
        since |= {"verdict": tuning.verdict.to_dict(), "restored": tuning.restored}
    return since


def kept_now(tuning: TuningRun) -> KeptTuning:
    """Return a tuning in memory as the database would hold it."""
    reported = snapshot_of(tuning)
    others = [
        (number, event.to_dict())
        for number, event in enumerate(list(tuning.events))
        if not isinstance(event, SampleTaken)
    ]
    head = Archiver(tuning).head
    return KeptTuning(
        head, dict(reported.whole), dict(reported.recording_settings), VERSIONS, list(tuning.samples), others
    )


def snapshot_of(tuning: TuningRun) -> TuningSnapshot:
    """Return the present result of a tuning."""
    experiment = None if tuning.controller is None else tuning.controller.experiment
    settings = {} if experiment is None else experiment.settings_so_far()
    verdict = tuning.verdict
    outcome, code = (verdict.outcome.value, verdict.code) if verdict else (None, None)
    return TuningSnapshot(tuning.to_dict(), settings, outcome, code, tuning.phase, VERSIONS)
