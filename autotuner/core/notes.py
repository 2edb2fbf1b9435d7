"""Messages of two kinds: a warning requires action, a note is for information.

Invariant: a message is a warning unless its author made it a `Note`; both are in one sequence, in the order
of their importance, and are separated for display. A `Doubt` is a warning that the model may be wrong: where the
gains are confirmed in other ways, it becomes a note (`settled`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable


SMALL_MISFIT = 0.05
"""Largest misfit of a model, as a share of the PV's standard deviation, that is only a note for robust gains."""


class Note(str):
    """A message that requires no action: the gains already allow for its subject."""

    __slots__ = ()


class Doubt(str):
    """A warning of a misfit of the model: its gains may be wrong."""

    __slots__ = ()


def settled(messages: Iterable[str]) -> tuple[str, ...]:
    """Return the messages about gains that are confirmed: doubts become notes."""
    return tuple(Note(message) if isinstance(message, Doubt) else message for message in messages)


def warnings_among(messages: Iterable[str]) -> list[str]:
    """Return the messages that ask for action."""
    return [str(message) for message in messages if not isinstance(message, Note)]


def notes_among(messages: Iterable[str]) -> list[str]:
    """Return the messages for information only."""
    return [str(message) for message in messages if isinstance(message, Note)]
