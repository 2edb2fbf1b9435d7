"""Giving the loop back: the one place where an output is restored.

Rules of this file:

1. Reached from every path; it cannot be cancelled, only run out of its time limit.
2. The output goes back within limits and slew, is read back where the device allows it, and only then the mode follows.
   A device that is in auto keeps its output: its own controller, or a person, drives it.
3. While the link is dead it tries again with back-off, and says "output unknown" until it knows. It ends at its time
   limit, whatever a driver still waits for then, or once somebody has asked twice for the end, but for the first try. A
   device that has taken a write on its way back, which may be a slow one, is followed to the end.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from autotuner.errors import DriverError
from autotuner.ports import AUTO, OUTPUT
from autotuner.runtime.enough import enough
from autotuner.runtime.events import OutputRestored, OutputUnknown

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from autotuner.core.safety import Supervisor
    from autotuner.core.settings import Limits
    from autotuner.ports import Backend
    from autotuner.runtime.events import Event
    from autotuner.runtime.ticker import Ticker

FIRST_WAIT_S = 0.1
LONGEST_WAIT_S = 2.0
NOTHING_S = 1e-3
"""Time in which nothing more is tried, s."""
READ_BACK_SHARE = 0.005
"""Difference between written and read-back output that counts as equal, as a share of the output range: real outputs
are rounded to the resolution of a register."""

T = TypeVar("T")


def tolerance_of(limits: Limits) -> float:
    """Return the largest difference between written and read-back output that counts as equal, output units."""
    low, high = limits.output
    return READ_BACK_SHARE * (high - low)


@dataclass(frozen=True, slots=True)
class Before:
    """How the loop was found.

    Attributes
    ----------
    output : float
        Output, output units.
    auto : float or None
        1.0 when the device's own controller drove the output; None when the device has no such signal.
    set_point : float or None
        Its set point, PV units; None where nothing moves it.
    """

    output: float
    auto: float | None
    set_point: float | None = None


@dataclass(slots=True)
class Restorer:
    """Brings one loop back to a target output and to its previous mode.

    Attributes
    ----------
    backend : Backend
        The device.
    supervisor : Supervisor
        Has the last word on every write.
    ticker : Ticker
        The clock; its period paces a slew-limited way back.
    publish : callable
        Takes events.
    limit_s : float
        Longest time to keep trying, s.
    tolerance : float
        Largest difference of the read-back, output units.
    """

    backend: Backend
    supervisor: Supervisor
    ticker: Ticker
    publish: Callable[[Event], None]
    limit_s: float
    tolerance: float
    _attempts: int = 0
    _held: float = math.nan
    _mode_known: bool = False
    _follows: bool = False

    async def restore(self, before: Before, target: float, held: float, *, mode_known: bool = False) -> bool:
        """Bring output and mode back; return whether it was done.

        Parameters
        ----------
        before : Before
            How the loop was found.
        target : float
            Output to end at: the previous, or the declared safe one, output units.
        held : float
            Output commanded last, output units.
        mode_known : bool
            Whether the device was just seen in manual: the output is then written before anything is asked.
        """
        self._held = held
        self._mode_known = mode_known
        restored = await persistently(
            lambda: self._attempt(before, target), self.ticker, self._tell, self.limit_s, lambda: self._follows
        )
        self.publish(restored or OutputUnknown(self.ticker.now_s, self._attempts, self._left_at(target)))
        return restored is not None

    def _tell(self, event: OutputUnknown) -> None:
        self._attempts = event.attempts
        self.publish(event)

    def _left_at(self, target: float) -> str:
        """Return where the output is left, as far as that is known."""
        why = "the end was asked for again" if enough().is_set() else f"{self.limit_s:g} s are over"
        last = "nothing is known to have been written" if math.isnan(self._held) else f"{self._held:g} was written last"
        return f"{why}: it is left as it is; {last}, {target:g} is where it was to go back to"

    async def _attempt(self, before: Before, target: float) -> OutputRestored:
        self._follows = False
        await self.backend.open()
        seen = {} if self._mode_known else await self._look()
        self._mode_known = False
        in_auto = bool(seen.get(AUTO))
        if not in_auto:
            self._take_present(seen.get(OUTPUT, self._held))
            await self._walk(target)
        verified = in_auto or await self._read_back(target)
        if before.auto and AUTO in self.backend.writable:  # also when seen in auto: it may not have left it yet
            await self.backend.write({AUTO: before.auto})
        return OutputRestored(self.ticker.now_s, seen.get(OUTPUT, target) if in_auto else target, verified)

    def _take_present(self, seen: float) -> None:
        """Start from what the device holds, where that is more than a rounding away from what was commanded."""
        if not abs(seen - self._held) <= self.tolerance:
            self._held = seen

    async def _look(self) -> dict[str, float]:
        """Return what the device tells of output and mode; writing does not wait for it to tell."""
        names = [name for name in (OUTPUT, AUTO) if name in self.backend.readable]
        try:
            seen = await self.backend.read(names) if names else {}
        except DriverError:
            return {}
        return {name: value for name, value in seen.items() if math.isfinite(value)}

    async def _walk(self, target: float) -> None:
        """Write the target, in steps of the slew limit where there is one."""
        if abs(self._held - target) <= self.tolerance and target != self.supervisor.permit(target, target, 0.0):
            await self.backend.write({OUTPUT: target})  # found outside of its limits, and still there
            return
        while True:
            following = self.supervisor.permit(target, self._held, self.ticker.period_s)
            await self.backend.write({OUTPUT: following})
            self._held, self._follows = following, True
            if self._held == self.supervisor.permit(target, target, 0.0):
                return
            await asyncio.sleep(self.ticker.period_s)

    async def _read_back(self, target: float) -> bool:
        if OUTPUT not in self.backend.readable:
            return False
        seen = (await self.backend.read([OUTPUT]))[OUTPUT]
        if not abs(seen - target) <= self.tolerance:
            raise DriverError(
                f"the device holds output {seen:g} where {target:g} was written",
                remedy="Check that nothing else writes this output.",
            )
        return True


async def persistently(
    attempt: Callable[[], Coroutine[object, object, T]],
    ticker: Ticker,
    publish: Callable[[OutputUnknown], None],
    limit_s: float,
    follows: Callable[[], bool] = lambda: False,
) -> T | None:
    """Return what `attempt` returns; try again with back-off while it raises.

    None when `limit_s` is over, or it is `enough`: then not even an attempt under way is waited for, but one whose
    device `follows`, and by `enough` the first.
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
    longest_s = min(LONGEST_WAIT_S, FIRST_WAIT_S * 2.0 ** min(attempts - 1, 16))
    return min(longest_s, max(left_s / 2.0, FIRST_WAIT_S), left_s)


