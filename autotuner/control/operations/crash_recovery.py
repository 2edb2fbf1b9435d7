"""Crash recovery of one loop from the journal of another process.

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
"""Outcomes of a change of gains that requires no action."""
UNKNOWN = "the output could not be brought back to {:g}: its present value is unknown"
SET_POINT_UNKNOWN = "the set point could not be brought back to {:g}: its present value is unknown"
SET_POINT_BACK = "the set point is restored to {:g}"
NEVER_PUT = "which the program had not written: it was not changed"


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
        """Kind of the record."""
        return self.kept.kind

    def begin(self, station: Station) -> _Recovering:
        """Return the operation."""
        return _Recovering(self.kept, station)


class _Recovering:
    def __init__(self, record: LeaseRecord, station: Station) -> None:
        self._kept, self._station = record, station

    def abort(self, _verdict: Verdict) -> None:
        """Do nothing: the recovery is running."""

    async def run(self) -> Recovered:
        record, station = self._kept, self._station
        gains, undone = await self._gains_back()
        outcome = await CrashRecovery(record, station).go()
        if station.alone and station.journal is not None and gains.done and outcome.done and not record.restored:
            await station.journal.released("; ".join(part for part in (gains.what, outcome.what) if part))
        return Recovered(gains, undone, outcome)

    async def _gains_back(self) -> tuple[Back, RolledBack | None]:
        """Restore the gains over unverified ones; keep gains that were changed since by another program."""
        record = self._kept
        if record.undone is not None:
            return Back(BACK), RolledBack(record.loop, record.tuning, **record.undone, gains=None)
        if record.proved is not False or record.restored:
            return Back(UNTOUCHED.get(record.proved, BACK) if record.kind is Kind.GAINS else ""), None
        try:
            unproved = None if record.change is None else Unproved(record.change, record.found)
            return Back(BACK), await put_back(self._station, record.tuning if unproved is None else None, unproved)
        except TuningStateError:
            return Back("the new gains were not in the device"), None
        except GainsChangedError as error:
            return Back(f"the gains were left: {error.field} {error.message}"), None
        except AutotunerError as error:
            return Back(f"the old gains are not back: {error.message}", done=False), None


@dataclass(frozen=True, slots=True)
class CrashRecovery:
    """The recovery of one interrupted loop from its record `kept`."""

    kept: LeaseRecord
    station: Station

    async def go(self) -> Back:
        """Release the loop, or leave it to whoever has taken it over; not done where its state is unknown."""
        found = self.kept.before
        if found is None or self.kept.restored:
            return Back(NOTHING if found is None else RESTORED)
        at = self.station
        lease = lease_of(at.loop, at.backend, self.kept.kind, at.journal, at.publish)
        names = [name for name in (OUTPUT, AUTO, SET_POINT) if name in at.backend.readable]

        async def look() -> dict[str, float]:
            await lease.device.open()
            return await lease.device.read(names)

        try:
            readings = await persistently(look, lease.ticker, at.publish, at.loop.restore_limit_s)
            if (refused := self._refused(found, readings or {})) is not None:
                return refused
            if readings is None:
                return Back(self._unknown(found), done=False)
            lease.resume(found, readings.get(OUTPUT, math.nan))
            way = self._output if found.set_point is None else self._set_point
            outcome = await way(found, readings, lease)
            if lease.state is LeaseState.UNKNOWN and outcome.done:
                lease.leave()  # another one drives the loop
            return outcome
        finally:
            await quietly(lease.close())

    def _refused(self, found: Before, readings: Mapping[str, float]) -> Back | None:
        """Return that nothing is written, where the record would drive the loop to where its limits do not allow."""
        limits = self.station.loop.experiment_settings().limits
        target = found.output if self.kept.target is None else self.kept.target
        checked = [("output", target, limits.output)]
        if found.set_point is not None:
            checked.append(("set point", found.set_point, limits.pv))
        for what, value, (low, high) in checked:
            still = what == "output" and abs(readings.get(OUTPUT, math.nan) - value) <= self._tolerance
            if not (low <= value <= high or still or value == limits.safe_output):
                return Back(f"the recorded {what} {value:g} is outside of the limits: nothing was written", done=False)
        return None

    def _unknown(self, found: Before) -> str:
        """Return the outcome for a loop whose values are unknown."""
        if found.set_point is not None:
            return SET_POINT_UNKNOWN.format(found.set_point)
        return UNKNOWN.format(found.output if self.kept.target is None else self.kept.target)

    async def _output(self, found: Before, readings: Mapping[str, float], lease: Lease) -> Back:
        target = found.output if self.kept.target is None else self.kept.target
        if readings.get(AUTO):
            return Back("the device's own controller drives the output: nothing was written")
        if unrestored := self._left_at(readings, target):
            return unrestored
        done = await lease.release(Goal(target))
        return Back((f"the output is restored to {target:g}" if done else UNKNOWN.format(target)), done)

    async def _set_point(self, before: Before, readings: Mapping[str, float], lease: Lease) -> Back:
        found = math.nan if before.set_point is None else before.set_point
        target, ours = self._target(before, readings), self.kept.wide or self._is_ours(readings[SET_POINT])
        if not ours and (readings[AUTO] or target is None):
            return Back(f"the set point stood at {readings[SET_POINT]:g}, {NEVER_PUT}")
        unrestored = (
            self._left_at(readings, target)
            if target is not None and not readings[AUTO] and self.kept.commanded
            else None
        )
        from_auto = bool(readings[AUTO])
        goal = Goal(None if unrestored else target, found if ours else None, from_auto, mode_known=not from_auto)
        done = await lease.release(goal)
        set_point_back = SET_POINT_BACK.format(found) if ours else f"the set point was left at {readings[SET_POINT]:g}"
        if not done and lease.unknown == SET_POINT:
            return Back(SET_POINT_UNKNOWN.format(found), done=False)
        if not done:
            return Back(f"{set_point_back}; {UNKNOWN.format(before.output if target is None else target)}", done=False)
        if unrestored is not None:
            return Back(f"{set_point_back}; {unrestored.what}")
        return Back(
            set_point_back if target is None else f"{set_point_back}, the output at {target:g}, and the mode as it was"
        )

    def _target(self, found: Before, readings: Mapping[str, float]) -> float | None:
        """Return the output at which the loop ends by way of manual; None leaves output and mode to the device.

        In manual without having been put there, it has never left it, or was taken over.
        """
        if not readings[AUTO] and self.kept.mode != MANUAL:
            return None
        return found.output if self.kept.target is None and not found.auto else self.kept.target

    def _is_ours(self, set_point: float) -> bool:
        return any(same_number(self.station.backend, SET_POINT, set_point, ours) for ours in self.kept.set_points)

    def _left_at(self, readings: Mapping[str, float], target: float) -> Back | None:
        """Return the evidence that an operator or another program drives the output since, or None."""
        held = readings.get(OUTPUT)
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
