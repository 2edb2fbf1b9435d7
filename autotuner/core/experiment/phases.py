"""The phases of a tuning, as a table.

Rules of this file: a phase changes only through `TRANSITIONS`; an event that the table lacks raises and changes
nothing; RESTORE is reached from every phase that may have moved the output, by every kind of end. The diagram in the
documentation is drawn from this table.
"""

from __future__ import annotations

from enum import StrEnum


class Phase(StrEnum):
    """Where a tuning stands."""

    ARM = "arm"
    QUIET = "quiet"
    APPROACH = "approach"
    RELAY = "relay"
    CHECK = "check"
    RESTORE = "restore"
    ENDED = "ended"


class PhaseEvent(StrEnum):
    """What moves a tuning on."""

    ARMED = "armed"
    RESTED = "rested"
    RESTED_AT_LIMIT = "rested_at_limit"
    APPROACHED = "approached"
    CONVERGED = "converged"
    CONVERGED_UNCHECKED = "converged_unchecked"
    CHECKED = "checked"
    STOPPED = "stopped"
    RESTORED = "restored"


TRANSITIONS: dict[tuple[Phase, PhaseEvent], Phase] = {
    (Phase.ARM, PhaseEvent.ARMED): Phase.QUIET,
    (Phase.QUIET, PhaseEvent.RESTED): Phase.RELAY,
    (Phase.QUIET, PhaseEvent.RESTED_AT_LIMIT): Phase.APPROACH,
    (Phase.APPROACH, PhaseEvent.APPROACHED): Phase.RELAY,
    (Phase.RELAY, PhaseEvent.CONVERGED): Phase.CHECK,
    (Phase.RELAY, PhaseEvent.CONVERGED_UNCHECKED): Phase.RESTORE,
    (Phase.CHECK, PhaseEvent.CHECKED): Phase.RESTORE,
    **{
        (phase, PhaseEvent.STOPPED): Phase.RESTORE
        for phase in (Phase.ARM, Phase.QUIET, Phase.APPROACH, Phase.RELAY, Phase.CHECK, Phase.RESTORE)
    },
    (Phase.RESTORE, PhaseEvent.RESTORED): Phase.ENDED,
}


class IllegalTransitionError(RuntimeError):
    """An event came in a phase that does not know it: a fault of the program, not of the process."""


def next_phase(phase: Phase, event: PhaseEvent) -> Phase:
    """Return the phase after `event`; raise `IllegalTransitionError` when the table has no such row."""
    try:
        return TRANSITIONS[phase, event]
    except KeyError:
        raise IllegalTransitionError(f"phase {phase} knows no event {event}") from None


def mermaid() -> str:
    """Return the table as a Mermaid state diagram."""
    rows = [f"    {before} --> {after}: {event}" for (before, event), after in TRANSITIONS.items()]
    return "\n".join(["stateDiagram-v2", f"    [*] --> {Phase.ARM}", *rows, f"    {Phase.ENDED} --> [*]"]) + "\n"
