"""Keeping tunings as they happen: a reader of their events that writes to the database in a thread of its own.

Rules of this file:

1. Samples are on disk `FLUSH_S` after they were taken at the latest, and the thread's time: a killed service loses less
   than a second of them.
2. A start asks first whether there is room, and is refused when there is none. Once it runs, trouble is logged and the
   tuning goes on.
3. In place (in virtual time) the thread's work is done at once.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import shutil
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

from autotuner.core.recording import Sample
from autotuner.errors import StorageError
from autotuner.runtime.events import SampleTaken
from autotuner.runtime.ticker import utc_now
from autotuner.store.database import FIELDS, Database, Kept
from autotuner.store.past import PastTuning

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from autotuner.runtime.events import Event
    from autotuner.runtime.tuning import Tuning

P = ParamSpec("P")
R = TypeVar("R")

_log = logging.getLogger(__name__)

FLUSH_S = 0.5
"""Longest time that samples wait to be written, s."""
ROOM_BYTES = 64 * 1024 * 1024
"""Free space on the disk below which no tuning is started."""


class Archive:
    """What is kept of the tunings of one service.

    Parameters
    ----------
    folder : Path
        The data directory.
    in_place : bool
        Whether to work in the caller's thread: for virtual time.
    """

    def __init__(self, folder: Path, *, in_place: bool = False) -> None:
        self._folder = folder
        self._thread = None if in_place else ThreadPoolExecutor(1, "archive")
        self._database: Database | None = None
        self._keepers: dict[str, asyncio.Task[None]] = {}

    async def room(self) -> None:
        """Raise `StorageError` when there is no room for another tuning, or the database cannot be written."""
        await self._do(self._check_room)

    def keep(self, tuning: Tuning, actor: str) -> None:
        """Keep a tuning from now on, until it has ended."""
        if tuning.id not in self._keepers:
            task = asyncio.create_task(self._follow(tuning, actor), name=f"keeper-{tuning.id}")
            self._keepers[tuning.id] = task
            task.add_done_callback(lambda _: self._keepers.pop(tuning.id, None))

    async def tell(self, tuning: Tuning) -> None:
        """Keep what a tuning tells now: after gains were written, say."""
        with contextlib.suppress(StorageError):  # it has been logged
            await self._try(lambda database: database.tell(tuning.id, *_told(tuning)))

    async def note(self, actor: str, action: str, status: int) -> None:
        """Append to the audit."""
        at = utc_now()
        await self._try(lambda database: database.note(at, actor, action, status))

    async def find(self, tuning_id: str) -> PastTuning | None:
        """Return a tuning of an earlier run; None when there is none."""
        return await self._do(self._find, tuning_id)

    async def listed(self, loop: str | None, limit: int) -> list[Kept]:
        """Return tunings that are kept, the newest first."""
        return await self._do(lambda: self._opened().listed(loop, limit))

    async def audit(self, limit: int) -> list[dict[str, Any]]:
        """Return the latest entries of the audit, the newest first."""
        return await self._do(lambda: self._opened().audit(limit))

    async def close(self) -> None:
        """Write what is left, and close."""
        await asyncio.gather(*self._keepers.values(), return_exceptions=True)
        await self._do(self._close)
        if self._thread is not None:
            self._thread.shutdown()

    async def _follow(self, tuning: Tuning, actor: str) -> None:
        told, settings, outcome = _told(tuning)
        request = {name: getattr(tuning.request, name) for name in ("structure", "goal", "rule")}
        kept = Kept(tuning.id, tuning.loop, tuning.started_at, actor, request, told, settings, outcome)
        await self._try(lambda database: database.begin(kept))
        batch = _Batch()
        async for event in tuning.follow():
            batch.take(event)
            if batch.due or event.type == "ended":
                await self._try(batch.writing(tuning.id))
        await self.tell(tuning)

    async def _try(self, work: Callable[[Database], None]) -> None:
        """Write; log when that is not possible: no tuning depends on it."""
        try:
            await self._do(lambda: work(self._opened()))
        except StorageError as error:
            _log.error("not kept: %s", error)

    async def _do(self, function: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
        if self._thread is None:
            return function(*args, **kwargs)
        return await asyncio.wrap_future(self._thread.submit(function, *args, **kwargs))

    def _opened(self) -> Database:
        if self._database is None:
            self._database = Database(self._folder)
        return self._database

    def _close(self) -> None:
        if self._database is not None:
            self._database.close()
            self._database = None

    def _find(self, tuning_id: str) -> PastTuning | None:
        kept = self._opened().find(tuning_id)
        return None if kept is None else PastTuning(kept, self._opened().samples(tuning_id))

    def _check_room(self) -> None:
        self._opened()
        free = shutil.disk_usage(self._folder).free
        if free < ROOM_BYTES:
            raise StorageError(
                f"has {free / 2**20:.0f} MiB left, and a tuning is not started below {ROOM_BYTES / 2**20:.0f}",
                field=str(self._folder),
                remedy="Make room, or set service.data_directory to another disk.",
            )


class _Batch:
    """Samples and events that wait to be written."""

    def __init__(self) -> None:
        self._samples: list[Sample] = []
        self._events: list[tuple[int, dict[str, object]]] = []
        self._first = self._number = 0
        self._since_s: float | None = None
        self.due = False

    def take(self, event: Event) -> None:
        if isinstance(event, SampleTaken):
            self._samples.append(Sample(**{name: getattr(event, name) for name in FIELDS}))
        else:
            self._events.append((self._number, event.to_dict()))
        self._number += 1
        self._since_s = event.t if self._since_s is None else self._since_s
        self.due = event.t - self._since_s >= FLUSH_S

    def writing(self, tuning_id: str) -> Callable[[Database], None]:
        """Return what writes the batch, and begin the next."""
        first, samples, events = self._first, self._samples, self._events
        self._first, self._samples, self._events = first + len(samples), [], []
        self._since_s, self.due = None, False
        return lambda database: database.put(tuning_id, first, samples, events)


def _told(tuning: Tuning) -> tuple[dict[str, Any], dict[str, Any], str | None]:
    """Return what a tuning tells, the settings of its recording, and its outcome."""
    experiment = None if tuning.controller is None else tuning.controller.experiment
    settings = {} if experiment is None else experiment.settings_seen()
    return tuning.to_dict(), settings, tuning.verdict.outcome.value if tuning.verdict else None
