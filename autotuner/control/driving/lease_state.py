"""The states of a lease, as a table."""

from __future__ import annotations

from enum import StrEnum

from autotuner.core.state_table import StateTable


class LeaseState(StrEnum):
    """The state of a loop with respect to this program."""

    FREE = "free"
    ACQUIRING = "acquiring"
    HELD = "held"
    DISTURBED = "disturbed"
    RELEASING = "releasing"
    UNKNOWN = "unknown"


class LeaseEvent(StrEnum):
    """Events that change the state of a lease."""

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

LEASE_STATES = StateTable("a lease that is", LeaseState.FREE, TRANSITIONS)
next_state = LEASE_STATES.after
