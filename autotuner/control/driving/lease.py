"""The lease of a loop: the one object between this program and a device's output, set point, mode and gains.

    free -> acquiring -> held -> disturbed -> releasing -> free
                                              releasing -> unknown -> releasing

Invariants:

1. The state changes only through the table of `autotuner.control.driving.lease_state`.
2. A lease is held only once its found values are on disk. It is disturbed by its first write.
3. `Lease._send` is the only place outside the drivers that writes to a device. `Lease.write` refuses a value outside
   the envelope; an output passes the supervisor, and is recorded before it is written.
4. `Lease.release` is the only restore. It cannot be cancelled and has a time limit. It restores the set
   point, then the output within limits and slew, read back where the device allows it, and one scan of the device later
   the mode, which is read back too (bumpless transfer; `release_watch` reports a bump). A device in auto keeps its
   output: its controller, or an operator, drives it. A mode is recorded only after a successful read: a lost link
   leaves no record of a write that never happened.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol, TypeVar

from autotuner.control.clock.call_timeout import BackendWithTimeout
from autotuner.control.clock.ticker import Stop, Ticker
from autotuner.control.clock.timestamped_call import timed
from autotuner.control.devices.manual_register import preload
from autotuner.control.devices.retrying import persistently, quietly
from autotuner.control.driving.lease_state import LeaseEvent, LeaseState, next_state
from autotuner.control.forced_shutdown import forced_shutdown
from autotuner.control.records.lease_record import Before, Kind
from autotuner.control.reporting.events import LinkTrouble, OutputRestored, OutputUnknown
from autotuner.core.safety.own_control import OwnControlWatch
from autotuner.core.safety.read_back import ReadBack
from autotuner.core.safety.supervisor import DRIVEN_BY_OTHERS
from autotuner.core.state_table import IllegalTransitionError
from autotuner.errors import DriverError
from autotuner.ports import AUTO, OUTPUT, PV, SET_POINT, LineSharing, Watchful

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Collection, Coroutine, Iterator, Mapping

    from autotuner.configuration import LoopTable
    from autotuner.control.clock.ticker import Tick
    from autotuner.control.records.open_journal import OpenJournal
    from autotuner.control.reporting.events import Event
    from autotuner.core.experiment.settings import Limits
    from autotuner.core.recording import Sample
    from autotuner.core.safety.supervisor import Supervisor
    from autotuner.core.verdict import Verdict
    from autotuner.errors import AutotunerError
    from autotuner.ports import Backend

T = TypeVar("T")

SCAN_S = 0.5
"""Longest usual scan of a controller, s: the time for a write to take effect, unless the loop's table has a scan."""
READ_BACKS = 4
"""Number of reads of an output or mode that differs, one scan apart: a device may show a write in a later scan."""
READ_BACK_SHARE = 0.005
"""Difference between written and read-back output that counts as equal, as a share of the output range: real outputs
are rounded to the resolution of a register."""
MANUAL = 0.0
"""Value of the mode signal in manual; automatic is 1."""
NOTHING = (math.inf, -math.inf)
"""The envelope of a signal that an operation does not write."""


def tolerance_of(limits: Limits) -> float:
    """Return the largest difference between written and read-back output that counts as equal, output units."""
    low, high = limits.output
    return READ_BACK_SHARE * (high - low)


@dataclass(frozen=True, slots=True)
class Goal:
    """Values that a release restores.

    Attributes
    ----------
    output : float or None
        Output at which the loop ends, output units; None leaves output and mode to the device.
    set_point : float or None
        Set point to be restored, PV units; None leaves it.
    from_auto : bool
        Whether the device's own controller drives the output now: it is taken to manual first.
    mode_known : bool
        Whether the device was just seen in manual: the output is then written before anything is read.
    """

    output: float | None
    set_point: float | None = None
    from_auto: bool = False
    mode_known: bool = False


class Watch(Protocol):
    """The judge of an operation's samples: the supervisor, or its part that applies under the device's controller."""

    @property
    def doubt(self) -> str:
        """Observation of the last sample that the next one must confirm; empty without any."""

    def check(self, sample: Sample, *, auto: float | None, phase: str, still_s: float) -> Verdict | None:
        """Return why the operation is to end, or None."""

    def check_failure(self, t: float, still_s: float, failure: AutotunerError) -> Verdict | None:
        """Return why the operation is to end after a reading that failed, or None."""


