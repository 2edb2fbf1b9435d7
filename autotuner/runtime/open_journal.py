"""A journal that is open: what is disturbed is written ahead, in threads of its own (`autotuner.runtime.journal`)."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from autotuner.errors import StorageError
from autotuner.runtime.device_lock import DeviceLock
from autotuner.runtime.events import PhaseChanged, SampleTaken
from autotuner.runtime.journal_file import PROVED, UNPROVED, line, sample_entry
from autotuner.runtime.shared_file import SharedFile

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from autotuner.core.verdict import Verdict
    from autotuner.runtime.events import Event
    from autotuner.runtime.restore import Before

SYNC_S = 1.0
"""Longest time between a sample and its being on the disk itself, s."""
WAIT_S = 0.05
"""Longest wait for the operating system to take an output that is about to be written, s."""

_log = logging.getLogger(__name__)


class OpenJournal:
    """The journal of what is going on on one loop.

    Parameters
    ----------
    path : Path
        The file.
    file : int
        Its descriptor, opened for appending; closed here.
    lock : DeviceLock
        The device's lock; released here.
    in_place : bool
        Whether to wait for the disk where it is asked for, instead of leaving the event loop to others meanwhile: in
        virtual time, where waiting for a real disk has no meaning.
    here : set of Path, optional
        The journals that are not to be taken for those of a killed program; this one leaves it at its end, but when its
        loop was given back and that could not be marked.

    Attributes
    ----------
    path : Path
        The file.
    trouble : str or None
        Why it is incomplete.
    lock : DeviceLock
        The device's.
    """

    def __init__(
        self, path: Path, file: int, lock: DeviceLock, *, in_place: bool = False, here: set[Path] | None = None
    ) -> None:
        self.trouble: str | None = None
        self.path = path
        self._here = set() if here is None else here
        self._here.add(path)
        self._file = file
        self.lock = lock
        self._in_place = in_place
        self._thread, self._syncer = ThreadPoolExecutor(1, "journal"), ThreadPoolExecutor(1, "journal-sync")
        self._synced_s = 0.0
        self._elsewhere = False

    def handed(self) -> HandedJournal:
        """Leave the notes to another process, until `taken_back`; how the tuning ended is still told here."""
        self._elsewhere = True
        return HandedJournal(self.path, SharedFile(self._file), SharedFile(self.lock.file))

    def taken_back(self, trouble: str | None = None) -> None:
        """Go on where the other process left off; `trouble` is why what it wrote is incomplete."""
        self._elsewhere = False
        self.trouble = self.trouble or trouble

    async def disturb(self, before: Before) -> None:
        """Put on the disk how the loop was found; raise `StorageError` when that cannot be done."""
        await self._put_safely({"before": asdict(before)})

    async def unproved(self) -> None:
        """Put on the disk that gains may be written that are to go back; raise `StorageError` where that fails."""
        await self._put_safely({"gains": UNPROVED})

    async def changing(self, change: str, found: Mapping[str, float]) -> None:
        """Put on the disk which change of gains is about to be made; raise `StorageError` where that fails."""
        await self._put_safely({"gains": UNPROVED, "change": change, "found": dict(found)})

    async def _put_safely(self, entry: dict[str, object]) -> None:
        try:
            await self._done(self._put_before, line(entry))
        except OSError as error:
            raise storage_error(self.path, error) from error

    async def proved(self) -> None:
        """Take note that the gains are to stay."""
        await self._put_ahead({"gains": PROVED}, sync=True)

    async def set_point(self, value: float) -> None:
        """Take note of a set point that is about to be written to the device."""
        await self._put_ahead({"set_point": value}, sync=True)

    async def mode(self, auto: float) -> None:
        """Take note of a mode that is about to be written to the device."""
        await self._put_ahead({"mode": auto}, sync=True)

    async def point(self, tuning: str) -> None:
        """Take note of a tuning that was begun at an operating point."""
        await self._put_ahead({"point": tuning})

    async def command(self, output: float) -> None:
        """Take note of an output that is about to be written to the device."""
        await self._put_ahead({"command": output})

    async def aim(self, target: float) -> None:
        """Take note of the output at which the loop is about to be given back."""
        await self._put_ahead({"target": target})

    async def undone(self, at: str, was: Mapping[str, float], now: Mapping[str, float]) -> None:
        """Take note that the old gains are back."""
        await self._put_ahead({"undone": {"at": at, "was": dict(was), "now": dict(now)}}, sync=True)

    async def given_back(self, what: str) -> None:
        """Take note that the loop is back, for whoever tells it."""
        await self._put_ahead({"given_back": what}, sync=True)

    async def _put_ahead(self, entry: dict[str, object], *, sync: bool = False) -> None:
        written = self._thread.submit(self._try_to_put, line(entry), sync=sync)
        if self._in_place:
            with contextlib.suppress(TimeoutError):
                written.result(WAIT_S)
        else:
            await asyncio.wait([asyncio.wrap_future(written)], timeout=WAIT_S)

    def note(self, event: Event) -> None:
        """Take note of what happened."""
        if self._elsewhere:
            return
        match event:
            case SampleTaken():
                sync = event.t - self._synced_s >= SYNC_S
                self._synced_s = event.t if sync else self._synced_s
                self._thread.submit(self._try_to_put, line(sample_entry(event.sample)), sync=sync)
            case PhaseChanged():
                self._thread.submit(self._try_to_put, line({"t": event.t, "phase": event.phase}), sync=True)

    async def end(self, verdict: Verdict | None, *, given_back: bool = True) -> None:
        """Mark the journal as ended, and close it.

        Where the loop was not `given_back` it only tells why, and the next start goes on with it; without a verdict it
        stays as it is.
        """
        ended = verdict is not None and given_back
        if verdict is not None and not given_back:
            _log.warning("the journal %s stays for the next start, which goes on giving the loop back", self.path)
        if verdict is not None:
            self._thread.submit(self._try_to_put, line({"ended" if ended else "left": verdict.to_dict()}), sync=True)
        await self._done(self._close, ended)
        self._thread.shutdown()
        if not ended or self.trouble is None:
            self._here.discard(self.path)

    async def _done(self, function: Callable[..., None], *args: object) -> None:
        work: Future[None] = self._thread.submit(function, *args)
        if self._in_place:
            work.result()
        else:
            await asyncio.wrap_future(work)

    def _put_before(self, text: bytes) -> None:
        os.write(self._file, text)
        os.fsync(self._file)
        if hasattr(os, "O_DIRECTORY"):  # that the file is there at all must outlive a loss of power too
            folder = os.open(self.path.parent, os.O_RDONLY | os.O_DIRECTORY)
            os.fsync(folder)
            os.close(folder)

    def _try_to_put(self, text: bytes, *, sync: bool = False) -> None:
        if self.trouble is not None:
            return
        try:
            os.write(self._file, text)
        except OSError as error:
            self._tell(error)
        else:
            if sync:
                self._syncer.submit(self._try_to_sync)

    def _try_to_sync(self) -> None:
        try:
            os.fsync(self._file)
        except OSError as error:
            self._tell(error)

    def _tell(self, error: OSError) -> None:
        self.trouble = f"the journal {self.path} is incomplete: {error.strerror}"
        _log.error("%s", self.trouble)

    def _close(self, given_back: bool) -> None:  # noqa: FBT001 - is passed through a queue
        self._syncer.shutdown()  # what it has begun is done
        if given_back and self.trouble is not None:
            with contextlib.suppress(OSError):
                self.path.unlink()
        os.close(self._file)
        self.lock.release()


@dataclass(frozen=True, slots=True)
class HandedJournal:
    """A journal on its way to another process, where the device stays locked as long as that process lives."""

    path: Path
    file: SharedFile
    lock: SharedFile

    def taken(self) -> OpenJournal:
        """Return the journal, in the process that it was handed to."""
        return OpenJournal(self.path, self.file.number, DeviceLock(self.lock.number))


def storage_error(path: Path, error: OSError) -> StorageError:
    """Return what a file system's error means for whoever wanted to move something."""
    return StorageError(
        f"cannot be written: {error.strerror}",
        field=str(path),
        remedy="Make room, or set service.data_directory to a folder that can be written.",
    )
