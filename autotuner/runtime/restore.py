"""Giving the loop back: the one place where an output is restored.

Rules of this file:

1. Reached from every path; it cannot be cancelled, only run out of its time limit.
2. The output goes back within limits and slew, is read back where the device allows it, and only then the mode follows.
3. While the link is dead it tries again with back-off, and says "output unknown" until it knows.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from autotuner.errors import DriverError
from autotuner.ports import AUTO, OUTPUT
from autotuner.runtime.events import OutputRestored, OutputUnknown

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from autotuner.core.safety import Supervisor
    from autotuner.ports import Backend
    from autotuner.runtime.events import Event
    from autotuner.runtime.ticker import Ticker

FIRST_WAIT_S = 0.1
LONGEST_WAIT_S = 2.0
READ_BACK_SHARE = 0.005
"""Difference between written and read-back output that counts as equal, as a share of the output range: real outputs
are rounded to the resolution of a register."""

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Before:
    """How the loop was found.

    Attributes
    ----------
    output : float
        Output, output units.
    auto : float or None
        1.0 when the device's own controller drove the output; None when the device has no such signal.
    """

    output: float
    auto: float | None


@dataclass(slots=True)
class Restorer:
    """Brings one loop back to a target output and to its previous mode.

    Attributes
    ----------
    backend : Backend
        The device.
    supervisor : Supervisor
        Has the last word on every write.
    ticker : Ticker
        The clock; its period paces a slew-limited way back.
    publish : callable
        Takes events.
    limit_s : float
        Longest time to keep trying, s.
    tolerance : float
        Largest difference of the read-back, output units.
    """

    backend: Backend
    supervisor: Supervisor
    ticker: Ticker
    publish: Callable[[Event], None]
    limit_s: float
    tolerance: float

    async def restore(self, before: Before, target: float, held: float) -> bool:
        """Bring output and mode back; return whether it was done.

        Parameters
        ----------
        before : Before
            How the loop was found.
        target : float
            Output to end at: the previous, or the declared safe one, output units.
        held : float
            Output commanded last, output units.
        """
        started_s, wait_s, attempts = self.ticker.now_s, FIRST_WAIT_S, 0
        while True:
            try:
                verified = await self._attempt(before, target, held)
            except (DriverError, TimeoutError) as error:
                attempts += 1
                self.publish(OutputUnknown(self.ticker.now_s, attempts, str(error)))
                if self.ticker.now_s - started_s >= self.limit_s:
                    return False
                await asyncio.sleep(wait_s)
                wait_s = min(2.0 * wait_s, LONGEST_WAIT_S)
            else:
                self.publish(OutputRestored(self.ticker.now_s, target, verified))
                return True

    async def _attempt(self, before: Before, target: float, held: float) -> bool:
        await self.backend.open()
        await self._walk(target, held)
        verified = await self._read_back(target)
        if before.auto and AUTO in self.backend.writable:
            await self.backend.write({AUTO: before.auto})
        return verified

    async def _walk(self, target: float, held: float) -> None:
        """Write the target, in steps of the slew limit where there is one."""
        while True:
            held = self.supervisor.permit(target, held, self.ticker.period_s)
            await self.backend.write({OUTPUT: held})
            if held == self.supervisor.permit(target, target, 0.0):
                return
            await asyncio.sleep(self.ticker.period_s)

    async def _read_back(self, target: float) -> bool:
        if OUTPUT not in self.backend.readable:
            return False
        seen = (await self.backend.read([OUTPUT]))[OUTPUT]
        if not abs(seen - target) <= self.tolerance:
            raise DriverError(
                f"the device holds output {seen:g} where {target:g} was written",
                remedy="Check that nothing else writes this output.",
            )
        return True


async def uncancelled(work: Coroutine[object, object, T]) -> T:
    """Run `work` to its end even when the caller is cancelled; the cancellation is raised afterwards."""
    task = asyncio.ensure_future(work)
    cancelled = False
    while not task.done():
        try:
            await asyncio.shield(task)
        except asyncio.CancelledError:
            if task.cancelled():
                raise
            cancelled = True
    if cancelled:
        task.exception()
        raise asyncio.CancelledError
    return task.result()
