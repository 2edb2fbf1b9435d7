"""A verification as an operation: gains written or present, a step under them, the old gains back unless it passes.

Invariant: gains that are to be verified are recorded as unproved before the first of them is written, or before
the set point is moved. Where the program is killed meanwhile, the loop process or the next start puts the old gains
back.
"""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from autotuner.control.devices.retrying import uncancelled
from autotuner.control.gains.pending_gains import BACK
from autotuner.control.operations.crash_recovery import SET_POINT_BACK
from autotuner.control.operations.gains_operations import put_back
from autotuner.control.records.lease_record import Kind
from autotuner.control.reporting.event_log import log_gains
from autotuner.control.verification.verification_run import Claim, GainsUnderTest, RunPublisher, VerificationRun
from autotuner.control.verification.verify import Verifier
from autotuner.core.design import PidSettings
from autotuner.core.verdict import failed
from autotuner.errors import AutotunerError, StorageError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Mapping

    from autotuner.control.gains.apply import Applied
    from autotuner.control.operations.operation import Station
    from autotuner.core.design import PidGains
    from autotuner.core.design.simulation.actuators import Named
    from autotuner.core.model.arrays import FloatArray
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.verdict import Verdict


@dataclass(frozen=True, slots=True)
class Verify:
    """A verification.

    Attributes
    ----------
    tuning : str
        The tuning whose gains are verified.
    applied : Applied or None
        Gains that the device holds; None where they are to be written.
    gains : PidGains or None
        Gains to be written; None where the device holds them.
    identified : ProcessModel or None
        The process of the margins.
    expected : mapping or None
        What the device held when it was last read.
    model : ProcessModel
        The process that the step is predicted by.
    covariance : array of float or None
        Covariance of its parameters.
    step : float or None
        Step of the set point that is wanted, PV units.
    effects : tuple of Named
        Effects that a diagnosis has found in addition to the process.
    """

    tuning: str
    applied: Applied | None
    gains: PidGains | None
    identified: ProcessModel | None
    expected: Mapping[str, float] | None
    model: ProcessModel
    covariance: FloatArray | None
    step: float | None
    effects: tuple[Named, ...]

    kind = Kind.VERIFICATION

    def begin(self, station: Station) -> _Verifying:
        """Return the operation."""
        return _Verifying(self, station)


class _Verifying:
    """Publishes `autotuner.control.verification.verification_run.Progress`."""

    def __init__(self, work: Verify, station: Station) -> None:
        self._work, self._station, self._writer = work, station, station.writer()
        self._run = VerificationRun(applied=work.applied)
        self._run.publisher = RunPublisher(self._run, station.publish)
        self._verifier: Verifier | None = None
        self._requested: Verdict | None = None

    def abort(self, verdict: Verdict) -> None:
        self._requested = self._requested or verdict
        if self._verifier is not None:
            self._verifier.abort(verdict)

    async def run(self) -> None:
        work, station, run = self._work, self._station, self._run
        async with self._unproved():
            if work.gains is not None:
                run.applied = await self._writer.apply(
                    work.gains, tuning=work.tuning, model=work.identified, expected=work.expected
                )
            assert run.applied is not None  # noqa: S101 - written now, or the device holds them
            run.take_gains(self._under_test(run.applied))
            claim, journal = self._claim(run.applied), station.journal
            self._verifier = Verifier(station.loop, station.backend, claim, station.pool, self._undo, run, journal)
            if self._requested is not None:
                self._verifier.abort(self._requested)
            outcome = await self._verifier.conduct()
            log_gains(work.tuning, station.name, f"verification {outcome.outcome} ({outcome.code}): {outcome.message}")

    def _under_test(self, applied: Applied) -> GainsUnderTest:
        written = self._writer.form.values(applied.held.device)
        return GainsUnderTest(applied.held.form, applied.old, written, applied.now)

    def _claim(self, applied: Applied) -> Claim:
        work, table, h = self._work, self._station.loop.gains, self._station.loop.sample_time_s
        assert table is not None  # noqa: S101 - there is a form
        settings = PidSettings(applied.held.gains, slew_per_s=table.output_slew_per_s or math.inf)
        return Claim(work.model, work.covariance, settings, work.step, min(table.scan_s or h, h), work.effects)

    async def _undo(self) -> None:
        self._run.back = await put_back(self._station, self._work.tuning)
        self._run.applied = None

    @contextlib.asynccontextmanager
    async def _unproved(self) -> AsyncIterator[None]:
        """Let the next start restore everything, until the restore is complete."""
        journal, run, disturbed = self._station.journal, self._run, False
        if journal is None:
            yield
            return
        failed_as: tuple[Verdict, bool] | None = None
        try:
            await journal.unproved()
            disturbed = True
            yield
        except AutotunerError as error:
            why = failed("not_applied", f"the gains were not applied: {error}", error.remedy)
            failed_as = why, not disturbed or await self._is_undone()
            raise
        finally:
            settled = run.verdict is not None and run.unresolved is None
            verdict, released = failed_as or (run.unresolved or run.verdict, settled)
            await uncancelled(self._end(verdict, released=released))

    async def _end(self, verdict: Verdict | None, *, released: bool) -> None:
        journal, found = self._station.journal, self._verifier.found if self._verifier else None
        assert journal is not None  # noqa: S101 - asked by the caller
        if not (self._station.alone and released):
            await journal.end(verdict, released=released)
            return
        parts = [BACK] * self._run.rolled_back
        parts += [SET_POINT_BACK.format(found.set_point)] if found is not None else []
        await journal.released("; ".join(parts))
        await journal.end(None)

    async def _is_undone(self) -> bool:
        """Return whether the device holds no gains of the tuning, by the ledger."""
        try:
            change = await self._station.ledger.latest()
        except StorageError:
            return False
        return change is None or change.tuning != self._work.tuning
