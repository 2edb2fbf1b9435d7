"""Gains of all loops: access control between operations, and storage of the previous ones.

Invariants:

1. Gains are never written while a tuning runs on the loop, in this program or in another one that shares the data
   directory.
2. Gains are written, restored and verified by operations (`autotuner.control.operations.gains_operations`,
   `autotuner.control.operations.verification_operation`), in the loop process where there is hardware. Where that
   process is lost, another one recovers the loop.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

from autotuner.application.analysis.basis import basis_of
from autotuner.application.operations import Operations, ProcessLostError, ignore
from autotuner.application.recovery import EarlierGains, EarlierVerification, recover
from autotuner.application.tuning_run import gains_of
from autotuner.control.clock.ticker import utc_now
from autotuner.control.devices.device_gains import device_form, required_form
from autotuner.control.devices.plugins import is_simulated
from autotuner.control.devices.retrying import to_its_end, uncancelled
from autotuner.control.gains.apply import DeviceGainsWriter
from autotuner.control.operations.close_loop import CloseLoop
from autotuner.control.operations.gains_operations import RollBack, WriteGains
from autotuner.control.operations.verification_operation import Verify
from autotuner.control.records.gains_ledger import GainsLedger
from autotuner.control.records.lease_record import DamagedRecordError, Kind, read_record
from autotuner.control.verification.verification_events import VerificationPhase
from autotuner.control.verification.verification_run import VerificationRun
from autotuner.core.jsonable import jsonable
from autotuner.errors import LinkError, TuningStateError

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.application.loop_processes import LoopProcesses
    from autotuner.application.operations import Operating
    from autotuner.application.recovery import Earlier
    from autotuner.application.tuning_run import TuningRun
    from autotuner.configuration import LoopTable
    from autotuner.control.compute_port import ComputePool
    from autotuner.control.gains.apply import Applied, RolledBack
    from autotuner.control.operations.operation import Work
    from autotuner.control.records.journal import Journal
    from autotuner.control.records.open_journal import OpenJournal
    from autotuner.control.verification.verification_run import Progress
    from autotuner.core.design import DeviceController, HeldGains, PidGains
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.verdict import Verdict
    from autotuner.ports import Backend


@dataclass(frozen=True, slots=True)
class Planned:
    """Preview of an apply: the number of each signal, and the resulting controller in the device."""

    values: dict[str, float]
    held: HeldGains


class GainService:
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
    processes : LoopProcesses or None
        The loop processes; None where there are none.
    own : bool
        Whether the loop runs in its own process.
    """

    def __init__(
        self,
        name: str,
        loop: LoopTable,
        backend: Backend,
        journal: Journal,
        processes: LoopProcesses | None = None,
        *,
        own: bool = False,
    ) -> None:
        self._name, self._loop, self._backend, self._journal = name, loop, backend, journal
        self._real = not is_simulated(backend)
        self.ledger = GainsLedger(journal.store if self._real else None, name, journal.in_place)
        self.operations = Operations(name, loop, backend, self.ledger, processes, own)

    def writer(self) -> DeviceGainsWriter:
        """Return the writer of the gains; raise `InputError` where the configuration does not map them."""
        form = required_form(self._loop, self._backend, self._name)
        return DeviceGainsWriter(self._name, self._loop, self._backend, form, self.ledger)

    def planned(self, gains: PidGains, model: ProcessModel | None = None) -> Planned:
        """Return what `write` would write; raise the same errors, without connecting."""
        form = self.writer().form
        held = form.held(gains, model)
        return Planned(form.values(held.device), held)

    @property
    def controller(self) -> DeviceController | None:
        """The controller that will hold the gains; None where the configuration does not describe it."""
        form = device_form(self._loop, self._backend, f"loops.{self._name}")
        return None if form is None else form.controller

    async def read(self) -> dict[str, object]:
        """Return the gains in the device: its numbers, and the controller that they define."""
        writer = self.writer()
        form, values = writer.form, await writer.read()
        gains, change = form.gains(values), await self.ledger.latest()
        return {
            "loop": self._name,
            "form": form.form.name,
            **form.action.to_dict(),
            "values": values,
            "gains": gains and gains.to_dict(),
            "undo": change and {"tuning_id": change.tuning or None, "at": change.at, "old": jsonable(dict(change.old))},
        }

    async def apply(self, tuning: TuningRun, gains: PidGains) -> Applied:
        """Write gains of a tuning; see `autotuner.control.gains.apply.DeviceGainsWriter.apply`."""
        applied = await self.write(gains, tuning=tuning.id, model=tuning.model, expected=tuning.device_gains)
        tuning.applied, tuning.device_gains = applied, dict(applied.now)
        return applied

    async def _change(self, work: Work, by: str) -> Any:
        """Run a change of gains under its own lease; raise `LoopBusyError` when another program holds the device."""
        journal = None
        if self._real:
            device = {"loop": self._name, "device": self._loop.device_key, "started_at": utc_now()}
            journal = self._journal.begin({"tuning": by, **device, "kind": Kind.GAINS, "request": {}})
        return await self._done(work, journal, EarlierGains(self._name, journal))

    async def _done(
        self,
        work: Work,
        journal: OpenJournal | None,
        earlier_run: Earlier,
        publish: Callable[[Any], None] = ignore,
        pool: ComputePool | None = None,
        watch: Callable[[Operating], None] = ignore,
    ) -> Any:
        """Have something done to its end; where the process is lost, have the loop recovered, and raise `LinkError`."""
        operation = self.operations.begin(work, journal, publish, pool)
        watch(operation)
        try:
            return await operation.run()
        except ProcessLostError as lost:
            raise await self._recovered(lost, journal, earlier_run) from lost
        finally:
            if journal is not None:
                await uncancelled(journal.end(None))  # the operation has recorded how it ended

    async def _recovered(self, lost: ProcessLostError, journal: OpenJournal | None, earlier_run: Earlier) -> LinkError:
        if journal is None:
            return lost
        try:
            record = read_record(journal.store, journal.name)
        except (OSError, DamagedRecordError):
            return lost
        await to_its_end(recover(earlier_run, record, self.operations))
        reason = earlier_run.verdict.message if earlier_run.verdict else "nothing is known of the loop"
        return LinkError(f"{lost.message}; {reason}", field="loop", value=self._name, remedy="Try again.")

    async def use(
        self,
        tuning: TuningRun,
        pool: ComputePool | None,
        step: float | None = None,
        watch: Callable[[VerificationRun], object] | None = None,
    ) -> VerificationRun | None:
        """Write the gains of a tuning, and verify them where arithmetic is given for it; `watch` is called with it."""
        if pool is not None:
            return await self._prove(tuning, pool, step, gains_of(tuning), watch=watch)
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
        self.planned(gains)
        return cast("Applied", await self._change(WriteGains(gains, tuning, model, expected), tuning or "apply"))

    async def roll_back(self, tuning: TuningRun | None = None, *, force: bool = False) -> RolledBack:
        """Put the gains before the latest change back; see `DeviceGainsWriter.roll_back`."""
        self.writer()
        name = tuning.id if tuning else None
        rolled_back: RolledBack = await self._change(RollBack(name, force), name or "rollback")
        if tuning is not None:
            tuning.applied, tuning.device_gains = None, dict(rolled_back.now)
        return rolled_back

    async def close_loop(self, tuning: TuningRun) -> Verdict:
        """Have the device's own controller take the loop over after a tuning; see `CloseLoop`."""
        journal = None
        if self._real:
            journal = self._journal.begin(tuning.head(self._loop.device_key) | {"kind": Kind.VERIFICATION})
        earlier_run = EarlierVerification(tuning, tuning.verdict, VerificationRun(tuning.request.actor), journal)
        return cast("Verdict", await self._done(CloseLoop(), journal, earlier_run))

    async def verify(
        self, tuning: TuningRun, pool: ComputePool, step: float | None = None, actor: str | None = None
    ) -> VerificationRun:
        """Make a step under the gains of a tuning that the device holds; the old ones go back unless it passes.

        Raises
        ------
        TuningStateError
            The device does not hold gains of this tuning.
        InputError
            The configuration does not state where the gains are.
        """
        if tuning.applied is None or tuning.analysis is None or tuning.analysis.identification.model is None:
            raise TuningStateError(
                "has no gains in the device to verify", field="tuning", value=tuning.id, remedy="Apply them first."
            )
        return await self._prove(tuning, pool, step, actor=actor)

    async def _prove(
        self,
        tuning: TuningRun,
        pool: ComputePool,
        step: float | None,
        gains: PidGains | None = None,
        actor: str | None = None,
        watch: Callable[[VerificationRun], object] | None = None,
    ) -> VerificationRun:
        """Have gains written, or leave those that are in the device, and have a step made under them."""
        self.writer()
        assert tuning.analysis is not None  # noqa: S101 - it has gains
        basis, diagnosis = basis_of(tuning.analysis.identification, self._loop.sample_time_s), tuning.analysis.diagnosis
        work = Verify(
            tuning.id,
            tuning.applied if gains is None else None,
            gains,
            tuning.model,
            tuning.device_gains,
            basis.known_as or basis.model,
            basis.covariance,
            step,
            diagnosis.effects if diagnosis else (),
        )
        run = VerificationRun(actor or tuning.request.actor)
        if watch is not None:
            watch(run)
        run.enter(VerificationPhase.WRITE, 0.0)
        journal = None
        if self._real:
            journal = self._journal.begin(tuning.head(self._loop.device_key) | {"kind": Kind.VERIFICATION})

        def take(progress: Progress) -> None:
            if tuning.verification is not run and "gains" in progress.values:
                tuning.verification = run
            run.take(progress)
            self._mirror(tuning, run)

        def begun(operation: Operating) -> None:
            tuning.verifier = operation

        earlier_run = EarlierVerification(tuning, tuning.verdict, run, journal)
        try:
            await self._done(work, journal, earlier_run, take, pool, begun)
        finally:
            tuning.verifier = None
        return run

    @staticmethod
    def _mirror(tuning: TuningRun, run: VerificationRun) -> None:
        """Have a tuning know which of its gains the device holds."""
        if run.applied is not None and run.applied is not tuning.applied:
            tuning.applied, tuning.device_gains = run.applied, dict(run.applied.now)
        if run.back is not None and tuning.applied is not None:
            tuning.applied, tuning.device_gains = None, dict(run.back.now)
