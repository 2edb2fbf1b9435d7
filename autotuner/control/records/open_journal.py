"""Journal of an open lease: a disturbance is recorded before it happens (`journal`)."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from dataclasses import asdict, astuple, dataclass
from typing import TYPE_CHECKING

from autotuner.control.records.device_lock import DeviceLock
from autotuner.control.records.lease_record import PROVED, UNPROVED
from autotuner.control.records.store import ENTRIES, SAMPLES, Store, row
from autotuner.control.reporting.events import PhaseChanged, SampleTaken
from autotuner.errors import StorageError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from concurrent.futures import Future
    from pathlib import Path

    from autotuner.control.records.lease_record import Before
    from autotuner.control.reporting.events import Event
    from autotuner.core.verdict import Verdict

SYNC_S = 1.0
"""Longest time between a sample and its being on the disk itself, s."""
WAIT_S = 0.05
"""Longest wait for a level beyond those before to be on the disk, s."""
SLOW_DISK_S = 1.0
"""Longest wait for a set point to be on the disk, s: it is written now and then only, not at each switch of a relay."""

_log = logging.getLogger(__name__)


class OpenJournal:
    """Record of a running operation on one loop.

    Parameters
    ----------
    store : Store
        The store, opened for this lease; closed here.
    name : str
        Name of the lease.
    lock : DeviceLock
        The device's lock, with its marker; released here.
    in_place : bool
        Whether writes wait for the disk in the caller's thread: in virtual time.
    here : set of str, optional
        The leases that are not to be taken for those of a killed program; this one leaves it at its end, but when its
        loop was restored and that could not be recorded.
    within : bool
        Whether the marker is that of another lease, of the run that this one belongs to.
    resumed : bool
        Whether it continues an interrupted lease.

    Attributes
    ----------
    name : str
        Name of the lease.
    trouble : str or None
        Why it is incomplete.
    lock : DeviceLock
        The device's.
    """

    def __init__(
        self,
        store: Store,
        name: str,
        lock: DeviceLock,
        *,
        in_place: bool = False,
        here: set[str] | None = None,
        within: bool = False,
        resumed: bool = False,
    ) -> None:
        self.trouble: str | None = None
        self.name = name
        self.lock = lock
        self.store = store
        self._here = set() if here is None else here
        self._here.add(name)
        self._in_place = in_place
        self._within = within
        self._levels: tuple[float, float] | None = None
        self._synced_s = 0.0
        self._elsewhere = self._closed = False
        self._places = self._counted() if resumed else {ENTRIES: 0, SAMPLES: 0}

    def _counted(self) -> dict[str, int]:
        with contextlib.suppress(OSError):
            return {table: self.store.count(table, self.name) for table in (ENTRIES, SAMPLES)}
        return {ENTRIES: 0, SAMPLES: 0}

    def handed(self) -> HandedJournal:
        """Leave the record to another process, until `taken_back`; how the tuning ended is still recorded here."""
        self._elsewhere = True
        return HandedJournal(self.store.path.parent, self.name, within=self._within)

    def taken_back(self, trouble: str | None = None) -> None:
        """Continue the journal of another process; `trouble` is the reason why its record is incomplete."""
        self._elsewhere = False
        self._places = self._counted()
        self.trouble = self.trouble or trouble

    async def disturb(self, before: Before) -> None:
        """Record on disk how the loop was found; raise `StorageError` on failure."""
        await self._put_safely({"before": asdict(before)})
        self._levels = (before.output, before.output) if before.set_point is None else None

    async def unproved(self) -> None:
        """Put on the disk that gains may be written that are to be undone; raise `StorageError` where that fails."""
        await self._put_safely({"gains": UNPROVED})

    async def changing(self, change: str, found: Mapping[str, float]) -> None:
        """Put on the disk which change of gains is about to be made; raise `StorageError` where that fails."""
        await self._put_safely({"gains": UNPROVED, "change": change, "found": dict(found)})

    async def _put_safely(self, entry: Mapping[str, object]) -> None:
        try:
            if self._in_place:
                self.lock.sync()
                self._submit(ENTRIES, entry, safe=True).result()
            else:
                await asyncio.to_thread(self.lock.sync)
                await asyncio.wrap_future(self._submit(ENTRIES, entry, safe=True))
        except OSError as error:
            raise storage_error(self.store.path, error) from error

    async def proved(self) -> None:
        """Record that the gains are to stay."""
        await self._put_ahead({"gains": PROVED})

    async def set_point(self, value: float) -> None:
        """Record a set point that is about to be written; raise `StorageError` as `command` does."""
        if not await self._put_ahead({"set_point": value}, SLOW_DISK_S):
            self._widen()

    async def mode(self, auto: float) -> None:
        """Record a mode that is about to be written to the device."""
        self._levels = None
        await self._put_ahead({"mode": auto})

    async def point(self, tuning: str) -> None:
        """Record a tuning that was begun at an operating point."""
        await self._put_ahead({"point": tuning})

    async def command(self, output: float) -> None:
        """Record an output that is about to be written to the device, unless it lies between those before.

        Raises
        ------
        StorageError
            It could not be recorded, and not even that there are such levels: it must not be written.
        """
        low, high = self._levels or (output, output)
        if self._levels is not None and low <= output <= high:
            return
        if not await self._put_ahead({"command": output}):
            self._widen()
        self._levels = min(low, output), max(high, output)

    def _widen(self) -> None:
        """Record in the lock's file, which needs no room, that more was written than the store holds."""
        try:
            self.lock.widen()
        except OSError as error:
            raise storage_error(self.store.path, error) from error

    async def aim(self, target: float) -> None:
        """Record the output at which the loop is about to be restored."""
        await self._put_ahead({"target": target})

    async def undone(self, at: str, was: Mapping[str, float], now: Mapping[str, float]) -> None:
        """Record that the old gains are restored."""
        await self._put_ahead({"undone": {"at": at, "was": dict(was), "now": dict(now)}})

    async def released(self, what: str) -> None:
        """Record that the loop is restored, for the program that reports it."""
        await self._put_ahead({"given_back": what})

    async def _put_ahead(self, entry: Mapping[str, object], wait_s: float = WAIT_S) -> bool:
        """Record an entry; return whether it is on the disk itself by now."""
        if self.trouble is not None:
            return False
        written = self._submit(ENTRIES, entry, safe=True)
        if not self._in_place:
            await _settled(written, wait_s)
        return written.done() and written.exception() is None

    def note(self, event: Event) -> None:
        """Record an event."""
        if self._elsewhere or self.trouble is not None:
            return
        match event:
            case SampleTaken():
                sync = event.t - self._synced_s >= SYNC_S
                self._synced_s = event.t if sync else self._synced_s
                self._submit(SAMPLES, [list(astuple(event.sample))], safe=sync)
            case PhaseChanged():
                self._submit(ENTRIES, {"t": event.t, "phase": event.phase}, safe=True)

    async def end(self, verdict: Verdict | None, *, released: bool = True) -> None:
        """Record how the lease ended, and close it.

        Once it is closed nothing more is recorded. Where the loop was not `released` only the reason is, and the next
        start continues it; without a verdict it stays as it is.
        """
        if self._closed:
            return
        ended = verdict is not None and released
        if verdict is not None and not released:
            _log.warning("lease %s stays open: the restore of its loop continues, also after the next start", self.name)
        if verdict is not None and self.trouble is None:
            written = self._submit(ENTRIES, {"ended" if ended else "left": verdict.to_dict()}, safe=True)
            if not self._in_place:
                await _settled(written)
        if self._in_place:
            self._close(ended=ended)
        else:
            await asyncio.to_thread(self._close, ended=ended)
        if not ended or self.trouble is None:
            self._here.discard(self.name)

    def _submit(self, table: str, value: object, *, safe: bool) -> Future[None]:
        place = self._places[table]
        self._places[table] += 1
        written = self.store.submit([row(table, self.name, place, value)], safe=safe)
        written.add_done_callback(self._check)
        return written

    def _check(self, written: Future[None]) -> None:
        error = written.exception()
        if isinstance(error, OSError) and self.trouble is None:
            self.trouble = f"the record {self.store.path} is incomplete: {error.strerror}"
            _log.error("%s", self.trouble)

    def _close(self, *, ended: bool) -> None:
        self._closed = True
        self.store.close()
        if ended and not self._within:
            self.lock.clear()
        self.lock.release()


@dataclass(frozen=True, slots=True)
class HandedJournal:
    """A lease in transfer to another process, which keeps its lock: the lock's files are passed with it."""

    folder: Path
    name: str
    within: bool = False

    def store(self) -> Store:
        """Return the store that it is in."""
        return Store(self.folder)

    def taken(self, file: int, machine: int | None = None) -> OpenJournal:
        """Return the lease, in the process that it was handed to, where its lock has these files."""
        store = self.store()
        store.open()
        return OpenJournal(store, self.name, DeviceLock(file, machine), within=self.within, resumed=True)


async def _settled(written: Future[None], limit_s: float | None = None) -> None:
    """Wait until rows are on the disk or could not be put there, of which `OpenJournal._check` takes note."""
    settled = asyncio.wrap_future(written)
    settled.add_done_callback(lambda future: future.cancelled() or future.exception())
    await asyncio.wait([settled], timeout=limit_s)


def storage_error(path: Path, error: OSError) -> StorageError:
    """Return a file system's error as an error of the operation."""
    return StorageError(
        f"cannot be written: {error.strerror}",
        field=str(path),
        remedy="Make room, or set service.data_directory to a folder that can be written.",
    )
