"""Checks that any driver must pass, ours or another's.

    outcomes = await run(Subject(create=lambda: my_driver.create(options), low=0.0, high=100.0, step=5.0))

Each check creates its own backend, opens it, and leaves the output as it was. The device's output MOVES by `step`, so
use a process that may be moved, or a simulated one.

Invariants: a check tests only the rules of `autotuner.ports`; optional features are checked only where the driver has
them; a failure reports the observed and the expected behaviour.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeVar

from autotuner.errors import AutotunerError, DriverError, LinkError
from autotuner.ports import AUTO, OUTPUT, PV, Backend

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Mapping


T = TypeVar("T")


class Link(Protocol):
    """A link to the device that can be interrupted."""

    async def cut(self) -> None:
        """Break the link."""

    async def hold(self) -> None:
        """Hold all bytes back without breaking the link."""

    async def restore(self) -> None:
        """Repair the link."""


@dataclass(frozen=True, slots=True)
class Subject:
    """A driver and the device on which it is checked.

    Attributes
    ----------
    create : callable
        Returns a new closed backend for the device.
    low, high : float
        Limits of the device's output, output units.
    step : float
        Permitted move of the output, output units.
    response_s : float
        Longest time until the PV shows a step of the output, s.
    call_limit_s : float
        Longest time that any call may take, s.
    tolerance : float
        Largest difference between a written and a read-back output, output units.
    beyond : tuple of float
        Outputs beyond the device's range, to be written; empty where a write of them is not safe.
    unreachable : callable, optional
        Returns a backend for a device that does not exist.
    link : Link, optional
        The link to the device; `autotuner_drivers.testing.link.TcpLink` is one.
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
    link: Link | None = None


class NonconformityError(Exception):
    """A driver violates a rule of the port."""


class NotApplicableError(Exception):
    """The driver lacks the feature that a check tests."""


class Timed:
    """A backend whose calls have a time limit."""

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
        """Return the output; raise `NotApplicableError` where it cannot be read back."""
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
    """Return an open backend in manual; restore output and mode at the end."""
    loop = Timed(subject.create(), subject.call_limit_s)
    await loop.open()
    try:
        found = await loop.read([name for name in (OUTPUT, AUTO) if name in loop.backend.readable])
        if found.get(AUTO) and AUTO in loop.backend.writable:
            await loop.write({AUTO: 0.0})
        try:
            yield loop
        finally:
            await _put_back(loop, found)
    finally:
        await loop.close()


async def _put_back(loop: Timed, found: Mapping[str, float]) -> None:
    with contextlib.suppress(AutotunerError, NonconformityError):
        await loop.open()
        await loop.write(
            {name: found[name] for name in (OUTPUT, AUTO) if name in found and name in loop.backend.writable}
        )


async def refused(call: Awaitable[object], kind: type[Exception], action: str) -> Exception:
    """Return the error of a call that must fail with an error of class `kind` and a remedy."""
    try:
        result = await call
    except kind as error:
        expect(bool(getattr(error, "remedy", "")), f"{action}: the error has no remedy")
        return error
    except NonconformityError:
        raise
    except Exception as error:
        raise NonconformityError(f"{action}: raised {type(error).__name__} where {kind.__name__} is due") from error
    raise NonconformityError(f"{action}: returned {result!r} where {kind.__name__} is due")


TURN_S: Final = 0.01
"""Pause between two steps of a check, s: short against `LONGEST_HOLD_S`, long against a timer."""
LONGEST_HOLD_S: Final = 0.25
"""Longest time for which one call may block the event loop, s."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of one check: `found` is empty after a pass and the reason of a skip when `passed` is None."""

    check: str
    passed: bool | None
    found: str = ""


async def check_port(subject: Subject) -> None:
    """Check that the backend has the calls of the port, reads the PV and writes the output."""
    backend = subject.create()
    expect(isinstance(backend, Backend), "it lacks a call of autotuner.ports.Backend")
    for kind, names, least in (("readable", backend.readable, PV), ("writable", backend.writable, OUTPUT)):
        expect(isinstance(names, frozenset), f"{kind} is a {type(names).__name__}, not a frozenset")
        expect(least in names, f"{kind} lacks {least}")


