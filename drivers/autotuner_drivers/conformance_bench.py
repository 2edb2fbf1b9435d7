"""What a driver is put on to be checked: a device that may be moved, time limits on every call, and plain verdicts."""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from autotuner.errors import AutotunerError
from autotuner.ports import AUTO, OUTPUT

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Mapping

    from autotuner.ports import Backend

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Subject:
    """A driver and the device that it is checked on.

    Attributes
    ----------
    create : callable
        Returns a new closed backend for the device.
    low, high : float
        Limits of the device's output, output units.
    step : float
        By how much the output may be moved, output units.
    response_s : float
        Longest time until the PV shows a step of the output, s.
    call_limit_s : float
        Longest time that any call may take, s.
    tolerance : float
        Difference between a written and a read-back output that counts as none, output units.
    beyond : tuple of float
        Outputs beyond what the device takes, to be written; empty where that is not safe.
    unreachable : callable, optional
        Returns a backend for a device that is not there.
    """

    create: Callable[[], Backend]
    low: float
    high: float
    step: float
    response_s: float = 30.0
    call_limit_s: float = 10.0
    tolerance: float = 0.05
    beyond: tuple[float, ...] = ()
    unreachable: Callable[[], Backend] | None = None


class NonconformityError(Exception):
    """A driver does not keep a rule of the port."""


class NotApplicableError(Exception):
    """The driver does not offer what a check is about."""


class Timed:
    """A backend of which every call must end within a limit."""

    def __init__(self, backend: Backend, limit_s: float) -> None:
        self.backend, self._limit_s = backend, limit_s

    async def open(self) -> None:
        """Open the backend."""
        await self._within("open", self.backend.open())

    async def read(self, names: Collection[str]) -> dict[str, float]:
        """Read signals."""
        return await self._within("read", self.backend.read(names))

    async def write(self, values: Mapping[str, float]) -> None:
        """Write signals."""
        await self._within("write", self.backend.write(values))

    async def close(self) -> None:
        """Close the backend."""
        await self._within("close", self.backend.close())

    async def output(self) -> float:
        """Return the output where it can be read back."""
        if OUTPUT not in self.backend.readable:
            raise NotApplicableError("the output cannot be read back")
        return (await self.read([OUTPUT]))[OUTPUT]

    async def _within(self, name: str, call: Awaitable[T]) -> T:
        try:
            async with asyncio.timeout(self._limit_s):
                return await call
        except TimeoutError as error:
            raise NonconformityError(f"{name} did not end within {self._limit_s:g} s") from error


def expect(holds: bool, found: str) -> None:  # noqa: FBT001 - reads as a sentence
    """Raise `NonconformityError` unless a rule holds."""
    if not holds:
        raise NonconformityError(found)


@contextlib.asynccontextmanager
async def opened(subject: Subject) -> AsyncIterator[Timed]:
    """Return an open backend in manual, and leave output and mode as they were found."""
    loop = Timed(subject.create(), subject.call_limit_s)
    await loop.open()
    try:
        before = await loop.read([name for name in (OUTPUT, AUTO) if name in loop.backend.readable])
        if before.get(AUTO) and AUTO in loop.backend.writable:
            await loop.write({AUTO: 0.0})
        try:
            yield loop
        finally:
            await _put_back(loop, before)
    finally:
        await loop.close()


async def _put_back(loop: Timed, before: Mapping[str, float]) -> None:
    with contextlib.suppress(AutotunerError, NonconformityError):
        await loop.open()
        await loop.write(
            {name: before[name] for name in (OUTPUT, AUTO) if name in before and name in loop.backend.writable}
        )


async def refused(call: Awaitable[object], kind: type[Exception], what: str) -> Exception:
    """Return the error of a call that must fail with `kind`, and with what to do next."""
    try:
        result = await call
    except kind as error:
        expect(bool(getattr(error, "remedy", "")), f"{what}: the error has no remedy")
        return error
    except NonconformityError:
        raise
    except Exception as error:
        raise NonconformityError(f"{what}: raised {type(error).__name__} where {kind.__name__} is due") from error
    raise NonconformityError(f"{what}: returned {result!r} where {kind.__name__} is due")
