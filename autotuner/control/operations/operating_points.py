"""A run over operating points as an operation: the set point moved from point to point, and restored.

    find -> settle -> (a tuning) -> settle -> (a tuning) -> .. -> release

Invariant: the run writes nothing but the set point, under its lease; `release` restores it. Where the
front is gone, the release begins once the tuning at a point has released the loop.
"""

from __future__ import annotations

import asyncio
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from autotuner.control.devices.retrying import uncancelled
from autotuner.control.driving.lease import lease_of
from autotuner.control.driving.settling import settle
from autotuner.control.operations.crash_recovery import SET_POINT_BACK
from autotuner.control.operations.messages import ALONE
from autotuner.control.records.lease_record import Before, Kind
from autotuner.core.safety.supervisor import DRIVEN_BY_OTHERS
from autotuner.errors import TuningStateError
from autotuner.ports import AUTO, OUTPUT, SET_POINT

if TYPE_CHECKING:
    from autotuner.control.operations.operation import Station
    from autotuner.core.verdict import Verdict


@dataclass(frozen=True, slots=True)
class VisitPoints:
    """The set point is moved on request, and restored."""

    kind = Kind.SCHEDULE

    def begin(self, station: Station) -> Points:
        """Return the operation."""
        return Points(station)


class Points:
    """A run over operating points; see `autotuner.control.operations.operation.Answering`."""

    def __init__(self, station: Station) -> None:
        self._station = station
        self._lease = lease_of(station.loop, station.backend, Kind.SCHEDULE, station.journal)
        self._one, self._over = asyncio.Lock(), asyncio.Event()
        self._released: bool | None = None

    def abort(self, verdict: Verdict) -> None:
        """Request the end: the loop settles no more; without a front its set point is restored."""
        self._lease.abort(verdict)
        if verdict.code == ALONE.code:
            self._over.set()

    async def run(self) -> None:
        """Wait for the release, or do it without a front."""
        await self._over.wait()
        if self._released is None:
            await self._station.others()
            await self.ask("release", ALONE)

    async def ask(self, name: str, *values: object) -> object:
        """Execute a request: the name of a method with its values; raise its exception."""
        async with self._one:
            return await getattr(self, name)(*values)

    async def find(self) -> Before:
        """Record the state of the loop; raise `TuningStateError` unless the device's own controller drives it."""
        lease = self._lease
        try:
            await lease.open()
            readings = await lease.device.read([SET_POINT, AUTO, OUTPUT])
        finally:
            await uncancelled(lease.close())
        if not readings[AUTO]:
            raise TuningStateError(
                "is in manual, and only its own controller can take it from point to point",
                field="loop",
                value=self._station.name,
                remedy="Put it to auto; or tune at each point by hand and combine the tunings.",
            )
        found = Before(readings[OUTPUT], readings[AUTO], readings[SET_POINT])
        await lease.hold(found)
        return found

    async def settle(self, set_point: float) -> Verdict | None:
        """Move the set point, and wait until the loop rests there; return why it does not, or None."""
        return await settle(self._lease, self._station.loop, set_point)

    async def note(self, tuning: str) -> None:
        """Record a tuning that was begun at a point."""
        if self._station.journal is not None:
            await self._station.journal.point(tuning)

    async def release(self, verdict: Verdict) -> bool:
        """Restore the set point, unless another one drives the loop; return whether it was done."""
        lease, journal = self._lease, self._station.journal
        if self._released is not None:
            return self._released
        lease.abort(verdict)
        if verdict.code in DRIVEN_BY_OTHERS:
            lease.leave()
        try:
            done = await lease.release()
        finally:
            await uncancelled(lease.close())
        if done and self._station.alone and journal is not None:
            found = math.nan if lease.found is None or lease.found.set_point is None else lease.found.set_point
            await journal.released(SET_POINT_BACK.format(found))
        self._released = done
        self._over.set()
        return done
