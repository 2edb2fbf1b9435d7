"""Messages of two kinds: a warning asks the reader to act, a note is worth knowing.

Rule of this file: a message is a warning unless its author made it a `Note`; both travel in one sequence, in the order
of their importance, and are parted where they are shown.
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


def warnings_among(messages: Iterable[str]) -> list[str]:
    """Return the messages that ask for action."""
    return [message for message in messages if not isinstance(message, Note)]


def notes_among(messages: Iterable[str]) -> list[str]:
    """Return the messages that are only worth knowing."""
    return [str(message) for message in messages if isinstance(message, Note)]
