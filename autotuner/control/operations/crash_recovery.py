"""Crash recovery of one loop: the release of what another process left disturbed, from its journal.

    output (a tuning)                                      output, then mode
    set point (a verification, a run over set points)      set point, then mode and output

Invariants:

1. Everything is restored by `Lease.release`, as at every other end; over a dead link it is tried until its limit.
2. What the device holds is read first. In another mode, or at an output or a set point where the interrupted program
   never put it, an operator or another program has taken the loop over since: nothing is written.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from autotuner.control.devices.device_gains import same_number
from autotuner.control.devices.retrying import persistently, quietly
from autotuner.control.driving.lease import MANUAL, Goal, Lease, lease_of, tolerance_of
from autotuner.control.driving.lease_state import LeaseState
from autotuner.control.gains.apply import RolledBack
from autotuner.control.gains.pending_gains import BACK, Unproved
from autotuner.control.operations.gains_operations import put_back
from autotuner.control.records.lease_record import Kind
from autotuner.errors import AutotunerError, GainsChangedError, TuningStateError
from autotuner.ports import AUTO, OUTPUT, SET_POINT

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.control.operations.operation import Station
    from autotuner.control.records.lease_record import Before, LeaseRecord
    from autotuner.core.verdict import Verdict

NOTHING = "nothing of the loop had to be restored"
RESTORED = "the process of the loop had restored it"
UNTOUCHED = {None: "no gain had been written", True: "the gains had been read back, and stay"}
"""What there is to say of gains by themselves that nothing has to be done about."""
UNKNOWN = "the output could not be brought back to {:g}: what it is now is unknown"
SET_POINT_UNKNOWN = "the set point could not be brought back to {:g}: what it is now is unknown"
SET_POINT_BACK = "the set point is restored to {:g}"
NEVER_PUT = "where it had never been put: it was left there"


class Back(NamedTuple):
    """The outcome of a loop's recovery, and whether it was released."""

    what: str
    done: bool = True


class Recovered(NamedTuple):
    """The outcome of the gains' recovery, which gains were restored, and the outcome of the loop's."""

    gains: Back
    undone: RolledBack | None
    loop: Back


@dataclass(frozen=True, slots=True)
class Recover:
    """Recovery of a loop that another process left disturbed; unproved gains are restored first."""

    kept: LeaseRecord

    @property
    def kind(self) -> Kind:
        """What its record is of."""
        return self.kept.kind

    def begin(self, station: Station) -> _Recovering:
        """Return the operation."""
        return _Recovering(self.kept, station)


class _Recovering:
    def __init__(self, kept: LeaseRecord, station: Station) -> None:
        self._kept, self._station = kept, station

    def abort(self, _verdict: Verdict) -> None:
        """Do nothing: the recovery is under way."""

    async def run(self) -> Recovered:
        kept, station = self._kept, self._station
        gains, undone = await self._gains_back()
        back = await CrashRecovery(kept, station).go()
        if station.alone and station.journal is not None and gains.done and back.done and not kept.restored:
            await station.journal.released("; ".join(part for part in (gains.what, back.what) if part))
        return Recovered(gains, undone, back)

    async def _gains_back(self) -> tuple[Back, RolledBack | None]:
        """Restore gains over unverified ones; gains that were set by others since are left."""
        kept = self._kept
        if kept.undone is not None:
            return Back(BACK), RolledBack(kept.loop, kept.tuning, **kept.undone, gains=None)
        if kept.proved is not False or kept.restored:
            return Back(UNTOUCHED.get(kept.proved, BACK) if kept.kind is Kind.GAINS else ""), None
        try:
            unproved = None if kept.change is None else Unproved(kept.change, kept.found)
            return Back(BACK), await put_back(self._station, kept.tuning if unproved is None else None, unproved)
        except TuningStateError:
            return Back("the new gains were not in the device"), None
        except GainsChangedError as error:
            return Back(f"the gains were left: {error.field} {error.message}"), None
        except AutotunerError as error:
            return Back(f"the old gains are not back: {error.message}", done=False), None


