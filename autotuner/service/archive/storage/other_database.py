"""Another database than a file of SQLite, by SQLAlchemy.

Invariant: SQLAlchemy connects, keeps the connections and translates `:name`; statements are our own.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any

from sqlalchemy import create_engine, inspect, text
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError, NoSuchModuleError, SQLAlchemyError

from autotuner.errors import ConfigurationError, StorageError
from autotuner.service.archive.storage.connection import NO_ADDRESS, first_line

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from sqlalchemy import URL
    from sqlalchemy import Connection as Library

    from autotuner.service.archive.storage.connection import Row

ELSEWHERE = "Check that the database answers, and that service.database_url is right."


class OtherConnection:
    """A connection; implements `autotuner.service.archive.storage.connection.Connection`."""

    def __init__(self, connection: Library) -> None:
        self._connection = connection
        self.dialect = connection.dialect.name

    def rows(self, statement: str, values: Mapping[str, Any] | None = None) -> list[Row]:
        """Do a statement; return its rows, none where it has none."""
        found = self._connection.execute(text(statement), dict(values or {}))
        return [dict(row) for row in found.mappings()] if found.returns_rows else []

    def many(self, statement: str, rows: Sequence[Mapping[str, Any]]) -> None:
        """Do a statement once for each row of values."""
        self._connection.execute(text(statement), rows)

    def has_table(self, name: str) -> bool:
        """Return whether there is a table of that name."""
        return inspect(self._connection).has_table(name)


class OtherDatabase:
    """One database; implements `autotuner.service.archive.storage.connection.Engine`.

    Parameters
    ----------
    address : str
        Where it is.

    Raises
    ------
    ConfigurationError
        The address is not valid, there is no such dialect, or its driver is not installed.
    """

    def __init__(self, address: str) -> None:
        url = _url(address)
        try:
            self._engine = create_engine(url, pool_pre_ping=True)
        except (NoSuchModuleError, ImportError) as error:
            raise ConfigurationError(
                f"needs a driver that is not installed: {error}",
                field="service.database_url",
                value=url.drivername,
                remedy="Install it, or name another: postgresql+pg8000 comes with relay-autotuner[postgresql].",
            ) from error

    @contextlib.contextmanager
    def transaction(self, *, writing: bool = False) -> Iterator[OtherConnection]:  # noqa: ARG002 - SQLite has to know
        """Begin a transaction; it is done at the end of the block, and undone by an error."""
        try:
            with self._engine.begin() as connection:
                yield OtherConnection(connection)
        except (SQLAlchemyError, OSError) as error:
            where, cause = _without_password(self._engine.url), getattr(error, "orig", None) or error
            raise StorageError(f"cannot be used: {first_line(cause)}", field=where, remedy=ELSEWHERE) from error

    def give_room_back(self) -> None:
        """Do nothing: the database does so automatically."""

    def close(self) -> None:
        """Close the connections."""
        self._engine.dispose()


def without_password(address: str) -> str:
    """Return an address as it is shown."""
    return _without_password(_url(address))


def _without_password(url: URL) -> str:
    return url.render_as_string(hide_password=True)


def _url(address: str) -> URL:
    try:
        return make_url(address)
    except ArgumentError:  # which shows the address, with its password
        raise NO_ADDRESS from None