async def check_read_returns_requested_signals(subject: Subject) -> None:
    """Check that a read returns one float for each name, and for no other."""
    async with opened(subject) as loop:
        for names in ([PV], sorted(loop.backend.readable), []):
            values = await loop.read(names)
            expect(set(values) == set(names), f"read({names}) returned {sorted(values)}")
            wrong = {name: value for name, value in values.items() if type(value) is not float}
            expect(not wrong, f"read returned values that are not floats: {wrong}")


async def check_reads_advance(subject: Subject) -> None:
    """Check that the PV shows a step of the output: reads are fresh, and writes reach the plant."""
    async with opened(subject) as loop:
        first = (await loop.read([PV]))[PV]
        start = await loop.output() if OUTPUT in loop.backend.readable else subject.low
        await loop.write({OUTPUT: _moved(subject, start)})
        clock = asyncio.get_running_loop().time
        deadline_s = clock() + subject.response_s
        readings = {first}
        while clock() < deadline_s and len(readings) < 3:
            await asyncio.sleep(subject.response_s / 100.0)
            readings.add((await loop.read([PV]))[PV])
        expect(len(readings) >= 3, f"the PV stays at {first:g} for {subject.response_s:g} s after a step of the output")


async def check_writes_take_effect(subject: Subject) -> None:
    """Check that the output that is read back is the one that was written, before any other call."""
    async with opened(subject) as loop:
        start = await loop.output()
        for wanted in (_moved(subject, start), start):
            await loop.write({OUTPUT: wanted})
            held = await loop.output()
            expect(abs(held - wanted) <= subject.tolerance, f"wrote an output of {wanted:g}, read back {held:g}")


async def check_limits_are_kept(subject: Subject) -> None:
    """Check that NaN and infinity change nothing, and a value beyond the device is refused or clipped."""
    async with opened(subject) as loop:
        start = await loop.output()
        for value in (math.nan, math.inf, -math.inf):
            await refused(loop.write({OUTPUT: value}), AutotunerError, f"write of {value}")
        expect(abs(await loop.output() - start) <= subject.tolerance, "the output moved at a write of NaN or infinity")
        for value in subject.beyond:
            with contextlib.suppress(AutotunerError):
                await loop.write({OUTPUT: value})
            held = await loop.output()
            inside = subject.low - subject.tolerance <= held <= subject.high + subject.tolerance
            expect(inside, f"wrote {value:g}, the output reads {held:g}, beyond {subject.low:g} to {subject.high:g}")


async def check_mode_is_taken_and_restored(subject: Subject) -> None:
    """Check that a mode that can be written reads as it was written."""
    async with opened(subject) as loop:
        if AUTO not in loop.backend.writable or AUTO not in loop.backend.readable:
            raise NotApplicableError("the mode cannot be written and read")
        for mode in (1.0, 0.0, 1.0, 0.0):
            await loop.write({AUTO: mode})
            reported = (await loop.read([AUTO]))[AUTO]
            expect(reported == mode, f"wrote a mode of {mode:g}, read {reported:g}")


async def check_unknown_signals_are_refused(subject: Subject) -> None:
    """Check that a name that is not in `readable` or `writable` is an error."""
    async with opened(subject) as loop:
        await refused(loop.read(["no_such_signal"]), AutotunerError, "read of an unknown signal")
        await refused(loop.write({"no_such_signal": 0.0}), AutotunerError, "write of an unknown signal")
        await loop.read([PV])


async def check_closed_is_an_error(subject: Subject) -> None:
    """Check that a closed backend, before opening and after closing, gives errors and never values."""
    loop = Timed(subject.create(), subject.call_limit_s)
    await refused(loop.read([PV]), DriverError, "read before open")
    await loop.open()
    await loop.close()
    await refused(loop.read([PV]), DriverError, "read after close")


