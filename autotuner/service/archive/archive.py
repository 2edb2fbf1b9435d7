"""Archive of running tunings: events are read where they are added, and written in a separate thread.

Invariants:

1. Read only: no tuning and no restore waits for the archive, or fails because of it. Failed writes are repeated. A
   write of gains waits for one try: after a kill, the result of these gains is known.
2. Events are on disk after `PERIOD_S` and one transaction: a killed service loses the samples of less than a second.
3. A start first checks for free space, and is refused without it.
4. In place (in virtual time) the thread's work runs synchronously, and less often.
5. The database's library is loaded with the first use of the database, before any tuning starts (invariant 3): the
   library for other databases than a file is large.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import shutil
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, ParamSpec, Protocol, TypeVar

from autotuner.errors import StorageError
from autotuner.service.archive.archive_record import DONE, FAILED, Deed
from autotuner.service.archive.archived_tuning import ArchivedTuning
from autotuner.service.archive.archiver import Archiver

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Sequence
    from pathlib import Path

    from autotuner.application.interrupted_runs import RecoveredLoop
    from autotuner.application.tuning_run import TuningRun
    from autotuner.service.archive.archive_record import News, Summary
    from autotuner.service.archive.retention import Retention
    from autotuner.service.archive.storage.database import Database

P = ParamSpec("P")
R = TypeVar("R")

_log = logging.getLogger(__name__)

PERIOD_S = 0.4
"""Time between two collections of news, s."""
IN_PLACE_PERIOD_S = 600.0
"""The same in virtual time, where a transaction costs more than the time that passes."""
BY_ITSELF = "service"
"""Actor of unrequested actions: the recovery of a loop that a killed program left disturbed."""
ROOM_BYTES = 64 * 1024 * 1024
"""Free space on the disk below which no tuning is started."""


class Source(Protocol):
    """Source of the tunings."""

    @property
    def tunings(self) -> dict[str, TuningRun]:
        """Tunings in memory, by identifier."""

    @property
    def busy(self) -> bool:
        """Whether any of them holds its loop, or a loop of a killed program is still to be released."""

    @property
    def recovered_loops(self) -> Sequence[RecoveredLoop]:
        """The loops that killed programs left disturbed; only appended to."""


class Archive:
    """Archive of the tunings of one service.

    Parameters
    ----------
    database_url : str or None
        The database; None for a file in the data directory.
    folder : Path
        The data directory; made when needed.
    retention : Retention
        How much is kept.
    in_place : bool
        Whether to work in the caller's thread: for virtual time.

    Raises
    ------
    ConfigurationError
        The database's driver is not installed.

    Attributes
    ----------
    trouble : StorageError or None
        Why the latest that happened is not written.
    """

    def __init__(self, database_url: str | None, folder: Path, retention: Retention, *, in_place: bool = False) -> None:
        if database_url is not None:
            _check_address(folder, database_url)
        self.trouble: StorageError | None = None
        self._database_url, self._folder, self._retention = database_url, folder, retention
        self._in_place = in_place
        self._writer, self._reader = (None if in_place else ThreadPoolExecutor(1, name) for name in ("archive", "past"))
        self._database: Database | None = None
        self._opening = threading.Lock()
        self._source: Source | None = None
        self._keepers: dict[str, Archiver] = {}
        self._awake = asyncio.Event()
        self._task: asyncio.Task[None] | None = None
        self._turn = asyncio.Lock()
        self._reported_restores = 0

    def open(self, source: Source) -> None:
        """Keep the tunings of a source from now on."""
        self._source = source
        self._task = asyncio.create_task(self._keep_up(), name="archive")

    async def room(self) -> None:
        """Raise `StorageError` without space for another tuning, or when the database cannot be written."""
        await self._do(self._writer, self._check_room)

    async def is_usable(self) -> bool:
        """Return whether a start would find room, and the latest that happened is written: as `/readyz` reports it."""
        try:
            await self.room()
        except StorageError:
            return False
        return self.trouble is None

    async def note(self, action: Deed) -> None:
        """Append to the audit, and collect the news soon; a failure is logged."""
        self._awake.set()
        try:
            await self._do(self._writer, lambda: self._opened().note(action))
        except StorageError as error:
            _log.error("not in the audit: %s by %s (%d): %s", action.action, action.actor, action.status, error)

    async def find(self, tuning_id: str) -> ArchivedTuning | None:
        """Return an archived tuning; None when there is none."""
        kept = await self._do(self._reader, lambda: self._opened().find(tuning_id))
        return None if kept is None else ArchivedTuning(kept)

    async def listed(self, loop: str | None, limit: int, without: Collection[str]) -> list[Summary]:
        """Return tunings that are kept, `without` those, the newest first."""
        return await self._do(self._reader, lambda: self._opened().listed(loop, limit, without))

    def number_of(self, tuning_id: str) -> int | None:
        """Return the number of a tuning in memory among all that were kept; None while it is not kept."""
        archiver = self._keepers.get(tuning_id)
        return None if archiver is None else archiver.number

    async def gains(self, tuning_id: str) -> list[dict[str, Any]]:
        """Return the changes of gains of a tuning, the oldest first."""
        return await self._do(self._reader, lambda: self._opened().gains(tuning_id))

    async def audit(
        self, limit: int, before: int | None = None, loop: str | None = None, actor: str | None = None
    ) -> list[dict[str, Any]]:
        """Return entries of the audit, the newest first; see `Database.audit`."""
        return await self._do(self._reader, lambda: self._opened().audit(limit, before, loop, actor))

    async def flush(self) -> None:
        """Write all that has happened; a failure is logged, and reported by `trouble`."""
        async with self._turn:
            await self._round()

    async def close(self) -> None:
        """Write the remaining news, and close; may be repeated."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
            self._task = None
            await self.flush()
        for thread in (self._reader, self._writer):
            if thread is not None:
                thread.shutdown()
        self._writer = self._reader = None
        self._close()

    async def _keep_up(self) -> None:
        period_s = IN_PLACE_PERIOD_S if self._in_place else PERIOD_S
        while True:
            self._awake.clear()
            more = await self._looked_at_something()
            await (asyncio.sleep(period_s) if more else self._awake.wait())

    async def _looked_at_something(self) -> bool:
        """Write new events; return whether more are expected."""
        assert self._source is not None  # noqa: S101 - opened
        busy = self._source.busy
        await self.flush()
        return busy or self.trouble is not None

    async def _round(self) -> None:
        archivers = self._present()
        try:
            reported = await self._do(self._writer, self._write, archivers)
        except StorageError as error:
            self._note_trouble(error)
            return
        except Exception as error:  # noqa: BLE001 - whatever it was, the next look must come
            _log.exception("events could not be archived")
            self._note_trouble(_unusable(self._folder, f"{type(error).__name__} in this program"))
            return
        self._note_trouble(None)
        if any(news.reported is not None and news.reported.outcome for news in reported):
            await self._tidy()

    def _present(self) -> list[Archiver]:
        """Return the archivers of the tunings in memory."""
        present = list(self._source.tunings.values()) if self._source else []
        for tuning in present:
            known = self._keepers.get(tuning.id)
            if known is None or known.tuning is not tuning:  # taken over again, to release its loop
                self._keepers[tuning.id] = Archiver(tuning)
        ids = {tuning.id for tuning in present}
        self._keepers = {key: archiver for key, archiver in self._keepers.items() if key in ids}
        return list(self._keepers.values())

    def _write(self, archivers: Sequence[Archiver]) -> list[News]:
        for archiver in archivers:
            if archiver.number is None:
                archiver.go_on(self._opened().begin(archiver.head))
        self._note_recovered()
        reported = [(archiver, news) for archiver in archivers if (news := archiver.news()) is not None]
        if reported:
            self._opened().write([news for _, news in reported])
        for archiver, _ in reported:
            archiver.written()
        return [news for _, news in reported]

    def _note_recovered(self) -> None:
        """Record actions of the service itself in the audit."""
        new = list(self._source.recovered_loops)[self._reported_restores :] if self._source else []
        for one in new:
            action = f"{one.kind} {'recovered' if one.done else 'could not be recovered'} {one.after}"
            deed = Deed(one.at, BY_ITSELF, action, DONE if one.done else FAILED, one.loop, one.id)
            self._opened().note(deed)
            self._reported_restores += 1

    async def _tidy(self) -> None:
        present = list(self._source.tunings.values()) if self._source else []  # in one step: others are begun meanwhile
        running = {tuning.id for tuning in present if not tuning.ended}
        with contextlib.suppress(StorageError):  # it is tried again at the end of the next tuning
            await self._do(self._writer, self._forget, running)

    def _forget(self, running: Collection[str]) -> None:
        gone = self._retention.surplus(self._opened().sizes(), running)
        if gone:
            self._opened().forget(gone)
            _log.info("%d tunings are no longer kept: service.keep_tunings, service.keep_bytes", len(gone))

    def _note_trouble(self, trouble: StorageError | None) -> None:
        """Log a changed error, not each repetition."""
        if trouble is not None and (self.trouble is None or str(trouble) != str(self.trouble)):
            _log.error("tunings are not kept now: %s", trouble)
        if trouble is None and self.trouble is not None:
            _log.info("tunings are kept again")
        self.trouble = trouble

    async def _do(
        self, thread: ThreadPoolExecutor | None, function: Callable[P, R], *args: P.args, **kwargs: P.kwargs
    ) -> R:
        if thread is None:
            return function(*args, **kwargs)
        return await asyncio.wrap_future(thread.submit(function, *args, **kwargs))

    def _opened(self) -> Database:
        with self._opening:
            if self._database is None:
                try:
                    self._folder.mkdir(parents=True, exist_ok=True)
                except OSError as error:
                    raise _unusable(self._folder, str(error.strerror)) from error
                self._database = _open(self._folder, self._database_url, durable=not self._in_place)
            return self._database

    def _close(self) -> None:
        if self._database is not None:
            self._database.close()
            self._database = None

    def _check_room(self) -> None:
        self._opened().probe()
        free = shutil.disk_usage(self._folder).free
        if free < ROOM_BYTES:
            needed = f"a tuning is not started below {ROOM_BYTES / 2**20:.0f}"
            raise _unusable(self._folder, f"{free / 2**20:.0f} MiB are left on that disk, and {needed}")


def _check_address(folder: Path, given: str) -> None:
    """Raise `ConfigurationError` for an invalid address or a missing driver; nothing is connected."""
    from autotuner.service.archive.storage.database_address import address_of, opened  # noqa: PLC0415 - rule 5

    opened(address_of(folder, given)).close()


def _open(folder: Path, given: str | None, *, durable: bool) -> Database:
    from autotuner.service.archive.storage.database import Database  # noqa: PLC0415
    from autotuner.service.archive.storage.database_address import address_of  # noqa: PLC0415 - rule 5

    return Database(address_of(folder, given), durable=durable)


def _unusable(folder: Path, why: str) -> StorageError:
    return StorageError(
        f"cannot be used: {why}",
        field=str(folder),
        remedy="Make room, or set service.data_directory to a folder that can be written.",
    )