async def _pause(wait_s: float) -> bool:
    """Wait so long; return at once, and whether that is so, when it is `enough`."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(wait_s):
            await enough().wait()
    return enough().is_set()


async def _bounded(work: Coroutine[object, object, T], left_s: float, follows: Callable[[], bool], *, cut: bool) -> T:
    """Return what `work` returns; give it up with a `DriverError` when the time is over, or with `cut` by `enough`."""
    task, said = asyncio.ensure_future(work), asyncio.ensure_future(enough().wait())
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
        why = "the end was asked for again" if cut and enough().is_set() else "its time was over"
        raise DriverError(f"was given up: {why}", remedy="It is tried with the next start.")
    return task.result()


async def quietly(work: Coroutine[object, object, object]) -> None:
    """Do what changes nothing of how the loop stands any more, such as disconnecting, whatever the driver raises."""
    with contextlib.suppress(Exception):
        await work


async def uncancelled(work: Coroutine[object, object, T]) -> T:
    """Run `work` to its end even when the caller is cancelled; the cancellation is raised afterwards."""
    task = asyncio.ensure_future(work)
    if await _cancellations(task):
        task.exception()
        raise asyncio.CancelledError
    return task.result()


async def to_its_end(work: Coroutine[object, object, T]) -> T:
    """Run `work` to its end even when the caller is cancelled; what comes of it counts then, not the cancellation."""
    task, caller = asyncio.ensure_future(work), asyncio.current_task()
    assert caller is not None  # noqa: S101 - this runs in it
    for _ in range(await _cancellations(task)):
        caller.uncancel()
    return task.result()


async def _cancellations(task: asyncio.Future[T]) -> int:
    """Wait until a task is done; return how often the caller was cancelled meanwhile."""
    asked = 0
    while not task.done():
        try:
            await asyncio.wait((task,))
        except asyncio.CancelledError:
            asked += 1
    return asked
