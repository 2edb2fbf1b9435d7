"""Gains of all loops: who may write them when, and where the old ones are kept.

Rules of this file:

1. Gains are never written while a tuning runs on the loop, in this program or in another one that shares the data
   directory.
2. Gains that are to be verified are known as unproved, on the disk, before the first of them is written, or before the
   set point is moved; those that are only written, until they have been read back. Where a program is killed meanwhile,
   the process that stands by puts the old gains back, or else the next program.
"""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from autotuner.application.basis import basis_of
from autotuner.control.apply import DeviceGainsWriter
from autotuner.control.device_gains import device_form, required_form
from autotuner.control.event_log import log_gains
from autotuner.control.gains_ledger import GainsLedger
from autotuner.control.lease_record import Kind
from autotuner.control.pending_gains import under_way
from autotuner.control.plugins import is_simulated
from autotuner.control.retrying import persistently, uncancelled
from autotuner.control.ticker import Ticker, utc_now
from autotuner.control.verification_events import VerificationPhase
from autotuner.control.verification_run import Claim, GainsUnderTest, VerificationRun
from autotuner.control.verify import Verifier
from autotuner.core.design import PidSettings
from autotuner.core.jsonable import jsonable
from autotuner.core.verdict import failed
from autotuner.errors import (
    AutotunerError,
    GainsChangedError,
    LinkError,
    StorageError,
    TuningStateError,
)

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from pathlib import Path

    from autotuner.application.tuning_run import Tuning
    from autotuner.configuration import LoopTable
    from autotuner.control.apply import Applied, RolledBack
    from autotuner.control.compute_port import ComputePool
    from autotuner.control.journal import Journal
    from autotuner.control.open_journal import OpenJournal
    from autotuner.control.pending_gains import PendingGains, Unproved
    from autotuner.core.design import DeviceController, HeldGains, PidGains
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.verdict import Verdict
    from autotuner.ports import Backend

    Guard = Callable[[str, LoopTable, Path], contextlib.AbstractAsyncContextManager[None]]


@contextlib.asynccontextmanager
async def unguarded(_name: str, _loop: LoopTable, _folder: Path) -> AsyncIterator[None]:
    """Be without a guardian: in virtual time there are no other processes."""
    yield


@dataclass(frozen=True, slots=True)
class Planned:
    """What an apply would write: the number of each signal, and what that makes in the device."""

    values: dict[str, float]
    held: HeldGains


