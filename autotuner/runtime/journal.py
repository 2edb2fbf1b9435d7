"""The journal: what is disturbed stands on disk before it is disturbed, so that a killed program can make it good.

A tuning has one, a verification, and a run over operating points.

Rules of this file:

1. Before the first write, how the loop was found is on the disk itself (fsync). Before each further write,
   its output is with the operating system, which keeps it when the program is killed; samples follow at once and go to
   the disk every `SYNC_S`.
2. The control loop does not wait for the disk: each journal has a thread that writes, and only a new output waits for
   it, `WAIT_S` at most; other loops are served meanwhile. Another thread waits for the disk itself: what is written
   does not queue up behind that, where a kill would lose it.
3. A disk that fails refuses a new tuning; a running one, and a restore, go on without their journal. One that could
   not be marked as ended goes when its loop has been given back: it would have the next start do that again.
4. One device, one tuning: a lock that dies with its process keeps two programs from moving the same output, and tells
   an interrupted tuning from one that runs elsewhere. A run over operating points shares its lock with its tunings.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING

from autotuner.errors import LoopBusyError, StorageError
from autotuner.runtime import device_lock
from autotuner.runtime.device_lock import DeviceLock
from autotuner.runtime.events import PhaseChanged, SampleTaken
from autotuner.runtime.journal_file import (
    INTERRUPTED,
    PROVED,
    UNPROVED,
    VERSION,
    Kind,
    last_entry,
    line,
    read_journal,
    sample_entry,
    whole_bytes,
)
from autotuner.runtime.shared_file import SharedFile

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from autotuner.core.verdict import Verdict
    from autotuner.runtime.events import Event
    from autotuner.runtime.journal_file import Kept
    from autotuner.runtime.restore import Before

SYNC_S = 1.0
"""Longest time between a sample and its being on the disk itself, s."""
WAIT_S = 0.05
"""Longest wait for the operating system to take an output that is about to be written, s."""
KEPT = 200
"""Ended journals that are kept; the oldest go first."""
APPEND = os.O_WRONLY | os.O_CREAT | os.O_APPEND | getattr(os, "O_BINARY", 0)

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

    async def _put_safely(self, entry: dict[str, object]) -> None:
        try:
            await self._done(self._put_before, line(entry))
        except OSError as error:
            raise _storage_error(self.path, error) from error

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

    async def end(self, verdict: Verdict | None) -> None:
        """Mark the journal as ended, unless the loop was not given back (None), and close it."""
        if verdict is not None:
            self._thread.submit(self._try_to_put, line({"ended": verdict.to_dict()}), sync=True)
        await self._done(self._close, verdict is not None)
        self._thread.shutdown()
        if verdict is None or self.trouble is None:
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


@dataclass(frozen=True, slots=True)
class Journal:
    """The journals of one data directory.

    Attributes
    ----------
    folder : Path
        The data directory; made when first needed.
    in_place : bool
        See `OpenJournal`.
    """

    folder: Path
    in_place: bool = False
    _here: set[Path] = field(default_factory=set, repr=False, compare=False)

    def begin(self, head: Mapping[str, str | object], within: OpenJournal | None = None) -> OpenJournal:
        """Begin a journal; `head` has the fields of its first line, `within` is that of the run that it belongs to.

        Raises
        ------
        StorageError
            The data directory cannot be written.
        LoopBusyError
            Another tuning is moving the same device.
        """
        path = self._files / f"{_name(head)}.jsonl"

        def write_head() -> None:
            self._forget_oldest()
            path.parent.mkdir(parents=True, exist_ok=True)
            beginning = path.with_suffix(".new")
            beginning.write_bytes(line({"journal": VERSION, **head}))
            beginning.replace(path)

        return self._opened(path, head, write_head, within)

    def resume(self, kept: Kept) -> OpenJournal:
        """Go on with an interrupted journal, as far as the disk allows.

        Raises
        ------
        StorageError
            Its files cannot be opened at all.
        LoopBusyError
            It was not interrupted: its tuning runs in another program.
        """

        def drop_torn_line() -> None:
            with contextlib.suppress(OSError):  # a full disk must not keep a loop from being restored
                os.truncate(kept.path, whole_bytes(kept.path))

        return self._opened(
            kept.path, {"tuning": kept.tuning, "loop": kept.loop, "device": kept.device}, drop_torn_line
        )

    def interrupted(self, loop: str | None = None) -> list[Kept]:
        """Return what the journals tell, of one loop or of all, that have no end; the oldest first.

        One that runs in another program is among them; `resume` tells.
        """
        kept = [_read(path) for path in self._paths() if "ended" not in _last(path)]
        return [tuning for tuning in kept if tuning is not None and loop in {None, tuning.loop}]

    def left(self, loop: str | None = None) -> list[Kept]:
        """Return those of `interrupted` that this program neither runs nor has ended; what was in a run before it."""
        left = [kept for kept in self.interrupted(loop) if kept.path not in self._here]
        return sorted(left, key=lambda kept: kept.kind is Kind.SCHEDULE)

    def is_held(self, kept: Kept) -> bool:
        """Return whether somebody moves its device now."""
        with contextlib.suppress(OSError):
            lock = device_lock.acquire(self.folder / "locks" / kept.device, kept.tuning)
            if lock is None:
                return True
            lock.release()
        return False

    def again(self, kept: Kept) -> Kept:
        """Return what a journal tells now that it is held: another program may have gone on with it until then."""
        return _read(kept.path) or kept

    def of_tuning(self, tuning: str) -> Kept | None:
        """Return what the journal of a tuning tells; None where there is none."""
        path = self._files / f"{tuning}.jsonl"
        return _read(path) if path.exists() else None

    def made_good(self) -> list[Kept]:
        """Return what was interrupted and whose loop was given back later; the oldest first."""
        kept = [_read(path) for path in self._paths() if _last(path).get("ended", {}).get("code") == INTERRUPTED]
        return [tuning for tuning in kept if tuning is not None]

    @property
    def _files(self) -> Path:
        return self.folder / "journal"

    def _paths(self) -> list[Path]:
        try:
            return sorted(self._files.glob("*.jsonl"), key=lambda path: path.stat().st_mtime)
        except OSError:
            _log.exception("the journals in %s cannot be listed", self._files)
            return []

    def _opened(
        self,
        path: Path,
        head: Mapping[str, object],
        prepare: Callable[[], None],
        within: OpenJournal | None = None,
    ) -> OpenJournal:
        at = self.folder / "locks" / str(head["device"])
        try:
            lock = within.lock.shared() if within else device_lock.acquire(at, str(head["tuning"]))
            if lock is None:
                raise LoopBusyError(str(head["loop"]), device_lock.holder(at))
            with contextlib.ExitStack() as undo:
                undo.callback(lock.release)
                prepare()
                file = os.open(path, APPEND, 0o644)
                journal = OpenJournal(path, file, lock, in_place=self.in_place, here=self._here)
                undo.pop_all()
        except OSError as error:
            raise _storage_error(path, error) from error
        return journal

    def _forget_oldest(self) -> None:
        ended = [path for path in self._paths() if "ended" in _last(path)]
        for path in ended[:-KEPT]:
            with contextlib.suppress(OSError):
                path.unlink()


def _name(head: Mapping[str, object]) -> str:
    """Return the name of a journal; a verification has one beside that of its tuning."""
    kind = head.get("kind", Kind.TUNING)
    return f"{head['tuning']}.{kind}" if kind == Kind.VERIFICATION else str(head["tuning"])


def _read(path: Path) -> Kept | None:
    try:
        return read_journal(path)
    except (OSError, ValueError, KeyError):
        _log.exception("the journal %s cannot be read", path)
        return None


def _last(path: Path) -> Mapping[str, dict[str, object]]:
    try:
        return last_entry(path)
    except (OSError, ValueError):
        return {}


def _storage_error(path: Path, error: OSError) -> StorageError:
    return StorageError(
        f"cannot be written: {error.strerror}",
        field=str(path),
        remedy="Make room, or set service.data_directory to a folder that can be written.",
    )