async def check_open_and_close_may_be_repeated(subject: Subject) -> None:
    """Check that opening twice, closing twice or before opening, and opening again after closing all work."""
    loop = Timed(subject.create(), subject.call_limit_s)
    steps: tuple[Callable[[], Awaitable[Any]], ...] = (
        loop.close, loop.open, loop.open, lambda: loop.read([PV]), loop.close, loop.close,
        loop.open, lambda: loop.read([PV]), loop.close,
    )  # fmt: skip
    try:
        for number, step in enumerate(steps, 1):
            try:
                await step()
            except AutotunerError as error:
                raise NonconformityError(f"call {number} of close, open, open, read, ... failed: {error}") from error
    finally:
        with contextlib.suppress(Exception):
            await loop.close()


async def check_cancelled_calls_leave_the_line_usable(subject: Subject) -> None:
    """Check that reads after reads that were cancelled at any moment are right."""
    async with opened(subject) as loop:
        expected = await loop.output()
        for k in range(20):
            under_way = asyncio.ensure_future(loop.read(sorted(loop.backend.readable)))
            await asyncio.sleep(0.001 * k)
            under_way.cancel()
            await asyncio.gather(under_way, return_exceptions=True)
            held = await loop.output()
            expect(abs(held - expected) <= subject.tolerance, f"after a cancelled read the output reads {held:g}")


async def check_calls_at_once_do_not_mix(subject: Subject) -> None:
    """Check that reads from several tasks each get their own values."""
    async with opened(subject) as loop:
        names = [[name] for name in sorted(loop.backend.readable)] * 3
        results = await asyncio.gather(*(loop.read(requested) for requested in names))
        mixed = [result for requested, result in zip(names, results, strict=True) if set(result) != set(requested)]
        expect(not mixed, f"reads at once returned {mixed}")


async def check_event_loop_is_not_blocked(subject: Subject) -> None:
    """Check that no call blocks the event loop."""
    async with opened(subject) as loop:
        held_up = asyncio.ensure_future(_longest_hold())
        try:
            await asyncio.sleep(0.0)
            for _ in range(5):
                await loop.read([PV])
                await asyncio.sleep(TURN_S)
        finally:
            held_up.cancel()
        longest_s = await held_up
        expect(longest_s <= LONGEST_HOLD_S, f"the event loop was blocked for {longest_s:.2f} s")


async def check_an_absent_device_is_a_link_error(subject: Subject) -> None:
    """Check that opening an absent device fails in time with a `LinkError` that carries its cause."""
    if subject.unreachable is None:
        raise NotApplicableError("no backend for an absent device was given")
    loop = Timed(subject.unreachable(), subject.call_limit_s)
    try:
        error = await refused(loop.open(), LinkError, "open of an absent device")
        expect(error.__cause__ is not None, "the error of an absent device does not carry its cause")
    finally:
        await loop.close()


async def check_a_lost_link_is_an_error(subject: Subject) -> None:
    """Check that reads over a lost link fail with a `LinkError`, never with NaN, and that close and open mend it."""
    async with _disturbed(subject) as (loop, link, before):
        await link.cut()
        error = await _first_error(subject, loop)
        expect(isinstance(error, LinkError), f"a lost link is a {type(error).__name__}, not a LinkError: {error}")
        await link.restore()
        await _reopened(subject, loop)
        held = await loop.output()
        expect(abs(held - before) <= subject.tolerance, f"after a lost link the output reads {held:g}, not {before:g}")


async def check_an_answer_that_blocks_is_an_error(subject: Subject) -> None:
    """Check that a write without an answer ends in time with a `LinkError`, and that later calls are right."""
    async with _disturbed(subject) as (loop, link, before):
        wanted = _moved(subject, before)
        await link.hold()
        await refused(loop.write({OUTPUT: wanted}), LinkError, "write over a link that lets nothing pass")
        await link.restore()
        await _reopened(subject, loop)
        await loop.write({OUTPUT: before})
        held = await loop.output()
        expect(
            abs(held - before) <= subject.tolerance, f"after a blocked write the output reads {held:g}, not {before:g}"
        )


async def check_a_lost_link_while_closed_is_none(subject: Subject) -> None:
    """Check that closing over a dead link raises nothing and ends, and that the backend may be opened again."""
    async with _disturbed(subject) as (loop, link, _):
        await link.cut()
        await loop.close()
        await link.restore()
        await _reopened(subject, loop)
        await loop.read([PV])


