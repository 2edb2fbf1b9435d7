"""A backend whose calls have a time limit.

Every driver must end each call on its own. This wrapper covers a driver that does not: a heater must not stay on
because an answer is awaited.

Invariant: a call that takes longer than `limit_s` is cancelled and fails as `DeviceTimeoutError`; `interrupt`
does the same at once to the current call.
"""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, TypeVar

from autotuner.control.clock.real_time import StallMeter
from autotuner.errors import DeviceTimeoutError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Collection, Mapping

    from autotuner.control.clock.ticker import Tick
    from autotuner.ports import Backend

T = TypeVar("T")

LONGEST_CALL_S = 60.0
"""Longest call of any driver where no shorter limit applies: connecting, polling, restoring."""


class BackendWithTimeout:
    """A backend around another one; implements `autotuner.ports.Backend`.

    Parameters
    ----------
    backend : Backend
        The device.
    limit_s : float
        Longest call, s.
    """

    def __init__(self, backend: Backend, limit_s: float = LONGEST_CALL_S) -> None:
        self._backend = backend
        self._limit_s = limit_s
        self._call: asyncio.Timeout | None = None
        self._still_s = self._called_s = self._waited_s = 0.0
        self._queried_s = math.nan

    @property
    def readable(self) -> frozenset[str]:
        """Signals of the device."""
        return self._backend.readable

    @property
    def writable(self) -> frozenset[str]:
        """Signals of the device."""
        return self._backend.writable

    async def open(self) -> None:
        """Connect."""
        await self._within_limit(self._backend.open())

    async def read(self, names: Collection[str]) -> dict[str, float]:
        """Read."""
        return await self._within_limit(self._backend.read(names))

    async def write(self, values: Mapping[str, float]) -> None:
        """Write."""
        await self._within_limit(self._backend.write(values))

    async def close(self) -> None:
        """Disconnect."""
        await self._within_limit(self._backend.close())

    def stood_still_s(self, tick: Tick | None = None) -> float:
        """Return how long no reading was possible since the last call, s.

        The sum of the time for which a call blocked the event loop and, up to a tick, of the time outside of calls and
        waits: computations, a disk, other tasks of this event loop.
        """
        now_s = asyncio.get_running_loop().time()
        called_s, still_s, queried_s = self._called_s, self._still_s, self._queried_s
        self._called_s, self._still_s, self._queried_s = 0.0, 0.0, now_s
        if tick is None:
            return still_s
        waited_s, self._waited_s = tick.waited_s - self._waited_s, tick.waited_s
        own_s = 0.0 if math.isnan(queried_s) else now_s - queried_s - called_s - waited_s
        return still_s + tick.slept_s + max(own_s, tick.lateness_s)

    def interrupt(self) -> None:
        """Cancel the current call, if any."""
        if self._call is not None and not self._call.expired():
            self._call.reschedule(asyncio.get_running_loop().time())

    async def _within_limit(self, call: Awaitable[T]) -> T:
        stall_meter, begun_s = StallMeter(), asyncio.get_running_loop().time()
        try:
            async with asyncio.timeout(self._limit_s) as self._call:
                return await call
        except TimeoutError as error:
            raise DeviceTimeoutError(
                f"the device was given up after {self._limit_s:g} s at most without an answer",
                remedy="Check the link. Where it only loses an answer now and then, set timeout_s of the device well "
                "below safety.pv_timeout_s, so that there is time to ask again.",
            ) from error
        finally:
            self._call = None
            self._still_s += stall_meter.end()
            self._called_s += asyncio.get_running_loop().time() - begun_s
