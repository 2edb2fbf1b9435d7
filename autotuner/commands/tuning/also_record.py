"""The PV of another loop, recorded along with a tuning, as `autotuner interaction` needs it.

Invariants: the other loop is only read; whatever fails there never disturbs the tuning, and is reported at its
end.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from autotuner.commands.terminal.output import say
from autotuner.control.operations.read_along import OPEN, READ, ReadAlong
from autotuner.core.verdict import aborted
from autotuner.errors import AutotunerError, DriverError, InputError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from autotuner.application.operations import Operating, Operations
    from autotuner.application.tuning_run import TuningRun
    from autotuner.core.recording import Recording

ENDED = aborted("ended", "the tuning has ended", "")
FEWEST = 0.5
"""Share of the samples at which the other PV must have been read: between them it is taken as straight."""


class AlsoRecorded:
    """Another loop that is read at each sample of a tuning.

    Parameters
    ----------
    name : str
        The other loop, and the column of its PV.
    operations : Operations
        Has the loop read, in the process that drives the tuned one: both may be on one port.
    """

    def __init__(self, name: str, operations: Operations) -> None:
        self.name, self._operations = name, operations
        self._read: list[tuple[float, float]] = []
        self._trouble: DriverError | None = None

    @contextlib.asynccontextmanager
    async def along(self, tuning: TuningRun) -> AsyncIterator[None]:
        """Read along while a tuning runs; raise `InputError` where the other loop is in automatic."""
        reading = self._operations.begin(ReadAlong())
        running = asyncio.create_task(reading.run())
        try:
            await self._require_manual(reading)
            task = asyncio.create_task(self._follow(reading, tuning), name=f"also-record-{self.name}")
            try:
                yield
            finally:
                task.cancel()
                await asyncio.gather(task, return_exceptions=True)
        finally:
            reading.abort(ENDED)
            await asyncio.gather(running, return_exceptions=True)

    def with_column(self, recording: Recording) -> Recording:
        """Return a tuning's recording with the other PV as a further column; as it is where too little was read."""
        if len(self._read) < FEWEST * len(recording):
            why = self._trouble or "too few readings"
            remedy = "Check that its device takes a further connection, and repeat the tuning."
            say(AutotunerError(f"the PV of {self.name} is not in the recording: {why}", remedy=remedy))
            return recording
        t, pv = np.array(self._read).T
        return replace(recording, extra={**recording.extra, self.name: np.interp(recording.t, t, pv)})

    async def _require_manual(self, reading: Operating) -> None:
        if await reading.ask(OPEN):
            raise InputError(
                "is in automatic, and its controller would hide the response of its PV to the test",
                field="--also-record",
                value=self.name,
                remedy="Put it to manual for the time of the test.",
            )

    async def _follow(self, reading: Operating, tuning: TuningRun) -> None:
        """Read the other PV as soon as the tuning has a new sample."""
        seen, latest_s = 0, math.nan
        while not tuning.ended:
            await tuning.more(seen)
            seen = len(tuning.events)
            if not tuning.samples or tuning.samples[-1].t == latest_s:
                continue
            latest_s = tuning.samples[-1].t
            try:
                pv = await reading.ask(READ)
            except DriverError as error:
                self._trouble = error
                continue
            if math.isfinite(pv):
                self._read.append((latest_s, pv))
