"""How long the event loop stood still while something was awaited on it: because the program was paused, above all.

    beat_k = beat_(k-1) + PULSE_S         still += now - due, where that is more than `PULSE_S`

A call that ran into its time limit may have been left without an answer, or have had nobody to take it. A timer that
goes off late tells them apart.
"""

from __future__ import annotations

import asyncio

PULSE_S = 0.25
"""Time between two beats, s; what is less late than that is the usual work of others."""


class Pulse:
    """Beats on the running event loop until it is ended."""

    __slots__ = ("_loop", "_next", "_still_s")

    def __init__(self) -> None:
        loop = self._loop = asyncio.get_running_loop()
        self._still_s = 0.0
        self._next = loop.call_at(loop.time() + PULSE_S, self._beat)

    def end(self) -> float:
        """Return for how long the event loop stood still, s; to be called once."""
        self._next.cancel()
        late_s = self._loop.time() - self._next.when()
        return self._still_s + late_s if late_s > PULSE_S else self._still_s

    def _beat(self) -> None:
        now_s = self._loop.time()
        late_s = now_s - self._next.when()
        self._still_s += late_s if late_s > PULSE_S else 0.0
        self._next = self._loop.call_at(now_s + PULSE_S, self._beat)
