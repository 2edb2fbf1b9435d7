"""Rate-limited log of link errors: once, then a count, because a line may lose every second sample.

    the first of its kind                        at once
    more of that kind                            counted; logged with their count after `AGAIN_S`
    no error for `GOOD_S`                        recovery and the count, where errors were logged
    any other logged event                       counted errors are logged before it

Invariants:

1. Errors that differ only in numbers or in received bytes are of one kind. Beyond `KINDS` kinds they are only counted.
2. Only lines are limited: every error remains an event of its tuning, for the supervisor, the statistics and the page.
3. The known state of the output is not a link error: it is always logged.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from autotuner.control.reporting.events import EstimateUpdated, LinkTrouble, ModelUpdated, SampleTaken

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.control.reporting.events import Event

AGAIN_S = 60.0
"""Shortest time between two lines about trouble of one kind, s."""
GOOD_S = 10.0
"""Time without trouble from which a device answers again, s."""
KINDS = 5
"""Most kinds that are logged separately in `AGAIN_S`."""
PASSING = re.compile(r"""b?'[^']*'|b?"[^"]*"|\d+(\.\d+)?""")
"""Variable parts of a message: received bytes, and numbers."""


@dataclass(slots=True)
class Troubles:
    """Logged and counted errors of one link; times are those of the events, s."""

    _reported_s: dict[str, float] = field(default_factory=dict)
    _last: LinkTrouble | None = None
    _first_s: float = math.nan
    _count: int = 0
    _unreported: int = 0
    _line_s: float = -math.inf
    _open: bool = False

    def take(self, event: Event) -> Sequence[Event]:
        """Return the events to log now: this one, none, or errors that were counted."""
        if isinstance(event, LinkTrouble):
            return self._trouble(event)
        if isinstance(event, SampleTaken):
            return self._good(event) if self._count else ()
        if isinstance(event, EstimateUpdated | ModelUpdated) or not self._unreported or self._last is None:
            return (event,)
        return self._line(event.t, f"{self._unreported} more failed, the last: {self._last.message}"), event

    def _trouble(self, event: LinkTrouble) -> Sequence[Event]:
        self._first_s = self._first_s if self._count else event.t
        self._count, self._last = self._count + 1, event
        self._reported_s = {kind: at_s for kind, at_s in self._reported_s.items() if event.t - at_s < AGAIN_S}
        kind = PASSING.sub("", event.message)
        if kind in self._reported_s or len(self._reported_s) >= KINDS:
            self._unreported += 1
            return ()
        self._reported_s[kind], self._open = event.t, True
        return (
            self._line(event.t, event.message + (f" ({self._unreported} more before it)" if self._unreported else "")),
        )

    def _good(self, event: SampleTaken) -> Sequence[Event]:
        assert self._last is not None  # noqa: S101 - it was counted
        if event.t - self._last.t < GOOD_S or not (self._open or event.t - self._line_s >= AGAIN_S):
            return ()
        text = f"the device answers again: {self._count} calls failed within {self._last.t - self._first_s:.3g} s"
        self._count, self._open = 0, False
        return (self._line(event.t, text),)

    def _line(self, now_s: float, message: str) -> LinkTrouble:
        self._unreported, self._line_s = 0, now_s
        return LinkTrouble(now_s, message)
