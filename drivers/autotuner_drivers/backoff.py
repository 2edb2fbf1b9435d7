"""When to try a dead link again. Pure: time is an argument, s."""

from __future__ import annotations

from typing import Final

FIRST_PAUSE_S: Final = 0.1
LONGEST_PAUSE_S: Final = 2.0


class Backoff:
    """Pauses between attempts that double up to `LONGEST_PAUSE_S`; `reason` is why the last one failed."""

    def __init__(self) -> None:
        self.reason: Exception = ConnectionError("not tried yet")
        self._pause_s = 0.0
        self._not_before_s = 0.0

    def wait_s(self, now_s: float) -> float:
        """Return how long the next attempt is still to be put off, s."""
        return max(self._not_before_s - now_s, 0.0)

    def failed(self, now_s: float, reason: Exception) -> None:
        """Take note of a failed attempt."""
        self._pause_s = min(max(2.0 * self._pause_s, FIRST_PAUSE_S), LONGEST_PAUSE_S)
        self._not_before_s = now_s + self._pause_s
        self.reason = reason

    def succeeded(self) -> None:
        """Take note of a connection."""
        self._pause_s = 0.0

    def forgive(self) -> None:
        """Allow the next attempt at once."""
        self._not_before_s = 0.0
