"""Work that outlasts a dead link, and work that outlasts the cancellation of its caller.

Invariants:

1. `persistently` retries with back-off until its time limit. It ends earlier once the end was requested twice, but not
   before the first attempt is over. A device that `follows` a write, which may be a slow one, is followed to the end.
2. `uncancelled` and `to_its_end` finish their work whatever happens to the caller; they differ in what counts then.
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
    """Return what `attempt` returns; try again with back-off while it raises.

    None when `limit_s` is over, or by `forced_shutdown`: then no attempt under way is waited for, but one whose device
    `follows`, and the first.
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
    """Return how long to wait after so many attempts; towards the end less, so that the last comes before it."""
    longest_s = min(LONGEST_PAUSE_S, FIRST_PAUSE_S * 2.0 ** min(attempts - 1, 16))
    return min(longest_s, max(left_s / 2.0, FIRST_PAUSE_S), left_s)


async def _pause(wait_s: float) -> bool:
    """Wait so long; return at once, and whether that is so, when it is `forced_shutdown`."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(wait_s):
            await forced_shutdown().wait()
    return forced_shutdown().is_set()


async def _bounded(work: Coroutine[object, object, T], left_s: float, follows: Callable[[], bool], *, cut: bool) -> T:
    """Return what `work` returns; raise `DriverError` when the time is over, or with `cut` by `forced_shutdown`."""
    task, said = asyncio.ensure_future(work), asyncio.ensure_future(forced_shutdown().wait())
    awaited = (task, said) if cut else (task,)
    try:
        await asyncio.wait(awaited, timeout=max(left_s, 0.0), return_when=asyncio.FIRST_COMPLETED)
        if follows():
            await asyncio.wait((task,))
    finally:
        for one in (task, said):
            one.cancel()
        await asyncio.gather(task, said, return_exceptions=True)
    if task.cancelled():
        why = "the end was requested again" if cut and forced_shutdown().is_set() else "its time was over"
        raise DriverError(f"was given up: {why}", remedy="It is tried with the next start.")
    return task.result()


async def quietly(work: Coroutine[object, object, object]) -> None:
    """Do what no longer changes the state of the loop, such as disconnecting, whatever the driver raises."""
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
