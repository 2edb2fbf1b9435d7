"""The closing of a loop as an operation: its own controller takes over without a bump, and stays in charge.

    read -> held -> PV at rest -> set point at the PV, then auto -> settled: left in auto
                                                                 -> not settled: all as it was found

Invariant: a loop that was found in auto is not changed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from autotuner.control.devices.retrying import quietly, uncancelled
from autotuner.control.driving.drive import drive
from autotuner.control.driving.lease import lease_of
from autotuner.control.driving.own_controller import find_loop
from autotuner.control.driving.settling import AT_REST, SHARP, WINDOW, WINDOWS, SettlingStage, rests_at
from autotuner.control.records.lease_record import Kind
from autotuner.control.reporting.events import PhaseChanged
from autotuner.core.experiment.phases import Phase
from autotuner.core.signals.quiet import measure_quiet
from autotuner.core.verdict import Outcome, Verdict, aborted, failed, refused
from autotuner.ports import AUTO, SET_POINT

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.control.operations.operation import Station
    from autotuner.control.records.lease_record import Before
    from autotuner.core.recording import Sample

NO_REST = refused(
    "not_at_rest",
    f"the PV does not come to rest in manual within {WINDOWS * WINDOW} samples",
    "Wait until the loop rests.",
)
CLOSED = Verdict(Outcome.DONE, "closed", "the loop is in auto under its own controller, and has settled")
STOPPED = aborted("stopped", "the closing of the loop was stopped", "Start it again.")


@dataclass(frozen=True, slots=True)
class CloseLoop:
    """The device's own controller takes the loop over; the result is a `Verdict`, `CLOSED` where it has settled."""

    kind = Kind.VERIFICATION

    def begin(self, station: Station) -> Closing:
        """Return the operation."""
        return Closing(station)


class Closing:
    """The closing of one loop; see `autotuner.control.operations.operation.Operation`."""

    def __init__(self, station: Station) -> None:
        self._station = station
        self._lease = lease_of(station.loop, station.backend, Kind.VERIFICATION, station.journal)

    def abort(self, verdict: Verdict) -> None:
        """Request the end; the loop is released as it was found."""
        self._lease.abort(verdict)

    async def run(self) -> Verdict:
        """Close the loop; raise `DriverError` where the device does not answer or lacks a signal."""
        lease, verdict = self._lease, STOPPED
        try:
            await lease.open()
            found = await find_loop(lease.device, "closed", (SET_POINT, AUTO))
            verdict = CLOSED if found.auto else await self._close(found)
        finally:
            released = await uncancelled(self._finish(verdict))
        return released

    async def _close(self, found: Before) -> Verdict:
        await self._lease.hold(found)
        stage = ClosingStage()
        return await drive(self._lease, stage) or stage.verdict or (CLOSED if stage.complete else STOPPED)

    async def _finish(self, verdict: Verdict) -> Verdict:
        """Leave a loop that is closed, restore any other; return how it ended."""
        lease, journal = self._lease, self._station.journal
        if verdict is CLOSED:
            if not lease.is_over:
                lease.leave()
        else:
            lease.abort(verdict)
            if not await lease.release():
                verdict = failed(
                    "output_unknown", f"{verdict.message}; its present value is unknown", "Check the loop."
                )
        if journal is not None and lease.is_over:
            journal.note(PhaseChanged(lease.ticker.now_s, Phase.ENDED))
        await quietly(lease.close())
        return verdict


class ClosingStage:
    """A PV at rest, a set point there, auto, then settling; see `autotuner.control.driving.drive.Stage`."""

    phase = "settling"

    def __init__(self) -> None:
        self._window: list[Sample] = []
        self._taken = 0
        self._settling: SettlingStage | None = None

    @property
    def verdict(self) -> Verdict | None:
        """Reason why the loop does not settle."""
        if self._settling is None:
            return NO_REST if self._taken >= WINDOWS * WINDOW else None
        return self._settling.verdict

    @property
    def complete(self) -> bool:
        """Whether the loop has settled, or does not."""
        return self.verdict is not None or (self._settling is not None and self._settling.complete)

    def step(self, sample: Sample) -> Mapping[str, float]:
        """Take a sample; return the values to write."""
        if self._settling is not None:
            return self._settling.step(sample)
        self._window = [*self._window, sample][-WINDOW:]
        self._taken += 1
        if len(self._window) < WINDOW:
            return {}
        t, pv = (np.array([getattr(one, name) for one in self._window]) for name in ("t", "pv"))
        set_point = float(np.median(pv))
        tolerance = SHARP * abs(set_point)
        if not rests_at(float(np.mean(pv)), pv, max(AT_REST * measure_quiet(t, pv).unsure, tolerance)):
            return {}
        self._settling = SettlingStage(set_point, tolerance)
        return {SET_POINT: set_point, AUTO: 1.0}

    def record(self, sample: Sample) -> None:
        """Do nothing: the closing is not recorded."""

    def correct(self, output: float) -> None:
        """Do nothing: the device moves its output."""

    def tolerates(self, _verdict: Verdict) -> bool:
        """Return False."""
        return False
