"""Gains of all loops: who may write them when, and where the old ones are kept.

Rule of this file: gains are never written while a tuning runs on the loop, in this program or in another one that
shares the data directory.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

from autotuner.core.jsonable import jsonable
from autotuner.core.tuning import PidSettings
from autotuner.errors import (
    DeviceRefusedError,
    GainsChangedError,
    InputError,
    LinkError,
    LoopBusyError,
    StorageError,
    TuningStateError,
)
from autotuner.runtime import device_lock
from autotuner.runtime.apply import DeviceGainsWriter
from autotuner.runtime.basis import basis_of
from autotuner.runtime.device_gains import required_form
from autotuner.runtime.gains_ledger import ledger_of
from autotuner.runtime.plugins import is_simulated
from autotuner.runtime.restore import persistently
from autotuner.runtime.ticker import Ticker
from autotuner.runtime.verification_run import Claim, VerificationRun
from autotuner.runtime.verify import Verifier

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from autotuner.configuration import LoopTable
    from autotuner.core.process import ProcessModel
    from autotuner.core.tuning import HeldGains, PidGains
    from autotuner.ports import Backend
    from autotuner.runtime.analysed import Analysis
    from autotuner.runtime.apply import Applied, RolledBack
    from autotuner.runtime.arithmetic import Arithmetic
    from autotuner.runtime.gains_ledger import GainsLedger
    from autotuner.runtime.tuning import Tuning


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
    folder : Path
        The data directory.
    in_place : bool
        See `GainsLedger`.
    """

    def __init__(self, name: str, loop: LoopTable, backend: Backend, folder: Path, *, in_place: bool = False) -> None:
        self._name, self._loop, self._backend, self._folder = name, loop, backend, folder
        self._real = not is_simulated(backend)
        self.ledger: GainsLedger = ledger_of(folder, name, kept=self._real, in_place=in_place)

    def writer(self) -> DeviceGainsWriter:
        """Return what writes the gains; raise `InputError` where the configuration does not tell where they are."""
        form = required_form(self._loop, self._backend, self._name)
        return DeviceGainsWriter(self._name, self._backend, form, self.ledger, self._loop.sample_time_s)

    def planned(self, gains: PidGains, model: ProcessModel | None = None) -> Planned:
        """Return what `write` would write; raises as it would, without connecting."""
        form = required_form(self._loop, self._backend, self._name)
        held = form.held(gains, model)
        return Planned(form.values(held.device), held)

    def held(self, gains: PidGains, model: ProcessModel | None = None) -> HeldGains | None:
        """Return what the device would hold; None where it cannot, or where the configuration does not tell."""
        try:
            return self.planned(gains, model).held
        except (InputError, DeviceRefusedError):
            return None

    @contextlib.contextmanager
    def holding(self, by: str) -> Iterator[None]:
        """Keep other programs from the device; raise `LoopBusyError` when one of them has it."""
        lock = self._lock(by) if self._real else None
        try:
            yield
        finally:
            if lock is not None:
                lock.release()

    async def read(self) -> dict[str, object]:
        """Return what the device holds: its numbers, and the controller that they make."""
        form = required_form(self._loop, self._backend, self._name)
        values = await self.writer().read()
        gains, change = form.gains(values), await self.ledger.latest()
        return {
            "loop": self._name,
            "form": form.form.name,
            "action": form.action.value,
            "values": values,
            "gains": gains and gains.to_dict(),
            "undo": change and {"tuning_id": change.tuning or None, "at": change.at, "old": jsonable(dict(change.old))},
        }

    async def apply(self, tuning: Tuning, gains: PidGains) -> Applied:
        """Write gains of a tuning; see `DeviceGainsWriter.apply`."""
        identified = tuning.analysis.identification.model if tuning.analysis else None
        applied = await self.write(gains, tuning=tuning.id, model=identified, expected=tuning.device_gains)
        tuning.applied, tuning.device_gains = applied, dict(applied.now)
        return applied

    async def use(self, tuning: Tuning, arithmetic: Arithmetic | None) -> None:
        """Write the gains of a tuning, and verify them where arithmetic is given for it."""
        await self.apply(tuning, gains_of(tuning))
        if arithmetic is not None:
            await self.verify(tuning, arithmetic)

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
        with self.holding(tuning or "apply"):
            return await writer.apply(gains, tuning=tuning, model=model, expected=expected)

    async def roll_back(self, tuning: Tuning | None = None, *, force: bool = False) -> RolledBack:
        """Put the gains before the latest change back; see `DeviceGainsWriter.roll_back`."""
        writer = self.writer()
        with self.holding(tuning.id if tuning else "rollback"):
            back = await writer.roll_back(tuning=tuning.id if tuning else None, force=force)
        if tuning is not None:
            tuning.applied, tuning.device_gains = None, dict(back.now)
        return back

    async def verify(self, tuning: Tuning, arithmetic: Arithmetic, step: float | None = None) -> VerificationRun:
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
        claim = self._claim(tuning.applied.held.gains, tuning.analysis, step)
        run = tuning.verification = VerificationRun()
        with self.holding(tuning.id):
            verifier = Verifier(self._loop, self._backend, claim, arithmetic, lambda: self._undo(tuning), run)
            tuning.verifier = verifier
            try:
                await verifier.conduct()
            finally:
                tuning.verifier = None
        return run

    def _claim(self, gains: PidGains, analysis: Analysis, step: float | None) -> Claim:
        table, h, identification = self._loop.gains, self._loop.sample_time_s, analysis.identification
        assert table is not None  # noqa: S101 - there are gains in the device
        scan_s = min(table.scan_s or h, h)
        filter_s = gains.Td / table.derivative_filter if table.derivative_filter else 0.0
        basis = basis_of(identification, h)
        settings = PidSettings(gains, derivative_filter_s=filter_s)
        effects = analysis.diagnosis.effects if analysis.diagnosis else ()
        return Claim(basis.known_as or basis.model, basis.covariance, settings, step, scan_s, effects)

    async def _undo(self, tuning: Tuning) -> None:
        """Put the old gains back, over a link that may be dead for a while."""
        writer = self.writer()

        async def attempt() -> RolledBack | GainsChangedError:
            try:
                return await writer.roll_back(tuning=tuning.id)
            except GainsChangedError as error:  # trying again would not help
                return error

        back = await persistently(attempt, Ticker(self._loop.sample_time_s), lambda _: None, self._loop.restore_limit_s)
        if back is None:
            raise LinkError("the device does not answer", remedy="Roll back when it answers again.")
        if isinstance(back, GainsChangedError):
            raise back
        tuning.applied, tuning.device_gains = None, dict(back.now)

    def _lock(self, by: str) -> device_lock.DeviceLock:
        at = self._folder / "locks" / self._loop.device_key
        try:
            lock = device_lock.acquire(at, by)
        except OSError as error:
            raise StorageError(
                f"cannot be used: {error.strerror}", field=str(at), remedy="Make service.data_directory writable."
            ) from error
        if lock is None:
            raise LoopBusyError(self._name, device_lock.holder(at))
        return lock


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
