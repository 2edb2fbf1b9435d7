"""Another loop that is read while one is tuned, as an operation: in the loop process, where both may share a port.

    open -> whether it is in automatic;   read -> its PV;   until the end is requested

Invariant: the loop is only read, and only when asked.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from autotuner.control.devices.retrying import quietly
from autotuner.control.records.lease_record import Kind
from autotuner.ports import AUTO, PV

if TYPE_CHECKING:
    from autotuner.control.operations.operation import Station
    from autotuner.core.verdict import Verdict

OPEN: Final = "open"
READ: Final = "read"


@dataclass(frozen=True, slots=True)
class ReadAlong:
    """Reads a loop on request, without a result."""

    kind = Kind.TUNING

    def begin(self, station: Station) -> ReadingAlong:
        """Return the operation."""
        return ReadingAlong(station)


class ReadingAlong:
    """The reading of one loop; see `autotuner.control.operations.operation.Answering`."""

    def __init__(self, station: Station) -> None:
        self._backend = station.backend
        self._ended = asyncio.Event()

    async def run(self) -> None:
        """Wait for the end, then close the device."""
        try:
            await self._ended.wait()
        finally:
            await quietly(self._backend.close())

    async def ask(self, name: str, *_values: object) -> float | bool:
        """Open the device and return whether it is in automatic, or return its PV."""
        if name == OPEN:
            await self._backend.open()
            return AUTO in self._backend.readable and bool((await self._backend.read({AUTO}))[AUTO])
        return (await self._backend.read({PV}))[PV]

    def abort(self, _verdict: Verdict) -> None:
        """Request the end."""
        self._ended.set()
