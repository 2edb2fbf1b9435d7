"""Polling of an idle loop: short visits to its device.

Invariants:

1. A visit never overlaps a tuning: it is refused while a tuning holds the loop, and ended before one begins.
2. Readings are reads only, one at a time, no more often than every `interval_s`, and only on request.
3. A visit leaves the device disconnected, so that one that serves a single client is free for others.
4. A visit that restores values is never ended early; other operations on the device wait for it.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, TypeVar

from autotuner.control.clock.call_timeout import BackendWithTimeout
from autotuner.control.clock.ticker import utc_now
from autotuner.control.devices.retrying import uncancelled
from autotuner.errors import DriverError, LoopBusyError
from autotuner.ports import AUTO, OUTPUT, PV, SET_POINT

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Collection, Coroutine, Iterable, Mapping

    from autotuner.ports import Backend

T = TypeVar("T")

LONGEST_READ_S = 5.0
"""Time limit of a call during polling, s."""
SHORTEST_INTERVAL_S = 1.0
"""Shortest time between two polls of a loop, s."""
UNDISTURBED = "connecting resets this device, so it is not polled between tunings"


@dataclass(frozen=True, slots=True)
class Reading:
    """State of a loop at its last poll; None where unknown.

    Attributes
    ----------
    at : str or None
        Wall-clock time of the last successful poll, ISO 8601 in UTC.
    pv, output, set_point, auto : float or None
        Values reported by the device at that time.
    error : str or None
        Error of the last poll, with its remedy.
    link : str
        ``up`` or ``down`` at the last poll; ``unknown`` before it, and for a device that is not polled.
    """

    at: str | None = None
    pv: float | None = None
    output: float | None = None
    set_point: float | None = None
    auto: float | None = None
    error: str | None = None
    link: str = "unknown"

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return asdict(self)


class Visits:
    """The visits to one device.

    Parameters
    ----------
    backend : Backend
        The device.
    interval_s : float
        Shortest time between two polls, s.
    """

    def __init__(self, backend: Backend, interval_s: float) -> None:
        self.reading = Reading(error=UNDISTURBED if resets(backend) else None)
        self._backend = backend
        self._interval_s = max(interval_s, SHORTEST_INTERVAL_S)
        self._looked_s = -math.inf
        self._one = asyncio.Lock()
        self._under_way: set[asyncio.Task[object]] = set()
        self._restoring: set[asyncio.Task[object]] = set()

    async def visit(self, work: Callable[[], Coroutine[object, object, T]], *, restores: bool = False) -> T:
        """Do `work` on the device, after the visit before it; one that `restores` is not ended by `clear`."""
        task = self._begin(self._alone(work), "visit")
        if not restores:
            return await task
        self._restoring.add(task)
        task.add_done_callback(self._restoring.discard)
        return await uncancelled(task)

    async def _alone(self, work: Callable[[], Coroutine[object, object, T]]) -> T:
        async with self._one:
            return await work()

    def _begin(self, work: Coroutine[object, object, T], name: str) -> asyncio.Task[T]:
        task = asyncio.create_task(work, name=name)
        self._under_way.add(task)
        task.add_done_callback(self._under_way.discard)
        return task

    def look(self) -> None:
        """Have the loop polled, unless that was done just now; `reading` is the result."""
        now = asyncio.get_running_loop().time()
        if resets(self._backend) or self._under_way or now - self._looked_s < self._interval_s:
            return
        self._looked_s = now
        self._begin(self._alone(self._read), "look")

    async def clear(self) -> None:
        """End running visits for a more important operation; wait for those that restore values."""
        while self._under_way:
            for task in self._under_way - self._restoring:
                task.cancel()
            await asyncio.wait(self._under_way)

    async def _read(self) -> None:
        try:
            reading = await looked_at(self._backend, (PV, OUTPUT, SET_POINT, AUTO))
        except DriverError as error:
            self.reading = replace(self.reading, error=str(error), link="down")
        else:
            finite_values = {name: value if math.isfinite(value) else None for name, value in reading.items()}
            self.reading = Reading(
                utc_now(),
                finite_values[PV],
                finite_values.get(OUTPUT),
                finite_values.get(SET_POINT),
                finite_values.get(AUTO),
                link="up",
            )


class Polled:
    """A device read between tunings, with a visit for each reading; implements `autotuner.ports.Backend`.

    Parameters
    ----------
    backend : Backend
        The device.
    visit : callable
        Does short work on the device when nothing more important holds it.
    signals : tuple of str
        What is read of it.
    """

    writable: frozenset[str] = frozenset()

    def __init__(
        self,
        backend: Backend,
        visit: Callable[[Callable[[], Coroutine[object, object, dict[str, float]]]], Awaitable[dict[str, float]]],
        signals: Iterable[str],
    ) -> None:
        self.readable = backend.readable & frozenset(signals)
        self._backend, self._visit = backend, visit

    async def open(self) -> None:
        """Do nothing: each read connects."""

    async def read(self, names: Collection[str]) -> dict[str, float]:
        """Connect, read and disconnect; raise `DriverError` where a tuning has the device, or it returns no PV."""
        try:
            reading = await self._visit(lambda: looked_at(self._backend, names))
        except LoopBusyError as error:
            raise DriverError("a tuning holds the loop", remedy="Monitoring continues after it.") from error
        except asyncio.CancelledError:
            if (this := asyncio.current_task()) is not None and this.cancelling():
                raise
            raise DriverError("the configuration was reloaded", remedy="Monitoring continues.") from None
        if not all(math.isfinite(reading[name]) for name in (PV, OUTPUT)):
            raise DriverError("the device vouches for neither PV nor output now", remedy="Check the device.")
        return reading

    async def write(self, values: Mapping[str, float]) -> None:
        """Refuse: a device that is only read is never written."""
        raise DriverError("is only read", field=", ".join(values), remedy="Start a tuning.")

    async def close(self) -> None:
        """Do nothing: each read disconnects."""


async def looked_at(backend: Backend, names: Iterable[str]) -> dict[str, float]:
    """Connect, read the available signals of `names`, and disconnect; raise `DriverError` on failure."""
    device = BackendWithTimeout(backend, LONGEST_READ_S)
    try:
        await device.open()
        return await device.read([name for name in names if name in backend.readable])
    finally:
        with contextlib.suppress(DriverError):
            await uncancelled(device.close())


def resets(backend: Backend) -> bool:
    """Return whether connecting disturbs a device."""
    return bool(getattr(backend, "opening_disturbs", False))
