"""Time limit and progress reports of a diagnosis: this package reads no clock and prints nothing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


@dataclass(frozen=True, slots=True)
class Budget:
    """The time for a search.

    Attributes
    ----------
    is_spent : callable or None
        Returns whether it is spent; None without a limit. Called before each fit of the search.
    on_progress : callable or None
        Takes a sentence on how far the search is.
    """

    is_spent: Callable[[], bool] | None = None
    on_progress: Callable[[str], None] | None = None

    @property
    def spent(self) -> bool:
        """Whether the search has to end."""
        return self.is_spent is not None and self.is_spent()

    def report(self, sentence: str) -> None:
        """Pass a sentence on."""
        if self.on_progress is not None:
            self.on_progress(sentence)


UNLIMITED = Budget()
