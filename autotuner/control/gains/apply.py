"""Writes gains to the device's own controller, and restores them.

    read -> store on disk -> write -> read back -> compare,   or restore the previous gains

Invariants:

1. The previous gains are on disk before the first write, and remain there until they are in the device again.
2. The read-back values decide. A device that refuses or clips a gain gets its previous gains back, and the error
   contains the value written and the value held.
3. No gains are overwritten unread: a device whose gains differ from those read earlier, or applied, is not changed.
4. After the first write, neither a cancellation nor a lost connection of the caller prevents a defined end,
   and the result is reported; after a kill, the journal's entry restores the previous gains
   (`autotuner.control.gains.pending_gains`).
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from autotuner.control.clock.ticker import utc_now
from autotuner.control.devices.device_gains import device_form
from autotuner.control.devices.retrying import to_its_end
from autotuner.control.driving.lease import lease_of
from autotuner.control.driving.lease_state import LeaseState
from autotuner.control.records.gains_ledger import Change, GainsLedger
from autotuner.control.records.lease_record import Kind
from autotuner.control.reporting.event_log import log_gains
from autotuner.core.jsonable import jsonable
from autotuner.errors import (
    DeviceRefusedError,
    DriverError,
    GainsChangedError,
    LinkError,
    StorageError,
    TuningStateError,
)

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Coroutine, Mapping

    from autotuner.configuration import LoopTable
    from autotuner.control.devices.device_gains import DeviceForm
    from autotuner.control.driving.lease import Lease
    from autotuner.control.gains.pending_gains import PendingGains, Unproved
    from autotuner.core.design import HeldGains, PidGains
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.verdict import Verdict
    from autotuner.ports import Backend

_log = logging.getLogger(__name__)

READ_BACKS = 5
"""Number of reads of a gain that differs: a device may accept it at its next scan."""
UNDO_LIMIT_S = 60.0
"""Longest time to keep trying to put the old gains back over a dead link, s."""


@dataclass(frozen=True, slots=True)
class Applied:
    """Gains that the device holds now.

    Attributes
    ----------
    loop, tuning, at : str
        Actor, the tuning of the gains (empty: entered by hand), and the time of the write.
    old, now : mapping of str to float
        Number of each signal before, and as read back.
    held : HeldGains
        What that makes in the device, with its robustness on the model.
    old_gains : PidGains or None
        The controller before; None when the numbers were none.
    """

    loop: str
    tuning: str
    at: str
    old: Mapping[str, float]
    now: Mapping[str, float]
    held: HeldGains
    old_gains: PidGains | None

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return {
            "loop": self.loop,
            "tuning_id": self.tuning or None,
            "at": self.at,
            "old": {"values": jsonable(dict(self.old)), "gains": self.old_gains and self.old_gains.to_dict()},
            "now": {"values": dict(self.now), "gains": self.held.gains.to_dict()},
            "form": self.held.form,
            "labels": self.held.labelled,
            **self.held.device.action.to_dict(),
            "margins": self.held.margins.to_dict() if self.held.margins else None,
            "warnings": list(self.held.warnings),
        }


@dataclass(frozen=True, slots=True)
class RolledBack:
    """Restored gains: `was` before, `now` as read back."""

    loop: str
    tuning: str
    at: str
    was: Mapping[str, float]
    now: Mapping[str, float]
    gains: PidGains | None

    def to_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        return {
            "loop": self.loop,
            "tuning_id": self.tuning or None,
            "at": self.at,
            "was": {"values": dict(self.was)},
            "now": {"values": dict(self.now), "gains": self.gains and self.gains.to_dict()},
        }


class DeviceGainsWriter:
    """Reads, writes and puts back the gains of one loop's device.

    Parameters
    ----------
    name : str
        The loop's name.
    loop : LoopTable
        The loop; its sample time is that between two readings of a gain that differs.
    backend : Backend
        The device.
    form : DeviceForm
        How it states its gains.
    ledger : GainsLedger
        Keeps the old ones.
    """

    def __init__(self, name: str, loop: LoopTable, backend: Backend, form: DeviceForm, ledger: GainsLedger) -> None:
        self._loop, self._table, self._backend = name, loop, backend
        self.form = form
        self._ledger = ledger
        self._lease: Lease | None = None

    @property
    def is_untouched(self) -> bool:
        """Whether nothing can have been written yet."""
        return self._lease is None or self._lease.state in {LeaseState.FREE, LeaseState.ACQUIRING}

    def abort(self, verdict: Verdict) -> None:
        """Request the end of a running change: nothing is written, or the previous gains are restored."""
        if self._lease is not None:
            self._lease.abort(verdict)

    async def read(self) -> dict[str, float]:
        """Return the number of each signal that holds a gain."""
        async with self._leased() as lease:
            return await self._look(lease)

    async def apply(
        self,
        gains: PidGains,
        *,
        tuning: str = "",
        model: ProcessModel | None = None,
        expected: Mapping[str, float] | None = None,
        journal: PendingGains | None = None,
    ) -> Applied:
        """Write gains and read them back.

        Parameters
        ----------
        gains : PidGains
            The controller wanted.
        tuning : str
            The tuning of the gains.
        model : ProcessModel, optional
            The process of the margins.
        expected : mapping, optional
            What the device held when it was last read; it must hold the same now.
        journal : PendingGains, optional
            Records the change before it begins, for the recovery after a kill.

        Raises
        ------
        InputError
            The device's form cannot hold them; nothing was written.
        GainsChangedError
            The device holds other gains than expected; nothing was written.
        StorageError
            The old gains could not be kept; nothing was written.
        DriverError
            The device refused or clipped a gain, or the link was lost: the message has the present gains.
        """
        held = self.form.held(gains, model)
        wanted = self.form.values(held.device)
        async with self._leased() as lease:
            old = await self._look(lease)
            if expected is not None and (name := self.form.differing(old, expected)):
                raise _changed(name, old[name], expected[name], "they were read")
            change = Change(tuning, utc_now(), held.form, old, wanted)
            if journal is not None:
                await journal.begins(change.at, old)
            await self._ledger.begin(change)
            await lease.hold_gains(old, wanted)
            now = await to_its_end(self._write_or_undo(lease, change, journal))
        log_gains(tuning, self._loop, "gains written and read back", now)
        return Applied(self._loop, tuning, utc_now(), old, now, held, self.form.gains(old))

    async def roll_back(
        self,
        *,
        tuning: str | None = None,
        force: bool = False,
        unproved: Unproved | None = None,
        journal: PendingGains | None = None,
    ) -> RolledBack:
        """Put the gains back that were there before the latest change.

        Parameters
        ----------
        tuning : str, optional
            The required origin of the gains.
        force : bool
            Whether to write over gains that were set by others since.
        unproved : Unproved, optional
            The change that it must be.
        journal : PendingGains, optional
            Records the change before it begins, for the recovery after a kill.

        Raises
        ------
        TuningStateError
            Nothing was applied, or the gains of another tuning were.
        GainsChangedError
            The device holds other gains than were applied; nothing was written.
        DriverError
            The device refused an old gain, or the link was lost.
        """
        change = await self._change_to_undo(tuning, unproved)
        async with self._leased() as lease:
            was = await self._look(lease)
            if not force:
                self._check_applied(was, change, unproved.found if unproved else {})
            if journal is not None:
                await journal.begins(change.at, was)
            await lease.hold_gains(was, change.old)
            now = await to_its_end(self._put_back(lease, change, was))
        log_gains(change.tuning, self._loop, "the old gains are restored", now)
        return RolledBack(self._loop, change.tuning, utc_now(), was, now, self.form.gains(now))

    async def _change_to_undo(self, tuning: str | None, unproved: Unproved | None) -> Change:
        change = await self._ledger.latest()
        if change is None or tuning not in {None, change.tuning} or (unproved and unproved.change != change.at):
            of_another = f"; those of tuning {change.tuning} were" if change and change.tuning else ""
            raise TuningStateError(
                f"has no gains that were applied{of_another}",
                field="tuning" if tuning else "loop",
                value=tuning or self._loop,
                remedy="Only gains that were applied can be rolled back, the latest first.",
            )
        return change

    def _check_applied(self, held: Mapping[str, float], change: Change, found: Mapping[str, float]) -> None:
        """Raise unless each register holds the applied or the previous value: both where a change was interrupted.

        `found` has the values that an interrupted rollback was to overwrite.
        """
        after = change.held or change.wanted
        for name in change.old:
            ours = {change.old[name], found.get(name, change.old[name])}
            if self.form.differing(held, {name: after[name]}) and held[name] not in ours:
                raise _changed(name, held[name], after[name], "they were applied")

    @contextlib.asynccontextmanager
    async def _leased(self) -> AsyncIterator[Lease]:
        """Lease the device; an end with unknown gains leaves the lease unknown."""
        lease = lease_of(self._table, self._backend, Kind.GAINS, restore_limit_s=UNDO_LIMIT_S)
        self._lease = lease
        await lease.open()
        try:
            yield lease
        finally:
            if lease.state is LeaseState.DISTURBED:
                lease.lose()
            elif not lease.is_over and lease.state is not LeaseState.UNKNOWN:
                lease.leave()  # nothing was written
            with contextlib.suppress(DriverError):
                await to_its_end(lease.close())

    async def _look(self, lease: Lease) -> dict[str, float]:
        held = await lease.device.read(list(self.form.signals.values()))
        if broken := [name for name, value in held.items() if not math.isfinite(value)]:
            raise DriverError(
                "is not a number in the device", field=broken[0], remedy="Check address and type of that register."
            )
        return held

    async def _put_back(self, lease: Lease, change: Change, was: dict[str, float]) -> dict[str, float]:
        now = was  # a device that would refuse them may have them already
        if was != change.old:
            try:
                await self._write(lease, change.old)
                now = await self._read_back(lease, change.old)
            except DriverError as error:
                if lease.state is LeaseState.HELD:
                    raise
                if not await lease.release_gains(change.old, lambda: self._read_back(lease, change.old)):
                    raise _failed(error, change.old, restored=False) from error
                now = await self._look(lease)
        if not lease.is_over:
            lease.leave()
        await self._noted(self._ledger.undo("rolled back"), "that the old gains are restored")
        return now

    async def _noted(self, note: Coroutine[object, object, None], subject: str) -> None:
        """Update the ledger, or log the failure: the device is correct, and a rollback would only repeat the writes."""
        try:
            await note
        except StorageError as error:
            _log.error("not in the ledger of loop %s %s: %s", self._loop, subject, error)

    async def _write_or_undo(self, lease: Lease, change: Change, journal: PendingGains | None) -> dict[str, float]:
        try:
            await self._write(lease, change.wanted)
            now = await self._read_back(lease, change.wanted)
        except DriverError as error:
            untouched = lease.state is LeaseState.HELD
            restored = untouched or await lease.release_gains(change.old, lambda: self._read_back(lease, change.old))
            if restored:
                await self._noted(self._ledger.undo(str(error)), "that the old gains are restored")
            raise _failed(error, change.old, restored=restored) from error
        lease.leave()
        if journal is not None:
            await journal.done()
        await self._noted(self._ledger.finish(now), "what was read back")
        return now

    @staticmethod
    async def _write(lease: Lease, values: Mapping[str, float]) -> None:
        for name, value in values.items():
            if lease.verdict is not None:
                raise DriverError(lease.verdict.message, remedy=lease.verdict.remedy)
            await lease.write({name: value})

    async def _read_back(self, lease: Lease, wanted: Mapping[str, float]) -> dict[str, float]:
        """Return the gains of the device; raise when they differ from the written ones."""
        for attempt in range(READ_BACKS):
            held = await self._look(lease)
            name = self.form.differing(held, wanted)
            if name is None:
                return held
            if attempt < READ_BACKS - 1:
                await asyncio.sleep(self._table.sample_time_s)
        assert name is not None  # noqa: S101 - the loop has ended without a return
        raise DeviceRefusedError(
            f"was written as {wanted[name]:g}, but the device holds {held[name]:g}",
            field=name,
            value=wanted[name],
            remedy="Set the device's own limits of its gains, or choose others.",
        )


async def gains_in_device(name: str, loop: LoopTable, backend: Backend) -> dict[str, float] | None:
    """Return the numbers of the device's gains, None where they are not mapped or cannot be read now."""
    form = device_form(loop, backend, f"loops.{name}")
    if form is None:
        return None
    try:
        return await DeviceGainsWriter(name, loop, backend, form, GainsLedger(None)).read()
    except DriverError:  # the next operation on the loop meets the same error, and reports it
        return None


def _changed(name: str, held: float, expected: float, event: str) -> GainsChangedError:
    return GainsChangedError(
        f"is {held:g} in the device, but was {expected:g} when {event}: the gains were changed by others",
        field=name,
        value=held,
        remedy="Compare the device's gains, and decide again.",
    )


def _failed(error: DriverError, old: Mapping[str, float], *, restored: bool) -> DriverError:
    """Return the error with the resulting state of the gains."""
    kind = type(error) if isinstance(error, DeviceRefusedError | LinkError) else DriverError
    values = ", ".join(f"{name} {value:g}" for name, value in old.items())
    if restored:
        return kind(
            f"{error.message}; the old gains are restored ({values})",
            field=error.field,
            value=error.value,
            remedy=error.remedy,
        )
    return kind(
        f"{error.message}; and the old gains could not be confirmed: the gains in the device are unknown",
        field=error.field,
        value=error.value,
        remedy=f"Roll back when the device answers again, or set them by hand: {values}.",
    )
