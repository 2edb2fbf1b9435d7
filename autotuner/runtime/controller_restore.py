"""Giving a loop back that its device's own controller was used on: set point, then mode and output.

Rules of this file:

1. It is the one way for a verification, a run over operating points, and what a killed program left of either.
2. A step stands in the journal before it is made; that of the mode only behind a look that has succeeded, so that a
   dead link leaves no note of what the device was never told.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from autotuner.ports import AUTO, OUTPUT, SET_POINT
from autotuner.runtime.restore import persistently

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from autotuner.runtime.open_journal import OpenJournal
    from autotuner.runtime.restore import Before, Restorer

T = TypeVar("T")

MANUAL = 0.0


@dataclass(frozen=True, slots=True)
class ControllerRestorer:
    """Brings set point, mode and output of one loop back.

    Attributes
    ----------
    restorer : Restorer
        Brings the output back, with the device, the clock and the longest time for each step.
    journal : OpenJournal or None
        Takes note of what is about to be done.
    """

    restorer: Restorer
    journal: OpenJournal | None = None

    async def restore(self, before: Before, target: float | None) -> bool:
        """Bring everything back; return whether it was done.

        Parameters
        ----------
        before : Before
            How the loop was found.
        target : float or None
            Output at which it ends, by way of manual; None leaves output and mode to the device.
        """
        return await self.set_point(before) and (target is None or await self.output(before, target))

    async def set_point(self, before: Before) -> bool:
        """Bring the set point back; return whether it was done."""
        found = before.set_point
        assert found is not None  # noqa: S101 - a loop whose set point is moved has one

        async def attempt() -> bool:
            await self.restorer.backend.open()
            await self.restorer.backend.write({SET_POINT: found})
            return True

        return bool(await self._persistently(attempt))

    async def output(self, before: Before, target: float) -> bool:
        """Take the device to manual, then bring output and mode back; return whether it was done."""
        held = await self._persistently(self._to_manual)
        return held is not None and await self.restorer.restore(before, target, held, mode_known=True)

    async def _to_manual(self) -> float:
        """Return the output that the device holds in manual."""
        device = self.restorer.backend
        await device.open()
        await device.read([OUTPUT])
        if self.journal is not None:
            await self.journal.mode(MANUAL)
        await device.write({AUTO: MANUAL})
        held = (await device.read([OUTPUT]))[OUTPUT]
        if self.journal is not None:
            await self.journal.command(held)
        return held

    async def _persistently(self, attempt: Callable[[], Coroutine[object, object, T]]) -> T | None:
        with_whom = self.restorer
        return await persistently(attempt, with_whom.ticker, with_whom.publish, with_whom.limit_s)
