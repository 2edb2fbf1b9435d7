"""Connections to a database and their transactions; errors become a `StorageError` with advice.

Invariants:

1. A transaction that is over is on the disk (SQLite: write-ahead log, `synchronous=FULL`), or nothing of it is.
2. Statements are SQL that databases share, with `:name` in place of a value; a row is a dict by the names of columns.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

from autotuner.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from contextlib import AbstractContextManager

SQLITE = "sqlite"
NO_ADDRESS = ConfigurationError(
    "is not an address of a database",
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
    """Connections to one database."""

    def transaction(self, *, writing: bool = False) -> AbstractContextManager[Connection]:
        """Begin a transaction; it is done at the end of the block, and undone by an error.

        Raises
        ------
        StorageError
            The database cannot be used.
        """

    def give_room_back(self) -> None:
        """Return the space of deleted rows to the disk, where the database does not do so automatically."""

    def close(self) -> None:
        """Close the connections."""


def first_line(cause: object) -> str:
    """Return a library's message of a failure, in a line."""
    return (str(cause).splitlines() or [type(cause).__name__])[0][:300]
