"""The journal: what is disturbed stands on disk before it is disturbed, so that a killed program can make it good.

A tuning has one, a verification, a run over operating points, and a change of gains.

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

import contextlib
import logging
import os
import secrets
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from autotuner.errors import LoopBusyError
from autotuner.runtime import device_lock
from autotuner.runtime.journal_file import INTERRUPTED, VERSION, Kind, last_entry, line, read_journal, whole_bytes
from autotuner.runtime.open_journal import OpenJournal, storage_error
from autotuner.runtime.whole_file import clear_unfinished, write_whole

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from autotuner.runtime.journal_file import Kept

KEPT = 200
"""Ended journals that are kept; the oldest go first."""
APPEND = os.O_WRONLY | os.O_CREAT | os.O_APPEND | getattr(os, "O_BINARY", 0)

_log = logging.getLogger(__name__)


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
            self.tidy()
            write_whole(path, line({"journal": VERSION, **head}))

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

    def tidy(self) -> None:
        """Take away what killed programs, or a full disk, have left of files that were never whole."""
        for folder in (self.folder, self._files):
            clear_unfinished(folder)

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
            raise storage_error(path, error) from error
        return journal

    def _forget_oldest(self) -> None:
        ended = [path for path in self._paths() if "ended" in _last(path)]
        for path in ended[:-KEPT]:
            with contextlib.suppress(OSError):
                path.unlink()


def _name(head: Mapping[str, object]) -> str:
    """Return the name of a journal; a verification has one beside that of its tuning, each change of gains its own."""
    kind = head.get("kind", Kind.TUNING)
    beside = {Kind.VERIFICATION: f".{kind}", Kind.GAINS: f".{kind}-{secrets.token_hex(4)}"}
    return f"{head['tuning']}{beside.get(Kind(str(kind)), '')}"


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
