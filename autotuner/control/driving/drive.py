"""The driver loop: the same for an experiment, the settling of a loop, and a verification.

    tick -> read -> supervise -> stage.step -> write -> record,   until the stage is complete or the lease is to end

Invariants:

1. No formula and no decision: the stage decides, the supervisor permits, the ticker keeps time, the lease writes.
2. The supervisor decides how long the loop may run without a PV after failed reads. A failed write ends the drive,
   because the output of the device is unknown.
3. The stage does not receive a doubtful sample, or one without a PV.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

from autotuner.control.reporting.events import LinkTrouble
from autotuner.core.recording import Sample
from autotuner.errors import DriverError
from autotuner.ports import PV, SET_POINT

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.control.clock.ticker import Tick
    from autotuner.control.driving.lease import Lease
    from autotuner.core.verdict import Verdict


class Stage(Protocol):
    """Behaviour of an operation, sample by sample; independent of device and clock."""

    @property
    def phase(self) -> str:
        """Name of the present phase, which has a time limit."""

    @property
    def complete(self) -> bool:
        """Whether the stage needs no further samples."""

    def step(self, sample: Sample) -> Mapping[str, float]:
        """Take a sample; return the signals to be written."""

    def record(self, sample: Sample) -> None:
        """Record a sample with the output that the device holds after it."""

    def correct(self, output: float) -> None:
        """Correct the output that the device really held after the last sample."""

    def tolerates(self, verdict: Verdict) -> bool:
        """Return whether the stage continues in spite of a verdict that ends an operation."""


async def drive(lease: Lease, stage: Stage) -> Verdict | None:
    """Drive a stage until it is complete; return None then, or why the lease is to end before.

    Raises
    ------
    DriverError
        A write failed.
    StorageError
        What was about to be written could not be recorded.
    """
    with lease.watched():
        while (tick := await lease.ticker.tick(lease.stop)) is not None:
            await _cycle(lease, stage, tick)
            if stage.complete:
                return None
    return lease.verdict


async def _cycle(lease: Lease, stage: Stage, tick: Tick) -> None:
    try:
        readings, t = await lease.sample()
    except DriverError as error:
        if not lease.stop.is_set():
            _miss(lease, tick, error)
        return
    stage.correct(lease.held)
    sample = Sample(t, float(readings[PV]), lease.held, float(readings.get(SET_POINT, math.nan)), tick.lateness_s)
    verdict = _judged(lease, stage, sample, tick)
    if verdict is not None and not stage.tolerates(verdict):
        if math.isfinite(sample.pv):
            stage.record(sample)
        lease.trip(verdict)
    elif math.isfinite(sample.pv) and not lease.watch.doubt:
        values = stage.step(sample)
        written_s = await lease.write(values) if values else math.nan
        stage.record(replace(sample, output=lease.held, written_s=written_s))


def _miss(lease: Lease, tick: Tick, error: DriverError) -> None:
    """Report a sample that could not be read, and end where there was no PV for too long."""
    now_s = lease.ticker.now_s
    lease.publish(LinkTrouble(now_s, str(error)))
    if (lost := lease.watch.check_failure(now_s, lease.stalled_s(tick), error)) is not None:
        lease.trip(lost)


def _judged(lease: Lease, stage: Stage, sample: Sample, tick: Tick) -> Verdict | None:
    """Return why the lease is to end; where the sample is in doubt only, report that."""
    verdict = lease.watch.check(sample, auto=lease.auto, phase=stage.phase, still_s=lease.stalled_s(tick))
    verdict = verdict or lease.overridden(sample.t)
    if doubt := lease.watch.doubt:
        lease.doubt()
        if verdict is None:
            lease.publish(LinkTrouble(sample.t, f"{doubt}: a damaged reading, unless the next one confirms it"))
    return verdict
