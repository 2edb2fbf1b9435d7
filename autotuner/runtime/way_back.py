"""The way back of one loop that another process left behind: what it did is known from its journal.

Rules of this file:

1. The output goes back through `Restorer`, as at every other end; over a dead link it is tried until its limit.
2. What the device holds is read first. In auto, or at an output that the interrupted tuning never commanded, somebody
   has taken the loop over since: nothing is written.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from autotuner.core.safety import Supervisor
from autotuner.ports import AUTO, OUTPUT
from autotuner.runtime.patient import Patient
from autotuner.runtime.restore import READ_BACK_SHARE, Restorer, persistently
from autotuner.runtime.ticker import Ticker

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.configuration import LoopTable
    from autotuner.ports import Backend
    from autotuner.runtime.events import Event
    from autotuner.runtime.journal_file import Kept


NOTHING = "nothing of the loop had to be restored"
UNKNOWN = "the output could not be brought back to {:g}: what it is now is unknown"


class Back(NamedTuple):
    """How the way back of a loop went, and whether it was given back."""

    what: str
    done: bool = True


@dataclass(frozen=True, slots=True)
class WayBack:
    """The way back of the loop of one interrupted tuning.

    Attributes
    ----------
    kept : Kept
        What is known of it.
    loop : LoopTable
        Its loop.
    backend : Backend
        The device.
    publish : callable
        Takes events.
    limit_s : float
        Longest time to keep trying, s.
    """

    kept: Kept
    loop: LoopTable
    backend: Backend
    publish: Callable[[Event], None]
    limit_s: float

    async def go(self) -> Back:
        """Give the loop back, or leave it to whoever has taken it over; not done where its output is unknown."""
        before, target = self.kept.before, self.kept.target
        if before is None or target is None or self.kept.restored:
            return Back(NOTHING)
        device, ticker = Patient(self.backend), Ticker(self.loop.sample_time_s)

        async def look() -> dict[str, float]:
            await device.open()
            return await device.read([name for name in (OUTPUT, AUTO) if name in device.readable])

        try:
            seen = await persistently(look, ticker, self.publish, self.limit_s)
            if seen is None:
                return Back(UNKNOWN.format(target), done=False)
            if taken := self._taken_over(seen):
                return Back(taken)
            done = await self._restorer(device, ticker).restore(before, target, seen.get(OUTPUT, math.nan))
        finally:
            await persistently(device.close, ticker, lambda _: None, 0.0)
        return Back((f"the output is back at {target:g}" if done else UNKNOWN.format(target)), done)

    def _taken_over(self, seen: dict[str, float]) -> str | None:
        """Return how it shows that somebody drives the loop since, or None."""
        if seen.get(AUTO):
            return "the device's own controller drives the output: nothing was written"
        held = seen.get(OUTPUT)
        if held is None or self._commanded(held):
            return None
        return f"the output stood at {held:g}, where the tuning had never put it: it was left there"

    def _commanded(self, held: float) -> bool:
        """Return whether the tuning may have left the output there: at a command, or on a slew-limited way."""
        commanded, tolerance = self.kept.commanded, self._tolerance
        if self.loop.limits.output_slew_per_s is not None or math.isnan(held):
            return not (held < min(commanded) - tolerance or held > max(commanded) + tolerance)
        return any(abs(held - output) <= tolerance for output in commanded)

    @property
    def _tolerance(self) -> float:
        low, high = self.loop.limits.output
        return READ_BACK_SHARE * (high - low)

    def _restorer(self, device: Backend, ticker: Ticker) -> Restorer:
        supervisor = Supervisor(self.loop.experiment_settings().limits, self.loop.safety_settings())
        return Restorer(device, supervisor, ticker, self.publish, self.limit_s, self._tolerance)
