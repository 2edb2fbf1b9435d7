"""The way back of one loop that another process left behind: what it did is known from its journal.

    output (a tuning)                                      output, then mode
    set point (a verification, a run over set points)      set point, then mode and output

Rules of this file:

1. Everything goes back through `Restorer` and `ControllerRestorer`, as at every other end; over a dead link it is tried
   until its limit.
2. What the device holds is read first. In another mode, or at an output or a set point where the interrupted program
   never put it, somebody has taken the loop over since: nothing is written.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from autotuner.core.safety import Supervisor
from autotuner.ports import AUTO, OUTPUT, SET_POINT
from autotuner.runtime.controller_restore import MANUAL, ControllerRestorer
from autotuner.runtime.device_gains import same_number
from autotuner.runtime.patient import Patient
from autotuner.runtime.restore import Restorer, persistently, quietly, tolerance_of
from autotuner.runtime.ticker import Ticker

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from autotuner.configuration import LoopTable
    from autotuner.ports import Backend
    from autotuner.runtime.events import Event
    from autotuner.runtime.journal_file import Kept
    from autotuner.runtime.open_journal import OpenJournal
    from autotuner.runtime.restore import Before


NOTHING = "nothing of the loop had to be restored"
UNKNOWN = "the output could not be brought back to {:g}: what it is now is unknown"
SET_POINT_UNKNOWN = "the set point could not be brought back to {:g}: what it is now is unknown"
NEVER_PUT = "where it had never been put: it was left there"


class Back(NamedTuple):
    """How the way back of a loop went, and whether it was given back."""

    what: str
    done: bool = True


@dataclass(frozen=True, slots=True)
class WayBack:
    """The way back of one interrupted loop.

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
    journal : OpenJournal or None
        Takes note of what is about to be done.
    """

    kept: Kept
    loop: LoopTable
    backend: Backend
    publish: Callable[[Event], None]
    limit_s: float
    journal: OpenJournal | None = None

    async def go(self) -> Back:
        """Give the loop back, or leave it to whoever has taken it over; not done where it is unknown how it stands."""
        before = self.kept.before
        if before is None or self.kept.restored:
            return Back(NOTHING)
        device, ticker = Patient(self.backend), Ticker(self.loop.sample_time_s)

        async def look() -> dict[str, float]:
            await device.open()
            return await device.read([name for name in (OUTPUT, AUTO, SET_POINT) if name in device.readable])

        try:
            seen = await persistently(look, ticker, self.publish, self.limit_s)
            restorer = self._restorer(device, ticker)
            if before.set_point is None:
                return await self._output(before, seen, restorer)
            return await self._set_point(before, before.set_point, seen, restorer)
        finally:
            await quietly(device.close())

    async def _output(self, before: Before, seen: Mapping[str, float] | None, restorer: Restorer) -> Back:
        target = before.output if self.kept.target is None else self.kept.target
        if seen is None:
            return Back(UNKNOWN.format(target), done=False)
        if seen.get(AUTO):
            return Back("the device's own controller drives the output: nothing was written")
        if left := self._left_at(seen, target):
            return left
        done = await restorer.restore(before, target, seen.get(OUTPUT, math.nan))
        return Back((f"the output is back at {target:g}" if done else UNKNOWN.format(target)), done)

    async def _set_point(
        self, before: Before, found: float, seen: Mapping[str, float] | None, restorer: Restorer
    ) -> Back:
        if seen is None:
            return Back(SET_POINT_UNKNOWN.format(found), done=False)
        controller, target = ControllerRestorer(restorer, self.journal), self._target(before, seen)
        ours = self._is_ours(seen[SET_POINT])
        if not ours and (seen[AUTO] or target is None):
            return Back(f"the set point stood at {seen[SET_POINT]:g}, {NEVER_PUT}")
        if ours and not await controller.set_point(before):
            return Back(SET_POINT_UNKNOWN.format(found), done=False)
        told = f"the set point is back at {found:g}" if ours else f"the set point was left at {seen[SET_POINT]:g}"
        return Back(told) if target is None else await self._mode(before, target, seen, controller, told)

    async def _mode(
        self, before: Before, target: float, seen: Mapping[str, float], controller: ControllerRestorer, told: str
    ) -> Back:
        """Bring mode and output back, behind the set point."""
        if seen[AUTO]:
            done = await controller.output(before, target)
        elif self.kept.commanded and (left := self._left_at(seen, target)):
            return Back(f"{told}; {left.what}")
        else:
            done = await controller.restorer.restore(before, target, seen[OUTPUT], mode_known=True)
        way = f"{told}, the output at {target:g}, and the mode as it was"
        return Back(way if done else f"{told}; {UNKNOWN.format(target)}", done)

    def _target(self, before: Before, seen: Mapping[str, float]) -> float | None:
        """Return the output at which the loop ends by way of manual; None leaves output and mode to the device.

        In manual without having been put there, it has never left it, or somebody took it over.
        """
        if not seen[AUTO] and self.kept.mode != MANUAL:
            return None
        return before.output if self.kept.target is None and not before.auto else self.kept.target

    def _is_ours(self, set_point: float) -> bool:
        return any(same_number(self.backend, SET_POINT, set_point, ours) for ours in self.kept.set_points)

    def _left_at(self, seen: Mapping[str, float], target: float) -> Back | None:
        """Return how it shows that somebody drives the output since, or None."""
        held = seen.get(OUTPUT)
        if held is None or self._commanded(held, target):
            return None
        return Back(f"the output stood at {held:g}, {NEVER_PUT}")

    def _commanded(self, held: float, target: float) -> bool:
        """Return whether the output may have been left there: at a command, or on a slew-limited way."""
        commanded, tolerance = self.kept.commanded | {target}, self._tolerance
        if self.loop.limits.output_slew_per_s is not None or math.isnan(held):
            return not (held < min(commanded) - tolerance or held > max(commanded) + tolerance)
        return any(abs(held - output) <= tolerance for output in commanded)

    @property
    def _tolerance(self) -> float:
        return tolerance_of(self.loop.experiment_settings().limits)

    def _restorer(self, device: Backend, ticker: Ticker) -> Restorer:
        supervisor = Supervisor(self.loop.experiment_settings().limits, self.loop.safety_settings())
        return Restorer(device, supervisor, ticker, self.publish, self.limit_s, self._tolerance)