@contextlib.asynccontextmanager
async def _disturbed(subject: Subject) -> AsyncIterator[tuple[Timed, Link, float]]:
    """Return an open backend in manual, its link and its output; restore the link at the end."""
    if subject.link is None:
        raise NotApplicableError("no link that can be interrupted was given")
    async with opened(subject) as loop:
        try:
            yield loop, subject.link, await loop.output()
        finally:
            await subject.link.restore()
            with contextlib.suppress(Exception):
                await _reopened(subject, loop)


async def _first_error(subject: Subject, loop: Timed) -> Exception:
    """Read until a read fails; NaN, and reads that never fail, are nonconformities."""
    clock = asyncio.get_running_loop().time
    deadline_s = clock() + subject.call_limit_s
    while clock() < deadline_s:
        try:
            value = (await loop.read([PV]))[PV]
        except NonconformityError:
            raise
        except Exception as error:  # noqa: BLE001 - its kind is what is checked
            return error
        expect(not math.isnan(value), "a lost link reads as NaN")
        await asyncio.sleep(TURN_S)
    raise NonconformityError(f"reads over a lost link continued for {subject.call_limit_s:g} s")


async def _reopened(subject: Subject, loop: Timed) -> None:
    """Reopen with `close` and `open`, as a restore does, until it succeeds."""
    clock = asyncio.get_running_loop().time
    deadline_s = clock() + subject.call_limit_s
    while True:
        await loop.close()
        try:
            await loop.open()
        except AutotunerError as error:
            if clock() > deadline_s:
                raise NonconformityError(f"close and open do not restore the link: {error}") from error
            await asyncio.sleep(10.0 * TURN_S)
        else:
            return


CHECKS: Final[dict[str, Callable[[Subject], Awaitable[None]]]] = {
    "port": check_port,
    "read returns what was requested": check_read_returns_requested_signals,
    "reads advance": check_reads_advance,
    "writes take effect": check_writes_take_effect,
    "limits are kept": check_limits_are_kept,
    "mode is taken and restored": check_mode_is_taken_and_restored,
    "unknown signals are refused": check_unknown_signals_are_refused,
    "closed is an error": check_closed_is_an_error,
    "open and close may be repeated": check_open_and_close_may_be_repeated,
    "cancelled calls leave the line usable": check_cancelled_calls_leave_the_line_usable,
    "calls at once do not mix": check_calls_at_once_do_not_mix,
    "the loop goes on": check_event_loop_is_not_blocked,
    "an absent device is a link error": check_an_absent_device_is_a_link_error,
    "a lost link is an error": check_a_lost_link_is_an_error,
    "an answer that blocks is an error": check_an_answer_that_blocks_is_an_error,
    "a lost link while closed is none": check_a_lost_link_while_closed_is_none,
}
"""Published checks; every check also limits each call to `call_limit_s`."""


async def run(subject: Subject, checks: Collection[str] = tuple(CHECKS)) -> list[Outcome]:
    """Run checks by name, one after another; a failed check does not stop the others."""
    return [await _outcome(name, subject) for name in checks]


async def _outcome(name: str, subject: Subject) -> Outcome:
    try:
        await CHECKS[name](subject)
    except NotApplicableError as reason:
        return Outcome(name, None, str(reason))
    except NonconformityError as found:
        return Outcome(name, passed=False, found=str(found))
    except Exception as error:  # noqa: BLE001 - whatever a driver raises out of place is its nonconformity
        return Outcome(name, passed=False, found=f"raised {type(error).__name__}: {error}")
    return Outcome(name, passed=True)


def _moved(subject: Subject, start: float) -> float:
    return start + subject.step if start + subject.step <= subject.high else start - subject.step


async def _longest_hold() -> float:
    """Return the longest interval between two iterations of the event loop, less the pause, s; until cancelled."""
    clock = asyncio.get_running_loop().time
    longest_s, last_s = 0.0, clock()
    with contextlib.suppress(asyncio.CancelledError):
        while True:
            await asyncio.sleep(TURN_S)
            longest_s, last_s = max(longest_s, clock() - last_s - TURN_S), clock()
    return longest_s
