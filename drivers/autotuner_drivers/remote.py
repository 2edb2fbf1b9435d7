"""Base of drivers on a client library: serialised calls, time limits, reconnection and errors for every protocol.

Invariants:

1. One call at a time. A cancelled call runs to its end first, so it never overtakes a later write.
2. Every call ends within `timeout_s`; connecting has a time limit of the same length.
3. A call connects when no connection exists. After a failed attempt, calls fail at once until the pause of
`Backoff` is over; `open` tries at once. A call that lost the link, or got no answer, closes the connection.
4. `close` always ends the connection; the backend may be opened again.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections import deque
from statistics import median
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from autotuner.errors import AutotunerError, DeviceTimeoutError, DriverError, LinkError
from autotuner.ports import PV
from autotuner_drivers.links import REMEMBERED, Backoff, link_error, put_off
from autotuner_drivers.options import check_finite, check_names

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence

T = TypeVar("T")


class Transport(Protocol):
    """Calls that a protocol implements; they never overlap."""

    @property
    def label(self) -> str:
        """Address of the device, for messages."""

    @property
    def readable(self) -> frozenset[str]:
        """Names of the signals that can be read."""

    @property
    def writable(self) -> frozenset[str]:
        """Names of the signals that can be written."""

    async def connect(self) -> None:
        """Connect; `disconnect` closes whatever a failed attempt leaves open."""

    async def read(self, names: Sequence[str]) -> dict[str, float]:
        """Return values; NaN for a value that the device reports as unusable."""

    async def write(self, name: str, value: float) -> None:
        """Set one signal; return once the device has accepted it."""

    async def disconnect(self, *, lost: bool) -> None:
        """End the connection in any state; send nothing to the device when the link is `lost`."""

    def error(self, error: Exception) -> DriverError | None:
        """Map an exception of the library to an error of the port; None for an exception of a socket."""

    def limits(self, name: str) -> tuple[float, float]:
        """Return the lowest and highest value of a signal; infinite where there is no limit."""

    def resolution(self, name: str, value: float) -> float:
        """Return the resolution of a signal around `value`, in its unit; 0 where unknown."""


class RemoteBackend:
    """A loop of a `Transport`; implements `autotuner.ports.Backend`.

    Parameters
    ----------
    transport : Transport
        The protocol.
    timeout_s : float
        Longest time of one call, and of connecting, s.
    """

    def __init__(self, transport: Transport, timeout_s: float) -> None:
        self._transport, self._timeout_s = transport, timeout_s
        self._turn = asyncio.Lock()
        self._under_way: asyncio.Task[Any] | None = None
        self._backoff = Backoff()
        self._opened = self._connected = False
        self._took_s: deque[float] = deque(maxlen=REMEMBERED)
        self._moment_s = math.nan

    @property
    def readable(self) -> frozenset[str]:
        """Names of the signals that can be read."""
        return self._transport.readable

    @property
    def writable(self) -> frozenset[str]:
        """Names of the signals that can be written."""
        return self._transport.writable

    @property
    def latency_s(self) -> float:
        """Median duration of the last calls, s; 0 before the first."""
        return median(self._took_s) if self._took_s else 0.0

    @property
    def moment_s(self) -> float:
        """Time of the last sample on the event loop's clock, s: the transport's own, or the middle of the call."""
        own: float = getattr(self._transport, "moment_s", math.nan)
        return self._moment_s if math.isnan(own) else own

    def limits(self, name: str) -> tuple[float, float]:
        """Return the lowest and highest value of a signal; infinite where there is no limit."""
        return self._transport.limits(name)

    def resolution(self, name: str, value: float) -> float:
        """Return the resolution of a signal around `value`, in its unit; 0 where unknown."""
        return self._transport.resolution(name, value)

    def watch(self, on_lost: Callable[[str], None] | None) -> None:
        """Call `on_lost` with the reason when the device reports between two calls that it is gone."""
        if hasattr(self._transport, "gone"):
            self._transport.gone = on_lost

    async def open(self) -> None:
        """Connect now, even during the pause after a failed attempt; do nothing when connected."""
        self._opened = True
        self._backoff.forgive()
        await self._in_turn(self._nothing)

    async def read(self, names: Collection[str]) -> dict[str, float]:
        """Return the value of each named signal, the PV last where they are read one by one."""
        check_names(names, self.readable, "read")
        in_order = sorted(names, key=lambda name: name == PV)
        return await self._in_turn(lambda: self._transport.read(in_order)) if names else {}

    async def write(self, values: Mapping[str, float]) -> None:
        """Set the named signals in the order given."""
        check_names(values, self.writable, "write")
        check_finite(values)
        for name, value in values.items():
            await self._in_turn(lambda name=name, value=value: self._transport.write(name, value))  # type: ignore[misc]

    async def close(self) -> None:
        """Disconnect; the current call fails."""
        self._opened = False
        if self._under_way is not None:
            self._under_way.cancel()
            await asyncio.gather(self._under_way, return_exceptions=True)
            self._under_way = None
        await self._drop(lost=False)

    async def _nothing(self) -> None:
        """Only connect."""

    async def _in_turn(self, call: Callable[[], Awaitable[T]]) -> T:
        async with self._turn:
            if self._under_way is not None:  # cancelled by its caller: wait for its end
                await asyncio.gather(self._under_way, return_exceptions=True)
            if not self._opened:
                raise LinkError(f"{self._transport.label} is not open", remedy="Open the backend first.")
            task = asyncio.ensure_future(self._connected_call(call))
            self._under_way = task
            result = await _finished(task)
            self._under_way = None
        return result

    async def _connected_call(self, call: Callable[[], Awaitable[T]]) -> T:
        clock = asyncio.get_running_loop().time
        if not self._connected:
            await self._connect()
        started_s = clock()
        try:
            async with asyncio.timeout(self._timeout_s):
                result = await call()
        except DriverError as error:
            if isinstance(error, LinkError):
                await self._drop(lost=True)
            raise
        except Exception as error:
            translated = self._translated(error)
            if isinstance(translated, LinkError):
                await self._drop(lost=True)
            raise translated from error
        self._took_s.append(clock() - started_s)
        self._moment_s = (started_s + clock()) / 2.0
        return result

    async def _connect(self) -> None:
        clock = asyncio.get_running_loop().time
        if (wait_s := self._backoff.wait_s(clock())) > 0.0:
            reason = self._backoff.reason
            raise put_off(self._translated(reason), wait_s) from reason
        self._connected = True
        try:
            async with asyncio.timeout(self._timeout_s):
                await self._transport.connect()
        except asyncio.CancelledError:
            await self._drop(lost=True)
            raise
        except Exception as error:
            self._backoff.failed(clock(), error)
            await self._drop(lost=True)
            if isinstance(error, AutotunerError):
                raise
            raise self._translated(error) from error
        self._backoff.succeeded()

    async def _drop(self, *, lost: bool) -> None:
        if self._connected:
            self._connected = False
            with contextlib.suppress(Exception):
                async with asyncio.timeout(self._timeout_s):
                    await self._transport.disconnect(lost=lost)

    def _translated(self, error: Exception) -> DriverError:
        if isinstance(error, DriverError):
            return error
        if isinstance(error, TimeoutError):
            return DeviceTimeoutError(
                f"{self._transport.label} did not answer within {self._timeout_s:g} s",
                remedy="Check that the device is on and its address, or raise timeout_s.",
            )
        return self._transport.error(error) or link_error(error, self._transport.label, self._timeout_s)


async def _finished(task: asyncio.Task[T]) -> T:
    """Return the task's result; the task continues when the caller is cancelled."""
    try:
        return await asyncio.shield(task)
    except asyncio.CancelledError:
        if task.cancelled():  # cancelled by `close`
            raise LinkError("the connection was closed during the call", remedy="Open the backend again.") from None
        raise
