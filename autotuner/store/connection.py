"""Opening a database, and its transactions; what goes wrong becomes a `StorageError` with advice.

Rules of this file:

1. A transaction that is over is on the disk (SQLite: write-ahead log, `synchronous=FULL`), or nothing of it is.
2. A password in a database's address is never shown.
3. A file of SQLite, which is what a service has unless another database is configured, is opened by Python's own
   library; SQLAlchemy is loaded for other databases only: it is larger than all else of a service but NumPy.
4. Statements are SQL that databases share, with `:name` where a value stands; a row is a dict by the names of columns.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

from autotuner.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from contextlib import AbstractContextManager
    from pathlib import Path

FILE = "tunings.sqlite"
SQLITE = "sqlite"
NO_ADDRESS = ConfigurationError(
    "is no address of a database",
    field="service.database_url",
    remedy="Write DIALECT+DRIVER://USER:PASSWORD@HOST/NAME, or leave it out.",
)

Row = dict[str, Any]


class Connection(Protocol):
    """A connection in a transaction.

    Attributes
    ----------
    dialect : str
        Whose SQL it speaks: ``sqlite``, ``postgresql``...
    """

    dialect: str

    def rows(self, statement: str, values: Mapping[str, Any] | None = None) -> list[Row]:
        """Do a statement; return its rows, none where it has none."""

    def many(self, statement: str, rows: Sequence[Mapping[str, Any]]) -> None:
        """Do a statement once for each row of values."""

    def has_table(self, name: str) -> bool:
        """Return whether there is a table of that name."""


class Engine(Protocol):
    """What connects to one database."""

    def transaction(self, *, writing: bool = False) -> AbstractContextManager[Connection]:
        """Begin a transaction; it is done at the end of the block, and undone by an error.

        Raises
        ------
        StorageError
            The database cannot be used.
        """

    def give_room_back(self) -> None:
        """Give the room of what was deleted back to the disk, where the database does not do that by itself."""

    def close(self) -> None:
        """Close the connections."""


def address_of(folder: Path, given: str | None) -> str:
    """Return the address of the database: the one that is given, or the file in the data directory.

    Raises
    ------
    ConfigurationError
        It is no address.
    """
    address = given or f"{SQLITE}:///{folder / FILE}"
    if "://" not in address:
        raise NO_ADDRESS
    return address


def opened(address: str, *, durable: bool = True) -> Engine:
    """Return what connects to a database; nothing is connected yet.

    Parameters
    ----------
    address : str
        Where it is.
    durable : bool
        Whether a transaction waits for the disk (SQLite).

    Raises
    ------
    ConfigurationError
        It is no address, there is no such dialect, or its driver is not installed.
    """
    if (path := path_of(address)) is not None:
        from autotuner.store.sqlite_file import SqliteFile  # noqa: PLC0415 - not needed for another database

        return SqliteFile(path, durable=durable)
    from autotuner.store.other_database import OtherDatabase  # noqa: PLC0415 - rule 3

    return OtherDatabase(address)


def path_of(address: str) -> str | None:
    """Return the file, or its URI, of an address of SQLite; None for another database.

    Raises
    ------
    ConfigurationError
        It has options, which only a URI of SQLite (``sqlite:///file:PATH?mode=ro``) may have.
    """
    scheme, _, path = address.partition("://")
    if scheme.partition("+")[0] != SQLITE:
        return None
    if not path.startswith("/") or ("?" in path and not path.startswith("/file:")):
        raise NO_ADDRESS
    return path[1:]


def shown(address: str) -> str:
    """Return what a person is told of an address: the file, or the address without its password."""
    path = path_of(address)
    if path is not None:
        return path
    from autotuner.store.other_database import without_password  # noqa: PLC0415 - rule 3

    return without_password(address)


def first_line(cause: object) -> str:
    """Return what a library tells of a failure, in a line."""
    return (str(cause).splitlines() or [type(cause).__name__])[0][:300]
