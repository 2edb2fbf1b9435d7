"""Opening a database, and its transactions; what goes wrong becomes a `StorageError` with advice.

Rules of this file:

1. A transaction that is over is on the disk (SQLite: write-ahead log, `synchronous=FULL`), or nothing of it is.
2. A password in a database's address is never shown.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any

from sqlalchemy import create_engine, event
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError, NoSuchModuleError, SQLAlchemyError

from autotuner.errors import ConfigurationError, StorageError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from sqlalchemy import URL, Connection, Engine

FILE = "tunings.sqlite"
WAIT_S = 5.0
"""Longest wait for another program that writes, s."""
REMEDIES = {
    "SQLITE_FULL": "Make room on that disk.",
    "SQLITE_READONLY": "Let the service write there, or set service.data_directory to another folder.",
    "SQLITE_CANTOPEN": "Let the service write there, or set service.data_directory to another folder.",
    "SQLITE_CORRUPT": "Stop the service, move the file and its -wal and -shm away, and start: a new one is begun.",
    "SQLITE_NOTADB": "Stop the service, move the file and its -wal and -shm away, and start: a new one is begun.",
    "SQLITE_IOERR": "Check that disk: the system log says what it does.",
    "SQLITE_BUSY": "Another program is writing: end it, or wait.",
}
"""What to do, by the beginning of SQLite's name of the failure."""
ELSEWHERE = "Check that the database answers, and that service.database_url is right."


def address_of(folder: Path, given: str | None) -> URL:
    """Return the address of the database: the one that is given, or the file in the data directory.

    Raises
    ------
    ConfigurationError
        It is no address.
    """
    try:
        return make_url(given or f"sqlite:///{folder / FILE}")
    except ArgumentError as error:  # which shows the address, with its password
        raise ConfigurationError(
            "is no address of a database",
            field="service.database_url",
            remedy="Write DIALECT+DRIVER://USER:PASSWORD@HOST/NAME, or leave it out.",
        ) from error


def opened(address: URL, *, durable: bool = True) -> Engine:
    """Return what connects to a database; nothing is connected yet.

    Raises
    ------
    ConfigurationError
        There is no such dialect, or its driver is not installed.
    """
    try:
        engine = create_engine(address, **_options(address))
    except (NoSuchModuleError, ImportError) as error:
        raise ConfigurationError(
            f"needs a driver that is not installed: {error}",
            field="service.database_url",
            value=address.drivername,
            remedy="Install it, or name another: postgresql+pg8000 comes with relay-autotuner[postgresql].",
        ) from error
    if address.get_backend_name() == "sqlite":
        event.listen(engine, "connect", _prepare if durable else _prepare_quickly)
        event.listen(engine, "begin", _begin)
    return engine


def _options(address: URL) -> dict[str, Any]:
    if address.get_backend_name() == "sqlite":
        return {"connect_args": {"check_same_thread": False, "timeout": WAIT_S}}
    return {"pool_pre_ping": True}


def _prepare(connection: Any, _: object) -> None:
    connection.isolation_level = None  # the driver's own transactions leave out changes of tables: ours do not
    cursor = connection.cursor()
    for setting in ("auto_vacuum=INCREMENTAL", "journal_mode=WAL", "synchronous=FULL"):
        cursor.execute(f"PRAGMA {setting}")
    cursor.close()


def _prepare_quickly(connection: Any, record: object) -> None:
    """Do not wait for the disk: in virtual time, where that has no meaning."""
    _prepare(connection, record)
    connection.execute("PRAGMA synchronous=OFF").close()


def _begin(connection: Connection) -> None:
    # who is going to write says so at once: else he could find that another has written since he began to read
    connection.exec_driver_sql("BEGIN IMMEDIATE" if connection.get_execution_options().get("writing") else "BEGIN")


@contextlib.contextmanager
def transaction(engine: Engine, *, writing: bool = False) -> Iterator[Connection]:
    """Begin a transaction; it is done at the end of the block, and undone by an error.

    Raises
    ------
    StorageError
        The database cannot be used.
    """
    try:
        with engine.connect().execution_options(writing=writing) as connection, connection.begin():
            yield connection
    except (SQLAlchemyError, OSError) as error:
        raise storage_error(engine.url, error) from error


def storage_error(address: URL, error: Exception) -> StorageError:
    """Return what went wrong with a database, with advice."""
    cause = getattr(error, "orig", None) or error
    name = str(getattr(cause, "sqlite_errorname", ""))
    remedy = next((advice for start, advice in REMEDIES.items() if name.startswith(start)), ELSEWHERE)
    return StorageError(f"cannot be used: {_first_line(cause)}", field=shown(address), remedy=remedy)


def shown(address: URL) -> str:
    """Return what a person is told of an address: the file, or the address without its password."""
    if address.get_backend_name() == "sqlite":
        return str(address.database)
    return address.render_as_string(hide_password=True)


def _first_line(cause: object) -> str:
    return (str(cause).splitlines() or [type(cause).__name__])[0][:300]