class Lease:
    """The lease of one loop for one operation.

    Parameters
    ----------
    backend : Backend
        The device.
    limits : Limits
        What bounds the envelope, with the safe output.
    supervisor : Supervisor
        Decides finally on every output.
    ticker : Ticker
        The clock; its period paces a slew-limited release.
    restore_limit_s : float
        Longest time to keep trying to restore over a dead link, s.
    operation : Kind
        What the loop is leased for.
    journal : OpenJournal or None
        Records disturbances before they happen; None where nothing outlives this program.
    publish : callable
        Takes events.
    scan_s : float
        Time after which the device acts on a write, s.
    watch : Watch or None
        Judges every sample; by default the supervisor.

    Attributes
    ----------
    state : LeaseState
        The state of the loop.
    found : Before or None
        How the loop was found, once that is recorded.
    verdict : Verdict or None
        Why the operation is to end; the first one counts.
    target : float or None
        Output at which the loop is to end; None leaves output and mode to the device.
    envelope : dict of str to tuple of float
        Lowest and highest value of each signal that this operation may write.
    held : float
        Output that the device holds, as far as known, output units.
    unknown : str
        The signal that could not be restored; empty where all is.
    """

    def __init__(
        self,
        backend: Backend,
        limits: Limits,
        supervisor: Supervisor,
        ticker: Ticker,
        restore_limit_s: float,
        operation: Kind = Kind.TUNING,
        journal: OpenJournal | None = None,
        publish: Callable[[Event], None] = lambda _: None,
        scan_s: float = SCAN_S,
        watch: Watch | None = None,
    ) -> None:
        self.state = LeaseState.FREE
        self.found: Before | None = None
        self.verdict: Verdict | None = None
        self.target: float | None = None
        self.envelope: dict[str, tuple[float, float]] = {}
        self.held = self._commanded = math.nan
        self.unknown = ""
        self.operation = operation
        self.stop = Stop()
        self.ticker, self.publish, self.supervisor = ticker, publish, supervisor
        self.watch: Watch = supervisor if watch is None else watch
        self.read_back = ReadBack(tolerance_of(limits))
        self.signals = [name for name in (PV, OUTPUT, SET_POINT, AUTO) if name in backend.readable]
        self._backend, self._limits, self._journal = backend, limits, journal
        self._with_timeout = BackendWithTimeout(backend)
        self._driven = (
            self._with_timeout if operation is Kind.GAINS else BackendWithTimeout(backend, supervisor.pv_timeout_s)
        )
        self._restore_limit_s, self._scan_s = restore_limit_s, scan_s
        self._seen: dict[str, float] = {}
        self._auto: float | None = None

    @property
    def device(self) -> BackendWithTimeout:
        """The device, with the usual time limit of a call: to be read, never written."""
        return self._with_timeout

    @property
    def is_over(self) -> bool:
        """Whether the loop is as it was found, or left to the operator or program that drives it."""
        return self.state is LeaseState.FREE

    @property
    def was_taken(self) -> bool:
        """Whether the operation ends because another one drives the loop."""
        return self.verdict is not None and self.verdict.code in DRIVEN_BY_OTHERS

    def _move(self, event: LeaseEvent) -> None:
        self.state = next_state(self.state, event)

    async def open(self) -> None:
        """Connect, to read how the loop is found."""
        self._move(LeaseEvent.ACQUIRE)
        await self._with_timeout.open()

    async def close(self) -> None:
        """Disconnect."""
        await self._with_timeout.close()

    async def hold(self, found: Before) -> None:
        """Put on the disk how the loop was found; raise `StorageError` when that cannot be done."""
        self.found, self._auto = found, found.auto
        self._commanded = self.held = found.output
        self._set_envelope(found)
        if self._journal is not None:
            await self._journal.disturb(found)
        safe = self._limits.safe_output
        if found.set_point is None:
            self.target = found.output
            if safe is not None and self._limits.at_end == "safe" and not found.auto:
                self.target = safe
                await self._record_target(safe)
        elif not found.auto:
            self.target = found.output
        self._move(LeaseEvent.RECORDED)

    def _set_envelope(self, found: Before) -> None:
        """Set the envelope of writes: the limits, extended to the found values."""
        low, high = self._limits.output
        self.envelope = {OUTPUT: (min(low, found.output), max(high, found.output)), AUTO: (0.0, 1.0)}
        if found.set_point is not None:
            low, high = self._limits.pv
            self.envelope[SET_POINT] = (min(low, found.set_point), max(high, found.set_point))

    async def hold_gains(self, found: Mapping[str, float], wanted: Mapping[str, float]) -> None:
        """Hold a device of which only gains are written, which the caller has recorded."""
        self.envelope = {name: (min(found[name], wanted[name]), max(found[name], wanted[name])) for name in wanted}
        self._move(LeaseEvent.RECORDED)

    def resume(self, found: Before, held: float = math.nan) -> None:
        """Go on with the lease of a program that is gone; `held` is the output that the device was seen to hold."""
        self.found, self._commanded = found, held
        self._set_envelope(found)
        self._move(LeaseEvent.RESUME)

    def leave(self) -> None:
        """End the lease with the loop as it is: nothing was written, it is to stay, or another one drives the loop."""
        self._move(LeaseEvent.LEAVE)

    def lose(self) -> None:
        """End an operation after an error that leaves the device's values unknown."""
        self._move(LeaseEvent.LOST)

    def abort(self, verdict: Verdict) -> None:
        """Request the end; the first verdict counts."""
        self.verdict = self.verdict or verdict
        self.stop.set()
        self._driven.interrupt()

    def trip(self, verdict: Verdict) -> None:
        """Request the end because of a limit: the loop ends at its safe output where one is declared.

        A run over operating points leaves the output to the device's own controller, at the set point of before.
        """
        by_us = not self._is_controllers or (AUTO in self._backend.writable and self.operation is not Kind.SCHEDULE)
        if self.found is not None and by_us:
            safe = self._limits.safe_output
            self.target = self.found.output if safe is None else safe
        self.abort(verdict)

    @property
    def _is_controllers(self) -> bool:
        """Whether the device's own controller drove the output, and still does during this operation."""
        return self.found is not None and self.found.set_point is not None and bool(self.found.auto)

    async def read(self, names: Collection[str]) -> dict[str, float]:
        """Return the present values of signals, within the time limit of a sample."""
        return await self._driven.read(names)

    async def sample(self) -> tuple[dict[str, float], float]:
        """Return the signals of a sample and its time, s since the ticker was made."""
        self._seen = {}
        readings, t = await timed(self._driven.read(self.signals), self._backend, self.ticker)
        self._seen = readings
        self.held = (
            self.read_back.held(self._commanded, readings.get(OUTPUT)) if self._follows_output else readings[OUTPUT]
        )
        return readings, t

    @property
    def _follows_output(self) -> bool:
        """Whether this program moves the output, so that read-back values are compared with it."""
        return self.found is None or self.found.set_point is None

    def overridden(self, t: float) -> Verdict | None:
        """Return a verdict when another program writes the output."""
        return self.read_back.check(t, self._commanded, self._seen.get(OUTPUT)) if self._follows_output else None

    @property
    def auto(self) -> float | None:
        """The mode in the last sample, as far as it matters: one that was in manual stays there until it is written."""
        return self._seen.get(AUTO) if self._follows_output or self._auto else None

    def doubt(self) -> None:
        """Mark the last sample as possibly damaged."""
        self._seen = {}

    def stalled_s(self, tick: Tick | None = None) -> float:
        """Return for how long this program could not have read, s: before a tick, and in the calls since."""
        return self._driven.stood_still_s(tick)

    @contextlib.contextmanager
    def watched(self) -> Iterator[None]:
        """Be notified between two samples, too, when the device has gone."""
        if not isinstance(self._backend, Watchful):
            yield
            return
        self._backend.watch(self._take_loss)
        try:
            yield
        finally:
            self._backend.watch(None)

    def _take_loss(self, reason: str) -> None:
        now_s, self._seen = self.ticker.now_s, {}
        self.publish(LinkTrouble(now_s, reason))
        verdict = self.supervisor.check_still(now_s, self.ticker.overdue_s) or self.supervisor.check_gone(now_s)
        if verdict is not None:
            self.trip(verdict)

    async def write(self, values: Mapping[str, float]) -> float:
        """Write signals that the operation commands, one after the other; return the time from which they act, s.

        That is NaN where nothing was written: an output that is there already is not, and nothing is once the end was
        requested.
        """
        written_s = math.nan
        for name, value in values.items():
            next_state(self.state, LeaseEvent.WRITE)  # before anything is recorded of it
            permitted = self._permitted(name, value)
            if name == OUTPUT and permitted == self._commanded:
                continue
            await self._record(name, permitted)
            if self.stop.is_set():  # requested meanwhile: the next output is the one to be restored
                break
            self._move(LeaseEvent.WRITE)
            _, written_s = await timed(self._send(self._driven, {name: permitted}), self._backend, self.ticker)
            self._take_written(name, permitted)
        return written_s

    def _take_written(self, name: str, value: float) -> None:
        if name == OUTPUT:
            self._commanded = self.held = value
        elif name == AUTO:
            self._auto = value

    def _permitted(self, name: str, value: float) -> float:
        """Return the value that is written; raise `IllegalTransitionError` outside the envelope."""
        if name == OUTPUT:
            # a period, not the time since the last write: after a gap the output must not leap to catch up
            value = self.supervisor.permit(value, self._commanded, self.ticker.period_s)
        low, high = self.envelope.get(name, NOTHING)
        if not low <= value <= high:
            raise IllegalTransitionError(f"{name} {value:g} is outside of the envelope {low:g} to {high:g}")
        return value

    async def _record(self, name: str, value: float) -> None:
        """Record a value before it is written; raise `StorageError` for an output that must not go unrecorded."""
        if self._journal is None:
            return
        entries = {OUTPUT: self._journal.command, SET_POINT: self._journal.set_point, AUTO: self._journal.mode}
        if (entry := entries.get(name)) is not None:
            await entry(value)

    async def _send(self, device: BackendWithTimeout, values: Mapping[str, float]) -> None:
        """Write to the device: the only place."""
        await device.write(values)

    async def take_over(self, noise: float) -> None:
        """Take the device to manual (bumpless transfer): its mode, and once it acts on that the output that was found.

        Its manual register may be no further than `noise` from that output, or is preloaded; where it cannot be, the
        operation is to end, with the mode unchanged.
        """
        found = self.found
        if found is None or not found.auto or AUTO not in self._backend.writable:
            return
        self._move(LeaseEvent.WRITE)

        async def write(output: float) -> None:
            await self._send(self._driven, {OUTPUT: output})

        refusal = await preload(self._driven, write, found.output, noise, self._scan_s)
        if refusal is not None:
            self.abort(refusal)
            return
        await self._send(self._driven, {AUTO: MANUAL})
        await asyncio.sleep(self._scan_s)
        await self._send(self._driven, {OUTPUT: found.output})
        await self._confirm_mode(self._driven, MANUAL)

    async def goal(self) -> Goal:
        """Return the goal of a release, recorded for another program that may have to continue it."""
        found = self.found
        assert found is not None  # noqa: S101 - nothing is released that was not held
        target = None if self.was_taken and found.set_point is not None else self.target
        if target is not None and self.state is not LeaseState.HELD:
            await self._record_target(target)
        from_auto = found.set_point is not None and target is not None
        return Goal(target, found.set_point, from_auto, mode_known=bool(self._seen) and not self._seen.get(AUTO))

    async def _record_target(self, output: float) -> None:
        if self._journal is not None:
            await self._journal.aim(output)

    async def release(self, goal: Goal | None = None) -> bool:
        """Restore the loop, or leave one that was not disturbed or that another one drives; return whether it was done.

        `goal` has the values to restore, by default those that the lease has found.
        """
        taken = self.was_taken and self._follows_output
        if self.state in {LeaseState.ACQUIRING, LeaseState.HELD} or taken:
            self.leave()
        if self.is_over:
            return True
        goal = await self.goal() if goal is None else goal
        self._move(LeaseEvent.RELEASE)
        self.unknown = await self._restore(goal)
        self._move(LeaseEvent.LOST if self.unknown else LeaseEvent.RESTORED)
        return self.is_over

    async def _restore(self, goal: Goal) -> str:
        """Restore the values of a goal; return the signal that could not be restored, or an empty text."""
        found = goal.set_point
        if found is not None and await self._persistently(lambda: self._restore_set_point(found)) is None:
            return SET_POINT
        if (target := goal.output) is None:
            return ""
        if goal.from_auto:
            held = await self._persistently(self._to_manual)
            if held is None:
                return OUTPUT
            self._commanded, goal = held, replace(goal, mode_known=True)
        return "" if await self._restore_output(goal, target) else OUTPUT

    async def release_gains(self, old: Mapping[str, float], confirm: Callable[[], Awaitable[object]]) -> bool:
        """Restore gains; `confirm` raises `DriverError` while the device holds others. Return whether it was done."""

        async def attempt() -> bool:
            await self._with_timeout.open()
            for name, value in old.items():
                await self._send(self._with_timeout, {name: value})
            await confirm()
            return True

        self._move(LeaseEvent.RELEASE)
        done = bool(await self._persistently(attempt))
        self._move(LeaseEvent.RESTORED if done else LeaseEvent.LOST)
        return done

    async def _restore_set_point(self, found: float) -> bool:
        await self._with_timeout.open()
        await self._send(self._with_timeout, {SET_POINT: found})
        return True

    async def _to_manual(self) -> float:
        """Take the device to manual; return the output that it holds then."""
        await self._with_timeout.open()
        await self._with_timeout.read([OUTPUT])
        if self._journal is not None:
            await self._journal.mode(MANUAL)
        await self._send(self._with_timeout, {AUTO: MANUAL})
        held = (await self._with_timeout.read([OUTPUT]))[OUTPUT]
        if self._journal is not None:
            await self._journal.command(held)
        return held

    async def _persistently(self, attempt: Callable[[], Coroutine[object, object, T]]) -> T | None:
        return await persistently(attempt, self.ticker, self.publish, self._restore_limit_s)

    async def _confirm_mode(self, device: BackendWithTimeout, auto: float) -> None:
        """Read the mode back, for some scans; raise `DriverError` where the device keeps another one."""
        if AUTO not in device.readable:
            return
        for _ in range(READ_BACKS):
            if bool((await device.read([AUTO]))[AUTO]) == bool(auto):
                return
            await asyncio.sleep(self._scan_s)
        raise DriverError(
            f"the device acknowledged {'auto' if auto else 'manual'} and is still in {'manual' if auto else 'auto'}",
            remedy="Check the device for an interlock, or a program that writes its mode.",
        )

    async def _restore_output(self, goal: Goal, target: float) -> bool:
        """Restore output and mode; return whether the device has confirmed both."""
        progress = _RestoreProgress()

        def report(event: OutputUnknown) -> None:
            progress.failed = event.attempts
            self.publish(event)

        restored = await persistently(
            lambda: self._attempt(goal, target, progress),
            self.ticker,
            report,
            self._restore_limit_s,
            lambda: progress.follows,
        )
        self.publish(restored or OutputUnknown(self.ticker.now_s, progress.failed, self._left_at(target)))
        return restored is not None

    def _left_at(self, target: float) -> str:
        """Return the last known output, for the message."""
        reason = (
            "the end was requested again" if forced_shutdown().is_set() else f"{self._restore_limit_s:g} s are over"
        )
        unknown = math.isnan(self._commanded)
        last = "nothing is known to have been written" if unknown else f"{self._commanded:g} was written last"
        return f"{reason}: it is left as it is; {last}, {target:g} is where it was to go back to"

    async def _attempt(self, goal: Goal, target: float, progress: _RestoreProgress) -> OutputRestored:
        progress.follows = False
        if progress.failed:  # a link that was lost is closed on this side too before it is opened again
            await quietly(self._with_timeout.close())
        await self._with_timeout.open()
        readings = {} if goal.mode_known and not progress.begun else await self._look()
        progress.begun = True
        in_auto = bool(readings.get(AUTO))
        if not in_auto:
            self._take_present(readings.get(OUTPUT, self._commanded))
            await self._walk(target, progress)
        verified = in_auto or await self._confirm_output(target)
        await self._restore_mode(in_auto=in_auto)
        return OutputRestored(self.ticker.now_s, readings.get(OUTPUT, target) if in_auto else target, verified)

    async def _restore_mode(self, *, in_auto: bool) -> None:
        """Write the mode once the device acts on its output; raise `DriverError` where it keeps another one."""
        auto = self.found.auto if self.found is not None else None
        if not auto or AUTO not in self._backend.writable:
            return
        if not in_auto:  # one that was seen in auto may not have left it yet: it is written all the same
            await asyncio.sleep(self._scan_s)
        await self._send(self._with_timeout, {AUTO: auto})
        await self._confirm_mode(self._with_timeout, auto)

    def _take_present(self, readings: float) -> None:
        """Continue from the output of the device, where it differs from the command by more than rounding."""
        if not abs(readings - self._commanded) <= self.read_back.tolerance:
            self._commanded = readings

    async def _look(self) -> dict[str, float]:
        """Return output and mode, as far as the device reports them; writing does not wait for that."""
        names = [name for name in (OUTPUT, AUTO) if name in self._backend.readable]
        try:
            readings = await self._with_timeout.read(names) if names else {}
        except DriverError:
            return {}
        return {name: value for name, value in readings.items() if math.isfinite(value)}

    async def _walk(self, target: float, progress: _RestoreProgress) -> None:
        """Write the target, in steps of the slew limit where there is one."""
        end = self.supervisor.permit(target, target, 0.0)
        if abs(self._commanded - target) <= self.read_back.tolerance and target != end:
            await self._send(self._with_timeout, {OUTPUT: target})  # found outside of its limits, and still there
            return
        while True:
            following = self.supervisor.permit(target, self._commanded, self.ticker.period_s)
            await self._send(self._with_timeout, {OUTPUT: following})
            self._commanded, progress.follows = following, True
            if following == end:
                return
            await asyncio.sleep(self.ticker.period_s)

    async def _confirm_output(self, target: float) -> bool:
        """Return whether the device reports the target; raise `DriverError` where it holds another."""
        if OUTPUT not in self._backend.readable:
            return False
        for _ in range(READ_BACKS):
            readings = (await self._with_timeout.read([OUTPUT]))[OUTPUT]
            if abs(readings - target) <= self.read_back.tolerance:
                return True
            await asyncio.sleep(self._scan_s)
        raise DriverError(
            f"the device holds output {readings:g} where {target:g} was written",
            remedy="Check that nothing else writes this output.",
        )


