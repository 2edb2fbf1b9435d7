"""The states of a lease, as a table.

Rule of this file: an event that the table lacks raises and changes nothing. The diagram in the documentation is drawn
from this table.
"""

from __future__ import annotations

from enum import StrEnum


class LeaseState(StrEnum):
    """How a loop stands with this program."""

    FREE = "free"
    ACQUIRING = "acquiring"
    HELD = "held"
    DISTURBED = "disturbed"
    RELEASING = "releasing"
    UNKNOWN = "unknown"


class LeaseEvent(StrEnum):
    """What moves a lease on."""

    ACQUIRE = "acquire"
    RECORDED = "recorded"
    WRITE = "write"
    LEAVE = "leave"
    RELEASE = "release"
    RESTORED = "restored"
    LOST = "lost"
    RESUME = "resume"


TRANSITIONS: dict[tuple[LeaseState, LeaseEvent], LeaseState] = {
    (LeaseState.FREE, LeaseEvent.ACQUIRE): LeaseState.ACQUIRING,
    (LeaseState.ACQUIRING, LeaseEvent.RECORDED): LeaseState.HELD,
    (LeaseState.ACQUIRING, LeaseEvent.LEAVE): LeaseState.FREE,
    (LeaseState.HELD, LeaseEvent.WRITE): LeaseState.DISTURBED,
    (LeaseState.HELD, LeaseEvent.LEAVE): LeaseState.FREE,
    (LeaseState.DISTURBED, LeaseEvent.WRITE): LeaseState.DISTURBED,
    (LeaseState.DISTURBED, LeaseEvent.LEAVE): LeaseState.FREE,
    (LeaseState.DISTURBED, LeaseEvent.RELEASE): LeaseState.RELEASING,
    (LeaseState.DISTURBED, LeaseEvent.LOST): LeaseState.UNKNOWN,
    (LeaseState.RELEASING, LeaseEvent.RESTORED): LeaseState.FREE,
    (LeaseState.RELEASING, LeaseEvent.LOST): LeaseState.UNKNOWN,
    (LeaseState.UNKNOWN, LeaseEvent.RELEASE): LeaseState.RELEASING,
    (LeaseState.UNKNOWN, LeaseEvent.LEAVE): LeaseState.FREE,
    (LeaseState.FREE, LeaseEvent.RESUME): LeaseState.UNKNOWN,
}


class IllegalLeaseEventError(RuntimeError):
    """An event came in a state that does not know it, or a write outside the envelope: a fault of the program."""


def next_state(state: LeaseState, event: LeaseEvent) -> LeaseState:
    """Return the state after `event`; raise `IllegalLeaseEventError` when the table has no such row."""
    try:
        return TRANSITIONS[state, event]
    except KeyError:
        raise IllegalLeaseEventError(f"a lease that is {state} knows no event {event}") from None


def mermaid() -> str:
    """Return the table as a Mermaid state diagram."""
    rows = [f"    {before} --> {after}: {event}" for (before, event), after in TRANSITIONS.items()]
    return "\n".join(["stateDiagram-v2", f"    [*] --> {LeaseState.FREE}", *rows]) + "\n"
