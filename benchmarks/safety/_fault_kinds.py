"""What can go wrong with a line, a device, an operator or the program itself: one class or row each.

A fault strikes at `at_s`. What is drawn is drawn from the generator of the run, so a seed names a run for ever.
"""

import asyncio
import math
from dataclasses import dataclass

from autotuner.core.verdict import aborted
from autotuner.errors import DeviceTimeoutError, LinkError
from autotuner.ports import PV
from benchmarks.safety._device import Line

NEVER_S = 1e7


@dataclass
class Struck(Line):
    """A line with a fault that lasts from `at_s` for `lasts_s`; `dt` is the sample time."""

    at_s: float
    lasts_s: float
    dt: float
    size: float

    def __post_init__(self):
        self.hit = False
        self.state = None

    def struck(self, now_s):
        on = self.at_s <= now_s < self.at_s + self.lasts_s
        self.hit = self.hit or on
        return on


class ReadError(Struck):
    async def call(self, kind, now_s):
        if kind == "read" and self.struck(now_s):
            raise LinkError("checksum error", remedy="Check the line.")


class WriteError(Struck):
    async def call(self, kind, now_s):
        if kind == "write" and self.struck(now_s):
            raise LinkError("checksum error", remedy="Check the line.")


class Timeout(Struck):
    async def call(self, _kind, now_s):
        if self.struck(now_s):
            await asyncio.sleep(2.0 * self.dt)
            raise DeviceTimeoutError("no answer", remedy="Check the line.")


class Hang(Struck):
    """One call, of whatever kind, that never ends: a driver that breaks its promise."""

    async def call(self, kind, now_s):
        if self.struck(now_s) and self.state is None:
            self.state = kind
            await asyncio.sleep(NEVER_S)


class Disconnect(Struck):
    async def call(self, _kind, now_s):
        if self.struck(now_s):
            raise LinkError("connection lost", remedy="Plug it in.")


class SlowReplies(Struck):
    async def call(self, _kind, now_s):
        if self.struck(now_s):
            await asyncio.sleep(self.size * self.dt)


class NotANumber(Struck):
    def told(self, seen, now_s):
        return seen | {PV: math.nan} if self.struck(now_s) else seen


class Frozen(Struck):
    def told(self, seen, now_s):
        if not self.struck(now_s):
            return seen
        self.state = seen[PV] if self.state is None else self.state
        return seen | {PV: self.state}


class Jump(Struck):
    def told(self, seen, now_s):
        return seen | {PV: seen[PV] + self.size} if self.struck(now_s) else seen


class OutOfRange(Struck):
    def told(self, seen, now_s):
        return seen | {PV: math.copysign(3276.7, self.size)} if self.struck(now_s) else seen


async def clock_gap(run):
    """The machine stands still and the clock does not: nothing runs, the plant goes on."""
    asyncio.get_running_loop()._selector.clock.advance(run.lasts_s)  # noqa: SLF001 - nobody else can hold the clock


async def cancel(run):
    run.work.cancel()


async def abort(run):
    if not run.tuning.ended:
        run.tuning.abort(aborted("aborted", "stopped by the operator", "Start it again."))


async def operator_takes_the_mode(run):
    run.backend.present().auto = True


async def operator_moves_the_output(run):
    run.backend.present().command(run.case.foreign_output)


async def operator_moves_the_set_point(run):
    run.backend.present().set_point += 5.0


async def sigterm(run):
    await run.manager.close()


async def nothing(_run):
    pass


LINES = {
    "read error": ReadError,
    "write error": WriteError,
    "timeout": Timeout,
    "call never ends": Hang,
    "disconnect, reconnect": Disconnect,
    "slow replies": SlowReplies,
    "PV is NaN": NotANumber,
    "PV frozen": Frozen,
    "PV jumps": Jump,
    "PV out of range": OutOfRange,
}
"""Faults of the line, from the moment they strike."""

DEEDS = {
    "clock gap": clock_gap,
    "cancel": cancel,
    "abort": abort,
    "operator takes the mode": operator_takes_the_mode,
    "operator moves the output": operator_moves_the_output,
    "operator moves the set point": operator_moves_the_set_point,
    "SIGTERM": sigterm,
    "no fault": nothing,
    "PV near its limit": nothing,
    "exception in identification": nothing,
}
"""Faults that are done once, at their moment."""

KILL = "kill -9 and restart"
KINDS = (*LINES, *DEEDS, KILL)
SPREAD = {"no fault", "PV near its limit", "exception in identification"}
"""Faults that have no moment of their own."""
LYING = {"PV frozen", "PV jumps", "PV out of range", "PV is NaN"}
"""Faults under which nobody can know the true PV."""
UNREACHABLE = {"write error", "timeout", "disconnect, reconnect", "call never ends", "read error"}
"""Faults under which nothing can be written, or not be confirmed, for as long as they last."""
