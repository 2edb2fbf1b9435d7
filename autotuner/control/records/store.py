"""The durable store of a data directory: leases, samples and changes of gains, in one SQLite file.

    leases     a row for each lease: its kind, and its request
    entries    entries for a recovery, in order: found values, levels, targets, end
    samples    the recording; one row holds the samples of one commit
    changes    changes of gains that can be rolled back

Invariants:

1. Each row carries a checksum over its content, its owner and its place. A row that does not match is never used.
2. A `safe` commit is on the disk itself when it returns (synchronous=FULL); any other one is with the operating system,
   which keeps it when the program is killed.
3. A file that SQLite cannot read is set aside under another name, and a new one is begun: damage never keeps a program
   from starting. The markers of `autotuner.control.records.device_lock` still name what was disturbed.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import logging
import os
import sqlite3
import subprocess
import sys
import tempfile
import threading
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from autotuner.control.clock.ticker import utc_now
from autotuner.core.jsonable import jsonable

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

SCHEMA = 1
"""Version of the tables; part of each checksum, so that a row of another version is never used."""
UNREADABLE = (sqlite3.Error, UnicodeDecodeError)
"""Exceptions of SQLite; the second one where a damaged message cannot be decoded."""
BUSY_S = 2.0
"""Longest wait for another program that is writing to the same file, s."""
MEMORY = Path("/dev/shm")  # noqa: S108 - the copies are in a folder of their own there
"""Folder for a copy of a file that a full disk cannot open."""
COPYING = "import shutil, sys; shutil.copyfile(*sys.argv[1:])"
LEASES, ENTRIES, SAMPLES, CHANGES = "leases", "entries", "samples", "changes"
TABLES = (LEASES, ENTRIES, SAMPLES, CHANGES)

_log = logging.getLogger(__name__)


class Row(NamedTuple):
    """A row: the lease (or loop) that owns it, its place among the rows of that owner, and its JSON text."""

    table: str
    owner: str
    place: int
    body: str

    @property
    def checksum(self) -> str:
        """The checksum of its content and place."""
        text = f"{SCHEMA}\n{self.table}\n{self.owner}\n{self.place}\n{self.body}"
        return hashlib.sha256(text.encode()).hexdigest()


def row(table: str, owner: str, place: int, value: object) -> Row:
    """Return the row of a JSON-ready value."""
    return Row(table, owner, place, json.dumps(jsonable(value), allow_nan=False))


class Rows(NamedTuple):
    """The readable values of an owner in their order, and whether any row is damaged or missing between them."""

    values: list[Any]
    damaged: bool


class StoreError(OSError):
    """The store could not be read or written."""

    def __init__(self, error: Exception) -> None:
        super().__init__(errno.EIO, str(error))


class Store:
    """The store of one data directory; the file is made when first written.

    Parameters
    ----------
    folder : Path
        The data directory.
    in_place : bool
        Whether to write in the caller's thread: in virtual time, where waiting for a real disk has no meaning.
    """

    def __init__(self, folder: Path, *, in_place: bool = False) -> None:
        self.path = folder / "state.sqlite3"
        self._in_place = in_place
        self._users = 0
        self._process = 0
        self._connection: sqlite3.Connection | None = None
        self._thread: ThreadPoolExecutor | None = None
        self._pending: list[tuple[Sequence[Row], bool, Future[None]]] = []
        self._gate, self._lifecycle = threading.Lock(), threading.Lock()

    def open(self) -> None:
        """Open the store for writing; each call is to be followed by one of `close`."""
        if self._process != os.getpid():  # a forked process has neither the threads nor the locks of its parent
            self._connection, self._thread, self._users, self._pending = None, None, 0, []
            self._gate, self._lifecycle, self._process = threading.Lock(), threading.Lock(), os.getpid()
        with self._lifecycle:  # a last user that closes in another thread takes the connection along
            if self._connection is None:
                with _as_os_error():
                    self._connection = self.connect()
            if self._thread is None and not self._in_place:
                self._thread = ThreadPoolExecutor(1, "store")
            self._users += 1

    def close(self) -> None:
        """Close it after its last user; pending rows are written first."""
        with self._lifecycle:
            self._users -= 1
            if self._users > 0:
                return
            thread, self._thread = self._thread, None
            if thread is not None:
                thread.shutdown()
            connection, self._connection = self._connection, None
            if connection is not None:
                with contextlib.suppress(sqlite3.Error):
                    connection.close()

    def submit(self, rows: Sequence[Row], *, safe: bool = False) -> Future[None]:
        """Write rows as one commit, `safe` to the disk itself; the result is None, or an `OSError`."""
        done: Future[None] = Future()
        with self._gate:
            self._pending.append((rows, safe, done))
        if self._thread is None:
            self._flush()
        else:
            self._thread.submit(self._flush)
        return done

    def _flush(self) -> None:
        """Commit all that waits at once: under load one commit carries the rows of many loops."""
        with self._gate:
            pending, self._pending = self._pending, []
        if not pending:
            return
        try:
            with _as_os_error():
                self._commit([one for rows, _, _ in pending for one in rows], safe=any(safe for _, safe, _ in pending))
        except OSError as error:
            for _, _, done in pending:
                done.set_exception(error)
        else:
            for _, _, done in pending:
                done.set_result(None)

    def _commit(self, rows: Iterable[Row], *, safe: bool) -> None:
        connection = self._connection
        if connection is None:
            raise sqlite3.OperationalError("the store is closed")
        connection.execute(f"PRAGMA synchronous={'FULL' if safe else 'NORMAL'}")
        connection.execute("BEGIN IMMEDIATE")
        try:
            for one in rows:
                connection.execute(
                    f"INSERT OR REPLACE INTO {one.table} VALUES (?, ?, ?, ?)",  # noqa: S608 - one of four constants
                    (one.owner, one.place, one.body, one.checksum),
                )
            connection.execute("COMMIT")
        except UNREADABLE:
            with contextlib.suppress(*UNREADABLE):
                connection.execute("ROLLBACK")
            raise

    def delete(self, owners: Iterable[str]) -> None:
        """Delete all rows of some leases; log rows that cannot be deleted."""
        with contextlib.suppress(OSError), self._reading() as connection, _as_os_error():
            if connection is not None:
                for owner in owners:
                    for table in (LEASES, ENTRIES, SAMPLES):
                        connection.execute(f"DELETE FROM {table} WHERE owner = ?", (owner,))  # noqa: S608

    def owners(self, table: str = LEASES) -> list[str]:
        """Return the owners that a table has rows of, the oldest first; raise `OSError` when it cannot be read."""
        found = self._select(f"SELECT owner FROM {table} GROUP BY owner ORDER BY MIN(rowid)", ())  # noqa: S608
        return [owner for (owner,) in found if isinstance(owner, str)]

    def rows(self, table: str, owner: str) -> Rows:
        """Return the values of an owner; raise `OSError` when the file cannot be read."""
        found = self._select(
            f"SELECT place, body, checksum FROM {table} WHERE owner = ? ORDER BY place",  # noqa: S608
            (owner,),
        )
        values, damaged = [], False
        for expected, (place, body, checksum) in enumerate(found):
            value = _checked(table, owner, place, body, checksum)
            if value is None:
                _log.error("row %s of %s %s in %s is damaged: it is not used", place, table, owner, self.path)
            damaged = damaged or value is None or place != expected
            values += [] if value is None else [value]
        return Rows(values, damaged)

    def last_entries(self) -> dict[str, Mapping[str, Any]]:
        """Return the last entry of each lease that has one; empty where it cannot be read."""
        found = self._select(
            "SELECT owner, MAX(place), body, checksum FROM entries GROUP BY owner",
            (),  # the row of that place
        )
        last = {owner: _checked(ENTRIES, owner, *stored) for owner, *stored in found}
        return {owner: value if isinstance(value, dict) else {} for owner, value in last.items()}

    def count(self, table: str, owner: str) -> int:
        """Return the place after the last row of an owner."""
        ((last,),) = self._select(f"SELECT MAX(place) FROM {table} WHERE owner = ?", (owner,)) or [(None,)]  # noqa: S608
        return last + 1 if isinstance(last, int) else 0

    def _select(self, query: str, values: tuple[object, ...]) -> list[tuple[Any, ...]]:
        with self._reading() as connection:
            if connection is None:
                return []
            with _as_os_error():
                return connection.execute(query, values).fetchall()

    @contextlib.contextmanager
    def _reading(self) -> Iterator[sqlite3.Connection | None]:
        """Open a new connection; None where there is no file yet."""
        with contextlib.ExitStack() as undo:
            if not self.path.exists():
                yield None
                return
            try:
                with _as_os_error():
                    connection = self.connect()
            except OSError:  # a disk that is full or read-only has no room for the shared memory of SQLite
                copies = undo.enter_context(tempfile.TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None))
                with _as_os_error():
                    connection = self._copied(Path(copies))
            undo.callback(connection.close)
            yield connection

    def _copied(self, folder: Path) -> sqlite3.Connection:
        """Return a connection to a copy of the file and its log; `_make_private` has why another process copies."""
        for suffix in ("", "-wal"):
            beside = self.path.with_name(self.path.name + suffix)
            if beside.exists():
                subprocess.run([sys.executable, "-c", COPYING, beside, folder / beside.name], check=False)  # noqa: S603
        return Store(folder).connect()

    def connect(self) -> sqlite3.Connection:
        """Return a new connection; raise `sqlite3.Error` where the file cannot be opened."""
        try:
            return self._connected()
        except UNREADABLE as error:
            if isinstance(error, sqlite3.OperationalError):  # it is busy, or cannot be written: it is not damaged
                raise
            self._set_aside(error)
            return self._connected()

    def _connected(self) -> sqlite3.Connection:
        self.path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        self._make_private()
        connection = sqlite3.connect(self.path, timeout=BUSY_S, isolation_level=None, check_same_thread=False)
        connection.text_factory = _text
        try:
            connection.execute("PRAGMA journal_mode=WAL")
            for table in TABLES:
                connection.execute(
                    f"CREATE TABLE IF NOT EXISTS {table} "
                    "(owner TEXT, place INTEGER, body TEXT, checksum TEXT, PRIMARY KEY (owner, place))"
                )
            for table in TABLES[:2]:  # a page that cannot be read shows here, not in the middle of a recovery
                connection.execute(f"SELECT COUNT(checksum) FROM {table}").fetchall()  # noqa: S608
        except BaseException:
            connection.close()
            raise
        return connection

    def _make_private(self) -> None:
        """Create the file with its mode, which SQLite copies to its journal files; an existing file is not opened.

        Closing a file ends all POSIX locks of the process on it (fcntl(2)): those of its SQLite connections as well,
        and another process would then take the log of these connections away.
        """
        try:
            os.close(os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600))
        except FileExistsError:
            if not os.access(self.path, os.R_OK | os.W_OK):
                raise sqlite3.OperationalError(f"{self.path} may not be written") from None
        except OSError as error:
            raise sqlite3.OperationalError(error.strerror) from error

    def _set_aside(self, error: Exception) -> None:
        """Rename a file that SQLite cannot read; raise `sqlite3.OperationalError` on failure."""
        stamp = utc_now().replace(":", "")
        _log.error("the store %s is damaged (%s): it is set aside as %s.damaged-%s", self.path, error, self.path, stamp)
        try:
            for suffix in ("", "-wal", "-shm"):
                beside = self.path.with_name(self.path.name + suffix)
                if beside.exists():
                    beside.rename(beside.with_name(f"{self.path.name}.damaged-{stamp}{suffix}"))
        except OSError as other:
            raise sqlite3.OperationalError(other.strerror) from error


def _text(stored: bytes) -> str:
    """Return a text of the file; its checksum shows damage."""
    return stored.decode(errors="replace")


def _checked(table: str, owner: str, place: object, body: object, checksum: object) -> Any:
    """Return the value of a row, None where it is damaged."""
    if not isinstance(place, int) or not isinstance(body, str):
        return None
    if Row(table, owner, place, body).checksum != checksum:
        return None
    try:
        return json.loads(body, parse_constant=_no_number)
    except ValueError:
        return None


def _no_number(text: str) -> float:
    raise ValueError(f"{text} is no number of a record")


@contextlib.contextmanager
def _as_os_error() -> Iterator[None]:
    try:
        yield
    except UNREADABLE as error:
        raise StoreError(error) from error