class GainsDesk:
    """Writes gains of one loop.

    Parameters
    ----------
    name : str
        The loop's name.
    loop : LoopTable
        The loop.
    backend : Backend
        Its device.
    journal : Journal
        The journals of the data directory, where the old gains are kept too.
    guard : callable
        Has a process stand by while gains are written or verified.
    """

    def __init__(
        self, name: str, loop: LoopTable, backend: Backend, journal: Journal, guard: Guard = unguarded
    ) -> None:
        self._name, self._loop, self._backend, self._journal = name, loop, backend, journal
        self._guard = guard
        self._real = not is_simulated(backend)
        self.ledger = GainsLedger(journal.store if self._real else None, name, journal.in_place)

    def writer(self) -> DeviceGainsWriter:
        """Return what writes the gains; raise `InputError` where the configuration does not tell where they are."""
        form = required_form(self._loop, self._backend, self._name)
        return DeviceGainsWriter(self._name, self._loop, self._backend, form, self.ledger)

    def planned(self, gains: PidGains, model: ProcessModel | None = None) -> Planned:
        """Return what `write` would write; raises as it would, without connecting."""
        form = required_form(self._loop, self._backend, self._name)
        held = form.held(gains, model)
        return Planned(form.values(held.device), held)

    @property
    def controller(self) -> DeviceController | None:
        """The controller that will hold the gains; None where the configuration does not describe it."""
        form = device_form(self._loop, self._backend, f"loops.{self._name}")
        return None if form is None else form.controller

    @contextlib.asynccontextmanager
    async def _alone(self, by: str) -> AsyncIterator[PendingGains | None]:
        """Keep other programs from the device while gains are written; raise `LoopBusyError` when one has it."""
        if not self._real:
            yield None
            return
        device = {"loop": self._name, "device": self._loop.device_key, "started_at": utc_now()}
        journal = self._journal.begin({"tuning": by, **device, "kind": Kind.GAINS, "request": {}})
        async with under_way(journal, self.ledger) as change, self.guarded():
            yield change

    async def read(self) -> dict[str, object]:
        """Return what the device holds: its numbers, and the controller that they make."""
        form = required_form(self._loop, self._backend, self._name)
        values = await self.writer().read()
        gains, change = form.gains(values), await self.ledger.latest()
        return {
            "loop": self._name,
            "form": form.form.name,
            **form.action.to_dict(),
            "values": values,
            "gains": gains and gains.to_dict(),
            "undo": change and {"tuning_id": change.tuning or None, "at": change.at, "old": jsonable(dict(change.old))},
        }

    async def apply(self, tuning: Tuning, gains: PidGains) -> Applied:
        """Write gains of a tuning; see `DeviceGainsWriter.apply`."""
        self.planned(gains)  # what it refuses needs nobody to stand by
        async with self._alone(tuning.id) as change:
            return await self._write_of(tuning, gains, change)

    async def _write_of(self, tuning: Tuning, gains: PidGains, change: PendingGains | None = None) -> Applied:
        identified = tuning.analysis.identification.model if tuning.analysis else None
        expected = tuning.device_gains
        applied = await self.writer().apply(
            gains, tuning=tuning.id, model=identified, expected=expected, journal=change
        )
        tuning.applied, tuning.device_gains = applied, dict(applied.now)
        return applied

    async def use(
        self,
        tuning: Tuning,
        arithmetic: ComputePool | None,
        step: float | None = None,
        watch: Callable[[VerificationRun], object] | None = None,
    ) -> VerificationRun | None:
        """Write the gains of a tuning, and verify them where arithmetic is given for it; `watch` is called with it."""
        if arithmetic is not None:
            return await self._prove(tuning, arithmetic, step, gains_of(tuning), watch=watch)
        await self.apply(tuning, gains_of(tuning))
        return None

    async def write(
        self,
        gains: PidGains,
        *,
        tuning: str = "",
        model: ProcessModel | None = None,
        expected: dict[str, float] | None = None,
    ) -> Applied:
        """Write gains; see `DeviceGainsWriter.apply`."""
        writer = self.writer()
        self.planned(gains)
        async with self._alone(tuning or "apply") as change:
            return await writer.apply(gains, tuning=tuning, model=model, expected=expected, journal=change)

    async def roll_back(self, tuning: Tuning | None = None, *, force: bool = False) -> RolledBack:
        """Put the gains before the latest change back; see `DeviceGainsWriter.roll_back`."""
        writer = self.writer()
        async with self._alone(tuning.id if tuning else "rollback") as change:
            back = await writer.roll_back(tuning=tuning.id if tuning else None, force=force, journal=change)
        if tuning is not None:
            tuning.applied, tuning.device_gains = None, dict(back.now)
        return back

    async def verify(
        self, tuning: Tuning, arithmetic: ComputePool, step: float | None = None, actor: str | None = None
    ) -> VerificationRun:
        """Make a step under the gains of a tuning that the device holds; the old ones go back unless it passes.

        Raises
        ------
        TuningStateError
            The device does not hold gains of this tuning.
        InputError
            The configuration does not tell where the gains are.
        """
        if tuning.applied is None or tuning.analysis is None or tuning.analysis.identification.model is None:
            raise TuningStateError(
                "has no gains in the device to verify", field="tuning", value=tuning.id, remedy="Apply them first."
            )
        return await self._prove(tuning, arithmetic, step, actor=actor)

    async def _prove(
        self,
        tuning: Tuning,
        arithmetic: ComputePool,
        step: float | None,
        gains: PidGains | None = None,
        actor: str | None = None,
        watch: Callable[[VerificationRun], object] | None = None,
    ) -> VerificationRun:
        """Write gains, or leave those that are in the device, and make a step under them."""
        self.writer()
        run = VerificationRun(actor or tuning.request.actor)
        if watch is not None:
            watch(run)
        run.enter(VerificationPhase.WRITE, 0.0)
        async with self.guarded(), self._unproved(tuning, run) as journal:
            if gains is not None:
                await self._write_of(tuning, gains)
            assert tuning.applied is not None  # noqa: S101 - written now, or `verify` has looked
            run.take_gains(self._under_test(tuning.applied))
            tuning.verification = run
            claim, undo = self._claim(tuning, step), lambda: self._undo(tuning)
            tuning.verifier = Verifier(self._loop, self._backend, claim, arithmetic, undo, run, journal)
            try:
                told = await tuning.verifier.conduct()
                log_gains(tuning.id, self._name, f"verification {told.outcome} ({told.code}): {told.message}")
            finally:
                tuning.verifier = None
        return run

    def _under_test(self, applied: Applied) -> GainsUnderTest:
        form = required_form(self._loop, self._backend, self._name)
        return GainsUnderTest(applied.held.form, applied.old, form.values(applied.held.device), applied.now)

    def guarded(self) -> contextlib.AbstractAsyncContextManager[None]:
        """Have a process stand by where the device outlives this program, for what is moved meanwhile."""
        guard = self._guard if self._real else unguarded
        return guard(self._name, self._loop, self._journal.folder)

    @contextlib.asynccontextmanager
    async def _unproved(self, tuning: Tuning, run: VerificationRun) -> AsyncIterator[OpenJournal | None]:
        """Hold the device, and have the next program put everything back, until nothing is left to be put back."""
        if not self._real:
            yield None
            return
        head = tuning.head(self._loop.device_key) | {"kind": Kind.VERIFICATION}
        journal, moved = self._journal.begin(head), False
        failed_as: tuple[Verdict, bool] | None = None
        try:
            await journal.unproved()
            moved = True
            yield journal
        except AutotunerError as error:
            why = failed("not_applied", f"the gains were not applied: {error}", error.remedy)
            failed_as = why, not moved or await self._is_undone(tuning)
            raise
        finally:
            settled = run.verdict is not None and run.unresolved is None
            verdict, given_back = failed_as or (run.unresolved or run.verdict, settled)
            await uncancelled(journal.end(verdict, given_back=given_back))

    async def _is_undone(self, tuning: Tuning) -> bool:
        """Return whether the ledger says that no gains of a tuning are in the device."""
        try:
            change = await self.ledger.latest()
        except StorageError:
            return False
        return change is None or change.tuning != tuning.id

    def _claim(self, tuning: Tuning, step: float | None) -> Claim:
        table, h, analysis = self._loop.gains, self._loop.sample_time_s, tuning.analysis
        assert table is not None  # noqa: S101 - there are gains of this tuning in the device
        assert analysis is not None  # noqa: S101
        assert tuning.applied is not None  # noqa: S101
        gains, identification = tuning.applied.held.gains, analysis.identification
        scan_s = min(table.scan_s or h, h)
        basis = basis_of(identification, h)
        settings = PidSettings(gains, slew_per_s=table.output_slew_per_s or math.inf)
        effects = analysis.diagnosis.effects if analysis.diagnosis else ()
        return Claim(basis.known_as or basis.model, basis.covariance, settings, step, scan_s, effects)

    async def undo(self, tuning_id: str | None, unproved: Unproved | None = None) -> RolledBack:
        """Put the gains before those of a tuning, or before a change, back over a link that may be dead for a while.

        Raises
        ------
        TuningStateError
            Those of that tuning, or that change, are not in the device.
        GainsChangedError
            Somebody else has set others since; nothing was written.
        LinkError
            The device does not answer.
        """
        writer = self.writer()

        async def attempt() -> RolledBack | AutotunerError:
            try:
                return await writer.roll_back(tuning=tuning_id, unproved=unproved)
            except (GainsChangedError, TuningStateError) as error:  # trying again would not help
                return error

        back = await persistently(attempt, Ticker(self._loop.sample_time_s), lambda _: None, self._loop.restore_limit_s)
        if back is None:
            raise LinkError("the device does not answer", remedy="Roll back when it answers again.")
        if isinstance(back, AutotunerError):
            raise back
        return back

    async def _undo(self, tuning: Tuning) -> None:
        back = await self.undo(tuning.id)
        tuning.applied, tuning.device_gains = None, dict(back.now)


def gains_of(tuning: Tuning) -> PidGains:
    """Return the gains of a tuning that ended well.

    Raises
    ------
    TuningStateError
        It runs, or has no gains.
    """
    if not tuning.succeeded or tuning.analysis is None or tuning.analysis.gains is None:
        raise TuningStateError(
            "has no gains to apply", field="tuning", value=tuning.id, remedy="Take a tuning that ended as done."
        )
    return tuning.analysis.gains.gains
