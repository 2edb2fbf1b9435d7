"""Address of a database, and connections to it.

Invariants:

1. A SQLite file, the default of a service, is opened by Python's own
   library; SQLAlchemy is loaded for other databases only: it is larger than all else of a service but NumPy.
2. A password in a database's address is never shown.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.service.archive.storage.connection import NO_ADDRESS, SQLITE

if TYPE_CHECKING:
    from pathlib import Path

    from autotuner.service.archive.storage.connection import Engine

FILE = "tunings.sqlite"


def address_of(folder: Path, given: str | None) -> str:
    """Return the address of the database: the one that is given, or the file in the data directory.

    Raises
    ------
    ConfigurationError
        The address is not valid.
    """
    address = given or f"{SQLITE}:///{folder / FILE}"
    if "://" not in address:
        raise NO_ADDRESS
    return address


def opened(address: str, *, durable: bool = True) -> Engine:
    """Return the engine of a database; nothing is connected yet.

    Parameters
    ----------
    address : str
        Where it is.
    durable : bool
        Whether a transaction waits for the disk (SQLite).

    Raises
    ------
    ConfigurationError
        The address is not valid, there is no such dialect, or its driver is not installed.
    """
    if (path := path_of(address)) is not None:
        from autotuner.service.archive.storage.sqlite_file import SqliteFile  # noqa: PLC0415 - not needed for another database

        return SqliteFile(path, durable=durable)
    from autotuner.service.archive.storage.other_database import OtherDatabase  # noqa: PLC0415 - rule 1

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
    """Return an address as it is shown: the file, or the address without its password."""
    path = path_of(address)
    if path is not None:
        return path
    from autotuner.service.archive.storage.other_database import without_password  # noqa: PLC0415 - rule 1

    return without_password(address)
