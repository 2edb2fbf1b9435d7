"""A state machine as a table: of the phases of a tuning, and of the states of a lease.

Invariant: an event that the table lacks raises and changes nothing. The diagrams in the documentation are
drawn from the tables.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Mapping

StateT = TypeVar("StateT", bound=StrEnum)
EventT = TypeVar("EventT", bound=StrEnum)


class IllegalTransitionError(RuntimeError):
    """An event is not defined in the present state: a fault of the program, not of the process."""


@dataclass(frozen=True, slots=True)
class StateTable(Generic[StateT, EventT]):
    """A state machine.

    Attributes
    ----------
    name : str
        What it is of, as an error names it.
    start : StrEnum
        The first state.
    rows : mapping
        The next state for each state and event.
    end : StrEnum or None
        The final state; None without any.
    """

    name: str
    start: StateT
    rows: Mapping[tuple[StateT, EventT], StateT]
    end: StateT | None = None

    def after(self, state: StateT, event: EventT) -> StateT:
        """Return the state after `event`; raise `IllegalTransitionError` when the table has no such row."""
        try:
            return self.rows[state, event]
        except KeyError:
            raise IllegalTransitionError(f"{self.name} {state} knows no event {event}") from None

    def mermaid(self) -> str:
        """Return the table as a Mermaid state diagram."""
        rows = [f"    {before} --> {after}: {event}" for (before, event), after in self.rows.items()]
        ends = [] if self.end is None else [f"    {self.end} --> [*]"]
        return "\n".join(["stateDiagram-v2", f"    [*] --> {self.start}", *rows, *ends]) + "\n"
