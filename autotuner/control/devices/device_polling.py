"""Polling of an idle loop: short visits to its device.

Invariants:

1. A visit never runs beside a tuning: it is refused while one holds the loop, and ended before one begins.
2. Readings are reads only, one at a time, no more often than every `interval_s`, and only on request.
3. A visit leaves the device disconnected, so that one that serves a single client is free for others.
4. A visit that restores is never ended: what wants the device waits for it.
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
"""Longest call to a device that is only looked at, s."""
SHORTEST_INTERVAL_S = 1.0
"""Shortest time between two polls of a loop, s."""
UNDISTURBED = "connecting disturbs this device (it is reset by it), so it is not looked at between tunings"


@dataclass(frozen=True, slots=True)
class Reading:
    """How a loop was found when it was looked at; None where it is not known.

    Attributes
    ----------
    at : str or None
        Wall-clock time of the last look that succeeded, ISO 8601 in UTC.
    pv, output, set_point, auto : float or None
        What the device reported then.
    error : str or None
        Why the last look failed, with what to do.
    link : str
        ``up`` or ``down`` as of the last look; ``unknown`` before it, and for a device that is not looked at.
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
        Time between two looks, s.
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
        """End the visits under way, and wait for those that restore: something more important wants the device."""
        while self._under_way:
            for task in self._under_way - self._restoring:
                task.cancel()
            await asyncio.wait(self._under_way)

    async def _read(self) -> None:
        try:
            seen = await looked_at(self._backend, (PV, OUTPUT, SET_POINT, AUTO))
        except DriverError as error:
            self.reading = replace(self.reading, error=str(error), link="down")
        else:
            finite_values = {name: value if math.isfinite(value) else None for name, value in seen.items()}
            self.reading = Reading(
                utc_now(),
                finite_values[PV],
                finite_values.get(OUTPUT),
                finite_values.get(SET_POINT),
                finite_values.get(AUTO),
                link="up",
            )


class Polled:
    """A device as it is read between tunings, each time in a visit of its own; implements `autotuner.ports.Backend`.

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
            seen = await self._visit(lambda: looked_at(self._backend, names))
        except LoopBusyError as error:
            raise DriverError("a tuning holds the loop", remedy="Watching goes on after it.") from error
        except asyncio.CancelledError:
            if (this := asyncio.current_task()) is not None and this.cancelling():
                raise
            raise DriverError("the configuration was read again", remedy="Watching goes on.") from None
        if not all(math.isfinite(seen[name]) for name in (PV, OUTPUT)):
            raise DriverError("the device vouches for neither PV nor output now", remedy="Check the device.")
        return seen

    async def write(self, values: Mapping[str, float]) -> None:
        """Refuse: a device that is only read is never written."""
        raise DriverError("is only read", field=", ".join(values), remedy="Start a tuning.")

    async def close(self) -> None:
        """Do nothing: each read disconnects."""


async def looked_at(backend: Backend, names: Iterable[str]) -> dict[str, float]:
    """Connect, read what of `names` can be read, and disconnect; raise `DriverError` where that fails."""
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
