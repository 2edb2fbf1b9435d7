"""The phases of a tuning, as a table.

Invariant: a phase changes only through the table; RESTORE is reached from every phase that may have moved the
output, by every kind of end.
"""

from __future__ import annotations

from enum import StrEnum

from autotuner.core.state_table import StateTable


class Phase(StrEnum):
    """The phase of a tuning."""

    ARM = "arm"
    QUIET = "quiet"
    APPROACH = "approach"
    RELAY = "relay"
    CHECK = "check"
    RESTORE = "restore"
    ENDED = "ended"


class PhaseEvent(StrEnum):
    """Events that advance a tuning."""

    ARMED = "armed"
    RESTED = "rested"
    RESTED_AT_LIMIT = "rested_at_limit"
    APPROACHED = "approached"
    LEFT_LINE = "left_line"
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
    (Phase.RELAY, PhaseEvent.LEFT_LINE): Phase.QUIET,
    (Phase.RELAY, PhaseEvent.CONVERGED): Phase.CHECK,
    (Phase.RELAY, PhaseEvent.CONVERGED_UNCHECKED): Phase.RESTORE,
    (Phase.CHECK, PhaseEvent.CHECKED): Phase.RESTORE,
    **{
        (phase, PhaseEvent.STOPPED): Phase.RESTORE
        for phase in (Phase.ARM, Phase.QUIET, Phase.APPROACH, Phase.RELAY, Phase.CHECK, Phase.RESTORE)
    },
    (Phase.RESTORE, PhaseEvent.RESTORED): Phase.ENDED,
}

PHASES = StateTable("phase", Phase.ARM, TRANSITIONS, Phase.ENDED)
next_phase = PHASES.after
