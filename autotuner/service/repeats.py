"""Requests that are sent twice: a start with an `Idempotency-Key` is done once, however often it arrives.

Rule of this file: the same key with another request is refused, never answered with the first one's tuning.
"""

from __future__ import annotations

from collections import OrderedDict

from autotuner.errors import InputError

REMEMBERED = 1000
"""Keys remembered; the oldest go first."""


class Repeats:
    """What was started under which key."""

    def __init__(self) -> None:
        self._started: OrderedDict[str, tuple[str, str]] = OrderedDict()

    def known(self, key: str | None, request: str) -> str | None:
        """Return the tuning that this very request started before; None for a new one.

        Raises
        ------
        InputError
            The key was used for another request.
        """
        if key is None or key not in self._started:
            return None
        before, tuning_id = self._started[key]
        if before != request:
            raise InputError(
                "was used for another request",
                field="Idempotency-Key",
                value=key,
                remedy="Make a new key for each tuning, and send it again only with the same request.",
            )
        return tuning_id

    def remember(self, key: str | None, request: str, tuning_id: str) -> None:
        """Take note of what was started."""
        if key is not None:
            self._started[key] = (request, tuning_id)
            if len(self._started) > REMEMBERED:
                self._started.popitem(last=False)
