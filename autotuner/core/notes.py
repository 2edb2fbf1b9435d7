"""Messages of two kinds: a warning asks the reader to act, a note is worth knowing.

Invariant: a message is a warning unless its author made it a `Note`; both travel in one sequence, in the order
of their importance, and are parted where they are shown. A `Doubt` is a warning that the model may be wrong: where the
gains are shown to hold all the same, it is only worth knowing (`settled`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable


SMALL_MISFIT = 0.05
"""What a model misses, as a share of the PV's standard deviation, up to which it is noted: robust gains bear it."""


class Note(str):
    """A message that asks for no action: the gains already allow for what it reports."""

    __slots__ = ()


class Doubt(str):
    """A warning of what a model misses: gains for it may be wrong."""

    __slots__ = ()


def settled(messages: Iterable[str]) -> tuple[str, ...]:
    """Return the messages about gains that are shown to hold: what was doubted is worth knowing."""
    return tuple(Note(message) if isinstance(message, Doubt) else message for message in messages)


def warnings_among(messages: Iterable[str]) -> list[str]:
    """Return the messages that ask for action."""
    return [str(message) for message in messages if not isinstance(message, Note)]


def notes_among(messages: Iterable[str]) -> list[str]:
    """Return the messages that are only worth knowing."""
    return [str(message) for message in messages if isinstance(message, Note)]
