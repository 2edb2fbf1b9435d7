"""Server-sent events, line by line (HTML standard, section 9.2.6). Nothing here sends or waits."""

from __future__ import annotations

import json
from typing import Any

from autotuner.client.errors import StreamError

ENDS = ("ended", "verification_ended")
"""Types of the last event: of a tuning, and of a verification."""
ATTEMPTS = 5
"""Number of attempts to resume a broken stream without an event in between."""


class Lines:
    """Takes the lines of a stream and gives its events.

    Parameters
    ----------
    last : int
        Index of the event after which the stream begins.

    Attributes
    ----------
    last : int
        Index of the last event that was given; -1 before the first.
    ended : bool
        Whether it was the last event.
    """

    def __init__(self, last: int = -1) -> None:
        self.last = last
        self.ended = False
        self._fields: dict[str, str] = {}
        self._failures = 0

    def take(self, line: str) -> dict[str, Any] | None:
        """Return the event that a line completes; None when it completes none."""
        if line:
            name, _, value = line.partition(":")
            if name:  # a line that begins with a colon is a comment, which keeps the connection open
                self._fields[name] = value.removeprefix(" ")
            return None
        fields, self._fields = self._fields, {}
        if "data" not in fields:
            return None
        event: dict[str, Any] = json.loads(fields["data"])
        self.last = int(fields.get("id", self.last + 1))
        self.ended = event.get("type") in ENDS
        self._failures = 0
        return event

    def broken(self, reason: Exception | None) -> None:
        """Forget the part of an event that a broken connection left; raise `StreamError` when it breaks too often."""
        self._fields = {}
        self._failures += 1
        if self._failures > ATTEMPTS:
            raise StreamError(
                f"the events broke off {self._failures} times after the one of index {self.last}",
                remedy="Check that the service runs; then resume after that event.",
            ) from reason
