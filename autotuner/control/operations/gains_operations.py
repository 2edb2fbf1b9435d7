"""Operations on the gains of a device: write and restore.

    recorded -> written, read back -> proved,   or the old ones again

Invariant: where the front is gone, gains that are not written and read back completely are restored.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from autotuner.control.clock.ticker import Ticker
from autotuner.control.devices.retrying import persistently
from autotuner.control.gains.pending_gains import under_way
from autotuner.control.operations.messages import ALONE
from autotuner.control.records.lease_record import Kind
from autotuner.errors import (
    AutotunerError,
    DriverError,
    GainsChangedError,
    LinkError,
    ShuttingDownError,
    TuningStateError,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.control.gains.apply import Applied, RolledBack
    from autotuner.control.gains.pending_gains import Unproved
    from autotuner.control.operations.operation import Station
    from autotuner.core.design import PidGains
    from autotuner.core.model.process import ProcessModel
    from autotuner.core.verdict import Verdict


@dataclass(frozen=True, slots=True)
class WriteGains:
    """Gains are written and read back; see `autotuner.control.gains.apply.DeviceGainsWriter.apply`."""

    gains: PidGains
    tuning: str = ""
    model: ProcessModel | None = None
    expected: Mapping[str, float] | None = None

    kind = Kind.GAINS

    def begin(self, station: Station) -> _Writing:
        """Return the operation."""
        return _Writing(self, station)


@dataclass(frozen=True, slots=True)
class RollBack:
    """Restores the gains before the latest change; see `DeviceGainsWriter.roll_back`."""

    tuning: str | None = None
    force: bool = False

    kind = Kind.GAINS

    def begin(self, station: Station) -> _RollingBack:
        """Return the operation."""
        return _RollingBack(self, station)


class _Writing:
    def __init__(self, work: WriteGains, station: Station) -> None:
        self._work, self._station, self._writer = work, station, station.writer()
        self._stopped = False

    async def run(self) -> Applied:
        work, station = self._work, self._station
        try:
            async with under_way(station.journal, station.ledger, lambda: station.alone) as change:
                return await self._writer.apply(
                    work.gains, tuning=work.tuning, model=work.model, expected=work.expected, journal=change
                )
        except DriverError:
            if self._stopped:  # before anything was written
                raise ShuttingDownError from None
            raise

    def abort(self, verdict: Verdict) -> None:
        """Request the end; gains being written are completed unless the front is gone."""
        if self._writer.is_untouched:
            self._stopped = True
        if self._stopped or verdict.code == ALONE.code:
            self._writer.abort(verdict)


class _RollingBack:
    def __init__(self, work: RollBack, station: Station) -> None:
        self._work, self._station, self._writer = work, station, station.writer()

    async def run(self) -> RolledBack:
        work, station = self._work, self._station
        async with under_way(station.journal, station.ledger, lambda: station.alone) as change:
            return await self._writer.roll_back(tuning=work.tuning, force=work.force, journal=change)

    def abort(self, _verdict: Verdict) -> None:
        """Do nothing: the recovery is running."""


async def put_back(station: Station, tuning: str | None, unproved: Unproved | None = None) -> RolledBack:
    """Put the gains before those of a tuning, or before a change, back over a link that may be dead for a while.

    Raises
    ------
    TuningStateError
        Those of that tuning, or that change, are not in the device.
    GainsChangedError
        Others were set since; nothing was written.
    LinkError
        The device does not answer.
    """
    writer = station.writer()

    async def attempt() -> RolledBack | AutotunerError:
        try:
            return await writer.roll_back(tuning=tuning, unproved=unproved)
        except (GainsChangedError, TuningStateError) as error:  # trying again would not help
            return error

    back = await persistently(attempt, Ticker(station.loop.sample_time_s), lambda _: None, station.loop.restore_limit_s)
    if back is None:
        raise LinkError("the device does not answer", remedy="Roll back when it answers again.")
    if isinstance(back, AutotunerError):
        raise back
    if station.journal is not None:
        await station.journal.undone(back.at, back.was, back.now)
    return back