@dataclass(frozen=True, slots=True)
class CrashRecovery:
    """The recovery of one interrupted loop, of which `kept` is known."""

    kept: LeaseRecord
    station: Station

    async def go(self) -> Back:
        """Release the loop, or leave it to whoever has taken it over; not done where its state is unknown."""
        before = self.kept.before
        if before is None or self.kept.restored:
            return Back(NOTHING if before is None else RESTORED)
        at = self.station
        lease = lease_of(at.loop, at.backend, self.kept.kind, at.journal, at.publish)
        names = [name for name in (OUTPUT, AUTO, SET_POINT) if name in at.backend.readable]

        async def look() -> dict[str, float]:
            await lease.device.open()
            return await lease.device.read(names)

        try:
            seen = await persistently(look, lease.ticker, at.publish, at.loop.restore_limit_s)
            if (refused := self._refused(before, seen or {})) is not None:
                return refused
            if seen is None:
                return Back(self._unknown(before), done=False)
            lease.resume(before, seen.get(OUTPUT, math.nan))
            way = self._output if before.set_point is None else self._set_point
            back = await way(before, seen, lease)
            if lease.state is LeaseState.UNKNOWN and back.done:
                lease.leave()  # another one drives the loop
            return back
        finally:
            await quietly(lease.close())

    def _refused(self, before: Before, seen: Mapping[str, float]) -> Back | None:
        """Return that nothing is written, where the record would drive the loop to where its limits do not allow."""
        limits = self.station.loop.experiment_settings().limits
        target = before.output if self.kept.target is None else self.kept.target
        checked = [("output", target, limits.output)]
        if before.set_point is not None:
            checked.append(("set point", before.set_point, limits.pv))
        for what, value, (low, high) in checked:
            still = what == "output" and abs(seen.get(OUTPUT, math.nan) - value) <= self._tolerance
            if not (low <= value <= high or still or value == limits.safe_output):
                return Back(f"the recorded {what} {value:g} is outside of the limits: nothing was written", done=False)
        return None

    def _unknown(self, before: Before) -> str:
        """Return in words that nothing is known of the loop."""
        if before.set_point is not None:
            return SET_POINT_UNKNOWN.format(before.set_point)
        return UNKNOWN.format(before.output if self.kept.target is None else self.kept.target)

    async def _output(self, before: Before, seen: Mapping[str, float], lease: Lease) -> Back:
        target = before.output if self.kept.target is None else self.kept.target
        if seen.get(AUTO):
            return Back("the device's own controller drives the output: nothing was written")
        if left := self._left_at(seen, target):
            return left
        done = await lease.release(Goal(target))
        return Back((f"the output is restored to {target:g}" if done else UNKNOWN.format(target)), done)

    async def _set_point(self, before: Before, seen: Mapping[str, float], lease: Lease) -> Back:
        found = math.nan if before.set_point is None else before.set_point
        target, ours = self._target(before, seen), self.kept.wide or self._is_ours(seen[SET_POINT])
        if not ours and (seen[AUTO] or target is None):
            return Back(f"the set point stood at {seen[SET_POINT]:g}, {NEVER_PUT}")
        left = self._left_at(seen, target) if target is not None and not seen[AUTO] and self.kept.commanded else None
        from_auto = bool(seen[AUTO])
        goal = Goal(None if left else target, found if ours else None, from_auto, mode_known=not from_auto)
        done = await lease.release(goal)
        set_point_back = SET_POINT_BACK.format(found) if ours else f"the set point was left at {seen[SET_POINT]:g}"
        if not done and lease.unknown == SET_POINT:
            return Back(SET_POINT_UNKNOWN.format(found), done=False)
        if not done:
            return Back(f"{set_point_back}; {UNKNOWN.format(before.output if target is None else target)}", done=False)
        if left is not None:
            return Back(f"{set_point_back}; {left.what}")
        return Back(
            set_point_back if target is None else f"{set_point_back}, the output at {target:g}, and the mode as it was"
        )

    def _target(self, before: Before, seen: Mapping[str, float]) -> float | None:
        """Return the output at which the loop ends by way of manual; None leaves output and mode to the device.

        In manual without having been put there, it has never left it, or was taken over.
        """
        if not seen[AUTO] and self.kept.mode != MANUAL:
            return None
        return before.output if self.kept.target is None and not before.auto else self.kept.target

    def _is_ours(self, set_point: float) -> bool:
        return any(same_number(self.station.backend, SET_POINT, set_point, ours) for ours in self.kept.set_points)

    def _left_at(self, seen: Mapping[str, float], target: float) -> Back | None:
        """Return the evidence that an operator or another program drives the output since, or None."""
        held = seen.get(OUTPUT)
        if held is None or self._commanded(held, target):
            return None
        return Back(f"the output stood at {held:g}, {NEVER_PUT}")

    def _commanded(self, held: float, target: float) -> bool:
        """Return whether the output may have been left there: between the levels recorded, or within the envelope."""
        if math.isnan(held):
            return True
        levels, tolerance = self.kept.commanded | {target}, self._tolerance
        if self.kept.wide:
            levels = levels | set(self.station.loop.limits.output)
        return min(levels) - tolerance <= held <= max(levels) + tolerance

    @property
    def _tolerance(self) -> float:
        return tolerance_of(self.station.loop.experiment_settings().limits)
