"""Joint readings of several loops of one device.

Invariants:

1. Requests of one turn of the event loop, and those that arrive while the line is busy, are combined. The line is free
   for other calls, above all for a restore, between two requests (or two lots that overlap).
2. Each loop gets what its own request would have returned: the words, the time, the repetitions, the error. An error of
   one loop alone (a wrong address) affects no other loop.
3. The parts of a joint read that failed on trial are requested one by one, with the remaining repetitions. If a part
   has no answer either, the device is silent, and all of them fail: no loop waits for the time limits of the others.
4. A request without a waiting loop is cancelled.
"""

from __future__ import annotations

import asyncio
import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

from autotuner.errors import DeviceRefusedError, DriverError
from autotuner_drivers.modbus.joint_requests import Joint, JointRequests
from autotuner_drivers.modbus.protocol import Account, Exchange

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner_drivers.modbus.protocol import Request
    from autotuner_drivers.modbus.register_map import DeviceLimits


class RequestLink(Protocol):
    """A link to a device, which makes exchanges."""

    @property
    def turn(self) -> asyncio.Lock:
        """Held by the user of the line."""

    @property
    def at_once(self) -> int:
        """Most requests under way at once, now."""

    @property
    def retries(self) -> int:
        """How often a request is repeated."""

    async def exchange(self, exchanges: Sequence[Exchange]) -> None:
        """Make exchanges, which then hold their outcomes; the caller holds the line."""


class Reading:
    """One call of one loop, with the outcomes of its requests."""

    __slots__ = ("account", "answers", "done", "left")

    def __init__(self, requests: int, account: Account) -> None:
        self.account = account
        self.answers: list[tuple[int, ...]] = [()] * requests
        self.left = requests
        self.done: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    def fail(self, error: BaseException) -> None:
        """End with an error, unless it has ended."""
        if not self.done.done():
            self.done.set_exception(error)

    def give_up(self) -> None:
        """Accept no more outcomes."""
        if not self.done.cancel() and not self.done.cancelled():
            self.done.exception()  # raised in the call, or no longer awaited

    def take(self, index: int, words: tuple[int, ...], exchange: Exchange) -> None:
        """Accept the outcome of one request; the first error ends the reading."""
        if self.done.done():
            return
        self.account.take(exchange, last=index == len(self.answers) - 1)
        if exchange.error is not None:
            self.fail(_own(exchange.error))
            return
        self.answers[index] = words
        self.left -= 1
        if not self.left:
            self.done.set_result(None)


class _Part(NamedTuple):
    """The request at one place of a reading."""

    reading: Reading
    place: int
    request: Request


class _Trial:
    """A joint read that failed, while its parts are requested one by one."""

    def __init__(self, joint: Joint, parts: Sequence[Request], *, learns: bool) -> None:
        self.joint, self.parts, self.learns = joint, parts, learns
        self.answered: set[Request] = set()
        self.refused: set[Request] = set()

    @property
    def is_over(self) -> bool:
        """Whether the device has answered or refused each part."""
        return len(self.answered) + len(self.refused) == len(self.parts)


@dataclass(slots=True, eq=False)
class _Lot:
    """A request, and the requests of loops that it serves; `retries` and `trial` for a trial and its parts."""

    joint: Joint
    parts: list[_Part]
    retries: int | None = None
    trial: _Trial | None = None

    @property
    def awaited(self) -> bool:
        """Whether a loop still waits for it."""
        return not all(part.reading.done.done() for part in self.parts)

    def give(self, exchange: Exchange) -> None:
        """Pass each loop its part of an answer."""
        words, whole = exchange.words, self.joint.request
        for part in self.parts:
            start = part.request.address - whole.address
            own = words if part.request == whole else words[start : start + part.request.count]
            part.reading.take(part.place, own, exchange)