@dataclass(slots=True)
class _RestoreProgress:
    """Progress of the restore of an output.

    Attributes
    ----------
    begun : bool
        Whether an attempt was made: from then on the device is read before it is written.
    failed : int
        Attempts that failed.
    follows : bool
        Whether the device has taken a write of the present attempt.
    """

    begun: bool = False
    failed: int = 0
    follows: bool = False


def ticker_of(backend: Backend, period_s: float) -> Ticker:
    """Return the ticker of a loop, on the common time grid of the loops on its line."""
    return Ticker(period_s, backend.counted_from if isinstance(backend, LineSharing) else None)


def lease_of(
    loop: LoopTable,
    backend: Backend,
    operation: Kind,
    journal: OpenJournal | None = None,
    publish: Callable[[Event], None] = lambda _: None,
    restore_limit_s: float | None = None,
) -> Lease:
    """Return the lease of a loop as its table has it; the device's own controller drives its output."""
    limits = loop.experiment_settings().limits
    watch = OwnControlWatch(limits, loop.safety_settings())
    return Lease(
        backend,
        limits,
        watch.supervisor,
        ticker_of(backend, loop.sample_time_s),
        loop.restore_limit_s if restore_limit_s is None else restore_limit_s,
        operation,
        journal,
        publish,
        loop.device_scan_s,
        watch,
    )
