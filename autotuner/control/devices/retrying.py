"""Work that continues despite a lost link or the cancellation of its caller.

Invariants:

1. `persistently` retries with back-off until its time limit. It ends earlier once the end was requested twice, but not
   before the first attempt is over. When the device `follows` a write, perhaps slowly, the attempt is awaited.
2. `uncancelled` and `to_its_end` finish their work even when the caller is cancelled; they differ in the result that
   they return in this case.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, TypeVar

from autotuner.control.forced_shutdown import forced_shutdown
from autotuner.control.reporting.events import OutputUnknown
from autotuner.errors import DriverError
from autotuner.ports import FIRST_PAUSE_S, LONGEST_PAUSE_S

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from autotuner.control.clock.ticker import Ticker

NOTHING_S = 1e-3
"""Time in which nothing more is tried, s."""

T = TypeVar("T")


async def persistently(
    attempt: Callable[[], Coroutine[object, object, T]],
    ticker: Ticker,
    publish: Callable[[OutputUnknown], None],
    limit_s: float,
    follows: Callable[[], bool] = lambda: False,
) -> T | None:
    """Return the result of `attempt`; retry with back-off while it raises.

    None after `limit_s`, or at a `forced_shutdown`: then the current attempt is abandoned, unless it is the first or
    the device `follows`.
    """
    end_s, attempts = ticker.now_s + limit_s, 0
    while True:
        try:
            return await _bounded(attempt(), end_s - ticker.now_s, follows, cut=attempts > 0)
        except Exception as error:  # noqa: BLE001 - whatever the driver raises, the next attempt may succeed
            attempts += 1
            publish(OutputUnknown(ticker.now_s, attempts, str(error) or repr(error)))
        left_s = end_s - ticker.now_s
        if left_s < NOTHING_S or await _pause(_wait_s(attempts, left_s)) or end_s - ticker.now_s < NOTHING_S:
            return None


def _wait_s(attempts: int, left_s: float) -> float:
    """Return the pause after a number of attempts; shorter towards the end, so that a last attempt precedes it."""
    longest_s = min(LONGEST_PAUSE_S, FIRST_PAUSE_S * 2.0 ** min(attempts - 1, 16))
    return min(longest_s, max(left_s / 2.0, FIRST_PAUSE_S), left_s)


async def _pause(wait_s: float) -> bool:
    """Wait; return early at a `forced_shutdown`, and whether one was requested."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(wait_s):
            await forced_shutdown().wait()
    return forced_shutdown().is_set()


async def _bounded(work: Coroutine[object, object, T], left_s: float, follows: Callable[[], bool], *, cut: bool) -> T:
    """Return the result of `work`; raise `DriverError` after the time limit, or with `cut` at a `forced_shutdown`."""
    task, shutdown = asyncio.ensure_future(work), asyncio.ensure_future(forced_shutdown().wait())
    awaited = (task, shutdown) if cut else (task,)
    try:
        await asyncio.wait(awaited, timeout=max(left_s, 0.0), return_when=asyncio.FIRST_COMPLETED)
        if follows():
            await asyncio.wait((task,))
    finally:
        for one in (task, shutdown):
            one.cancel()
        await asyncio.gather(task, shutdown, return_exceptions=True)
    if task.cancelled():
        reason = "the end was requested again" if cut and forced_shutdown().is_set() else "its time was over"
        raise DriverError(f"was given up: {reason}", remedy="It is tried with the next start.")
    return task.result()


async def quietly(work: Coroutine[object, object, object]) -> None:
    """Run work that cannot change the state of the loop, such as disconnecting; ignore all errors of the driver."""
    with contextlib.suppress(Exception):
        await work


async def uncancelled(work: Coroutine[object, object, T] | asyncio.Future[T]) -> T:
    """Run `work` to its end even when the caller is cancelled; the cancellation is raised afterwards."""
    task = asyncio.ensure_future(work)
    if await _cancellations(task):
        task.exception()
        raise asyncio.CancelledError
    return task.result()


async def to_its_end(work: Coroutine[object, object, T] | asyncio.Future[T]) -> T:
    """Run `work` to its end even when the caller is cancelled; its result counts then, not the cancellation."""
    task, caller = asyncio.ensure_future(work), asyncio.current_task()
    assert caller is not None  # noqa: S101 - this runs in it
    for _ in range(await _cancellations(task)):
        caller.uncancel()
    return task.result()


async def _cancellations(task: asyncio.Future[T]) -> int:
    """Wait until a task is done; return how often the caller was cancelled meanwhile."""
    count = 0
    while not task.done():
        try:
            await asyncio.wait((task,))
        except asyncio.CancelledError:
            count += 1
    return count
