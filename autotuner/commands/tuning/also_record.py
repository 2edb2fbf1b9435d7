"""The PV of another loop, read along with a tuning: what `autotuner interaction` needs beside the tuning's own record.

Rules of this file: the other loop is only read; whatever fails there never disturbs the tuning, and is reported at its
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
from autotuner.errors import AutotunerError, DriverError, InputError
from autotuner.ports import AUTO, PV

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from autotuner.application.tuning_run import TuningRun
    from autotuner.core.recording import Recording
    from autotuner.ports import Backend

FEWEST = 0.5
"""Share of the samples at which the other PV must have been read: between them it is taken as straight."""


class AlsoRecorded:
    """Another loop that is read at each sample of a tuning.

    Parameters
    ----------
    name : str
        The other loop, and the column of its PV.
    backend : Backend
        Its device.
    """

    def __init__(self, name: str, backend: Backend) -> None:
        self.name, self._backend = name, backend
        self._read: list[tuple[float, float]] = []
        self._trouble: DriverError | None = None

    @contextlib.asynccontextmanager
    async def along(self, tuning: TuningRun) -> AsyncIterator[None]:
        """Read along while a tuning runs; raise `InputError` where the other loop is in automatic."""
        await self._backend.open()
        try:
            await self._require_manual()
            task = asyncio.create_task(self._follow(tuning), name=f"also-record-{self.name}")
            try:
                yield
            finally:
                task.cancel()
                await asyncio.gather(task, return_exceptions=True)
        finally:
            await self._backend.close()

    def with_column(self, recording: Recording) -> Recording:
        """Return a tuning's recording with the other PV as a further column; as it is where too little was read."""
        if len(self._read) < FEWEST * len(recording):
            why = self._trouble or "too few readings"
            remedy = "Check that its device takes a further connection, and repeat the tuning."
            say(AutotunerError(f"the PV of {self.name} is not in the recording: {why}", remedy=remedy))
            return recording
        t, pv = np.array(self._read).T
        return replace(recording, extra={**recording.extra, self.name: np.interp(recording.t, t, pv)})

    async def _require_manual(self) -> None:
        if AUTO in self._backend.readable and (await self._backend.read({AUTO}))[AUTO]:
            raise InputError(
                "is in automatic, and its controller would hide what the test does to its PV",
                field="--also-record",
                value=self.name,
                remedy="Put it to manual for the time of the test.",
            )

    async def _follow(self, tuning: TuningRun) -> None:
        """Read the other PV as soon as the tuning has a new sample."""
        seen, latest_s = 0, math.nan
        while not tuning.ended:
            await tuning.more(seen)
            seen = len(tuning.events)
            if not tuning.samples or tuning.samples[-1].t == latest_s:
                continue
            latest_s = tuning.samples[-1].t
            try:
                pv = (await self._backend.read({PV}))[PV]
            except DriverError as error:
                self._trouble = error
                continue
            if math.isfinite(pv):
                self._read.append((latest_s, pv))
