"""Requests that are sent twice: a start with an `Idempotency-Key` is done once, however often it arrives.

Rules of this file: the same key with another request is refused, never answered with the first one's tuning; looking a
key up and starting is one step, so that two requests that arrive together are one.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING

from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

REMEMBERED = 1000
"""Keys remembered; the oldest go first."""


class Repeats:
    """What was started under which key."""

    def __init__(self) -> None:
        self._started: OrderedDict[str, tuple[str, str]] = OrderedDict()

    def once(self, key: str | None, request: str, start: Callable[[], str]) -> str:
        """Return the tuning of this request: started now, or by the same request before.

        Raises
        ------
        InputError
            The key was used for another request.
        """
        if key is None:
            return start()
        if key in self._started:
            return self._same(key, request)
        self._started[key] = (request, start())
        if len(self._started) > REMEMBERED:
            self._started.popitem(last=False)
        return self._started[key][1]

    def _same(self, key: str, request: str) -> str:
        before, tuning_id = self._started[key]
        if before != request:
            raise InputError(
                "was used for another request",
                field="Idempotency-Key",
                value=key,
                remedy="Make a new key for each tuning, and send it again only with the same request.",
            )
        return tuning_id
