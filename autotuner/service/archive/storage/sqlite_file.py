"""A file of SQLite, by Python's own library.

Invariant: connections are kept for the next transaction, of whatever thread; one that failed is not.
"""

from __future__ import annotations

import contextlib
import sqlite3
from collections import deque
from typing import TYPE_CHECKING, Any

from autotuner.errors import StorageError
from autotuner.service.archive.storage.connection import SQLITE, first_line

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from autotuner.service.archive.storage.connection import Row

WAIT_S = 5.0
"""Longest wait for another program that writes, s."""
DURABLE = ("auto_vacuum=INCREMENTAL", "journal_mode=WAL", "synchronous=FULL")
QUICK = (*DURABLE, "synchronous=OFF")
"""Settings of a connection; the quick ones do not wait for the disk: in virtual time, where that has no meaning."""
REMEDIES = {
    "SQLITE_FULL": "Make room on that disk.",
    "SQLITE_READONLY": "Let the service write there, or set service.data_directory to another folder.",
    "SQLITE_CANTOPEN": "Let the service write there, or set service.data_directory to another folder.",
    "SQLITE_CORRUPT": "Stop the service, move the file and its -wal and -shm away, and start: a new one is begun.",
    "SQLITE_NOTADB": "Stop the service, move the file and its -wal and -shm away, and start: a new one is begun.",
    "SQLITE_IOERR": "Check that disk: the system log has its errors.",
    "SQLITE_BUSY": "Another program is writing: end it, or wait.",
}
"""Remedies, by the beginning of SQLite's name of the failure."""
OTHERWISE = "Check that file, and the disk that it is on."


class SqliteConnection:
    """A connection; implements `autotuner.service.archive.storage.connection.Connection`."""

    dialect = SQLITE

    def __init__(self, connection: sqlite3.Connection) -> None:
        self._connection = connection

    def rows(self, statement: str, values: Mapping[str, Any] | None = None) -> list[Row]:
        """Do a statement; return its rows, none where it has none."""
        return [dict(row) for row in self._connection.execute(statement, dict(values or {}))]

    def many(self, statement: str, rows: Sequence[Mapping[str, Any]]) -> None:
        """Do a statement once for each row of values."""
        self._connection.executemany(statement, rows)

    def has_table(self, name: str) -> bool:
        """Return whether there is a table of that name."""
        return bool(self.rows("SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = :name", {"name": name}))


class SqliteFile:
    """One file; implements `autotuner.service.archive.storage.connection.Engine`.

    Parameters
    ----------
    path : str
        The file, made when needed, or a URI of it (``file:PATH?mode=ro``).
    durable : bool
        Whether a transaction waits for the disk.
    """

    def __init__(self, path: str, *, durable: bool = True) -> None:
        self._path, self._settings = path, DURABLE if durable else QUICK
        self._idle = deque[sqlite3.Connection]()

    @contextlib.contextmanager
    def transaction(self, *, writing: bool = False) -> Iterator[SqliteConnection]:
        """Begin a transaction; it is done at the end of the block, and undone by an error."""
        with self._connection() as connection:
            # a writer locks at once: else another could have written since it began to read
            connection.execute("BEGIN IMMEDIATE" if writing else "BEGIN")
            yield SqliteConnection(connection)
            connection.execute("COMMIT")

    def give_room_back(self) -> None:
        """Shrink the file to its content."""
        with self._connection() as connection:
            connection.executescript("PRAGMA incremental_vacuum")  # `execute` would stop after one page

    def close(self) -> None:
        """Close the connections."""
        while self._idle:
            self._idle.pop().close()

    @contextlib.contextmanager
    def _connection(self) -> Iterator[sqlite3.Connection]:
        try:
            try:
                connection = self._idle.pop()
            except IndexError:  # requested in one step: another thread may take the last one
                connection = self._connected()
            try:
                yield connection
            except BaseException:
                connection.close()  # which rolls the transaction back
                raise
        except (sqlite3.Error, OSError) as error:
            raise self._trouble(error) from error
        self._idle.append(connection)

    def _connected(self) -> sqlite3.Connection:
        # the library's own transactions leave out changes of tables: ours do not
        connection = sqlite3.connect(
            self._path,
            timeout=WAIT_S,
            isolation_level=None,
            check_same_thread=False,
            uri=self._path.startswith("file:"),
        )
        try:
            connection.row_factory = sqlite3.Row
            for setting in self._settings:
                connection.execute(f"PRAGMA {setting}").close()
        except BaseException:
            connection.close()
            raise
        return connection

    def _trouble(self, error: Exception) -> StorageError:
        name = str(getattr(error, "sqlite_errorname", ""))
        remedy = next((advice for start, advice in REMEDIES.items() if name.startswith(start)), OTHERWISE)
        return StorageError(f"cannot be used: {first_line(error)}", field=self._path, remedy=remedy)