class JointReads:
    """The readings of one device.

    Parameters
    ----------
    link : RequestLink
        Answers requests.
    limits : DeviceLimits
        The longest read, and the widest gap.
    """

    def __init__(self, link: RequestLink, limits: DeviceLimits) -> None:
        self._link = link
        self._requests = JointRequests(limits)
        self._waiting: list[_Part] = []
        self._planned: list[_Lot] = []
        self._under_way: list[_Lot] = []
        self._work: asyncio.Task[None] | None = None

    async def read(self, requests: Sequence[Request], account: Account) -> list[tuple[int, ...]]:
        """Return the words of the answers to requests of which none depends on another."""
        reading = Reading(len(requests), account)
        self._waiting += [_Part(reading, index, request) for index, request in enumerate(requests)]
        self._go_on()
        try:
            await reading.done
        finally:
            reading.give_up()
            if self._under_way and self._work and not any(lot.awaited for lot in self._under_way):
                self._work.cancel()
        return reading.answers

    async def end(self) -> None:
        """End the exchange in progress; called after the link was closed, so that all pending readings fail."""
        if self._work is not None:
            self._work.cancel()
        while self._work is not None:
            await asyncio.gather(self._work, return_exceptions=True)

    def _go_on(self) -> None:
        if self._work is None:
            self._work = asyncio.create_task(self._serve_all())
            self._work.add_done_callback(self._ended)

    def _ended(self, work: asyncio.Task[None]) -> None:
        """Continue with the pending readings after a cancelled request; pass on a fault of the program."""
        self._planned = [lot for lot in (*self._under_way, *self._planned) if lot.awaited]
        self._work, self._under_way = None, []
        if not work.cancelled() and (fault := work.exception()) is not None:
            for reading in {part.reading for lot in self._planned for part in lot.parts}:
                reading.fail(fault)
            self._planned = []
        if self._waiting or self._planned:
            self._go_on()

    async def _serve_all(self) -> None:
        while self._waiting or self._planned:
            async with self._link.turn:
                if not self._planned:
                    self._plan()
                at_once = self._link.at_once
                self._under_way, self._planned = self._planned[:at_once], self._planned[at_once:]
                await self._serve(self._under_way)
                self._under_way = []
                self._planned = [lot for lot in self._planned if lot.awaited]

    def _plan(self) -> None:
        """Combine pending requests; the PV is last in its reading, and thus nearest to the next write."""
        parts = [part for part in self._waiting if not part.reading.done.done()]
        self._waiting = []
        joints = self._requests.joined([part.request for part in parts])
        lots = [_Lot(joint, [parts[index] for index in joint.parts]) for joint in joints]
        for lot in lots:
            if self._requests.on_trial(lot.joint):
                lot.retries = 0
        self._planned = sorted(lots, key=lambda lot: max(part.place for part in lot.parts))

    async def _serve(self, lots: Sequence[_Lot]) -> None:
        if not lots:
            return
        exchanges = [Exchange(lot.joint.request, self._retries(lot)) for lot in lots]
        await self._link.exchange(exchanges)
        for lot, exchange in zip(lots, exchanges, strict=True):
            if lot.trial is not None:
                self._judge_part(lot, lot.trial, exchange)
            elif len(lot.joint.parts) > 1 and exchange.error is None:
                self._requests.answered(lot.joint)
            elif len(lot.joint.parts) > 1 and (lot.retries == 0 or isinstance(exchange.error, DeviceRefusedError)):
                self._try_parts(lot, exchange)
                continue
            lot.give(exchange)

    def _retries(self, lot: _Lot) -> int:
        return self._link.retries if lot.retries is None else lot.retries

    def _try_parts(self, lot: _Lot, joint: Exchange) -> None:
        """Request each part of a failed joint read separately, next."""
        self._requests.doubted(lot.joint)
        unanswered = not isinstance(joint.error, DeviceRefusedError)
        by_request: dict[Request, list[_Part]] = {}
        for part in lot.parts:
            part.reading.account.repeated += unanswered
            by_request.setdefault(part.request, []).append(part)
        trial = _Trial(lot.joint, list(by_request), learns=lot.retries == 0)
        retries = self._link.retries - unanswered
        singles = [_Lot(Joint(request, (0,)), parts, retries, trial) for request, parts in by_request.items()]
        self._planned = [*singles, *self._planned]

    def _judge_part(self, lot: _Lot, trial: _Trial, exchange: Exchange) -> None:
        """Record the outcome of a part; without an answer, the remaining parts fail with it."""
        request = lot.joint.request
        if exchange.error is not None and not isinstance(exchange.error, DeviceRefusedError):
            for other in [other for other in self._planned if other.trial is trial]:
                other.give(exchange)
            self._planned = [other for other in self._planned if other.trial is not trial]
            return
        (trial.answered if exchange.error is None else trial.refused).add(request)
        if trial.is_over and trial.learns and trial.answered:
            self._requests.keep_apart(trial.parts, trial.refused)


def _own(error: DriverError) -> DriverError:
    """Return a copy of an error, one for each loop that raises it."""
    own = copy.copy(error)
    own.__cause__ = error.__cause__
    return own
