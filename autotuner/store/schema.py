"""The tables, and how an older database becomes the present one.

Rules of this file:

1. A released migration is never changed; a change of the tables is a further one at the end of `MIGRATIONS`.
2. The audit is append-only: the database itself refuses to change or delete a row.
3. A database of a newer program is refused, not guessed at.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sqlalchemy import Column, Float, Integer, LargeBinary, MetaData, String, Table, Text, inspect, select, text

from autotuner.errors import StorageError

if TYPE_CHECKING:
    from sqlalchemy import Connection

metadata = MetaData()

version = Table("schema_version", metadata, Column("version", Integer, nullable=False))
tunings = Table(
    "tunings",
    metadata,
    Column("id", String(64), primary_key=True),
    Column("loop", String(200), nullable=False, index=True),
    Column("started_at", String(40), nullable=False, index=True),
    Column("actor", String(200), nullable=False),
    Column("request", Text, nullable=False),
    Column("told", Text, nullable=False),
    Column("recording_settings", Text, nullable=False),
    Column("outcome", String(20)),
)
"""`request` and `told` are JSON: what was asked, and what `Tuning.to_dict` told last; `outcome` null while it runs."""
chunks = Table(
    "recording_chunks",
    metadata,
    Column("tuning_id", String(64), primary_key=True),
    Column("first", Integer, primary_key=True),
    Column("samples", LargeBinary, nullable=False),
)
"""Samples from number `first` on: rows of six little-endian float64 (see `database.pack`)."""
events = Table(
    "events",
    metadata,
    Column("tuning_id", String(64), primary_key=True),
    Column("number", Integer, primary_key=True),
    Column("t_s", Float, nullable=False),
    Column("data", Text, nullable=False),
)
"""What happened beside the samples, as JSON."""
audit = Table(
    "audit",
    metadata,
    Column("number", Integer, primary_key=True, autoincrement=True),
    Column("at", String(40), nullable=False),
    Column("actor", String(200), nullable=False),
    Column("action", String(400), nullable=False),
    Column("status", Integer, nullable=False),
)
"""Who did what, with the status of the answer."""

APPEND_ONLY = (
    "CREATE TRIGGER audit_no_update BEFORE UPDATE ON audit BEGIN SELECT RAISE(ABORT, 'the audit is append-only'); END",
    "CREATE TRIGGER audit_no_delete BEFORE DELETE ON audit BEGIN SELECT RAISE(ABORT, 'the audit is append-only'); END",
)


def _first(connection: Connection) -> None:
    metadata.create_all(connection)
    for statement in APPEND_ONLY:
        connection.execute(text(statement))


MIGRATIONS = (_first,)
"""From version k to k + 1."""


def migrate(connection: Connection) -> None:
    """Bring a database, or an empty file, to the present version, in the connection's transaction.

    Raises
    ------
    StorageError
        It was written by a newer program.
    """
    found = 0
    if inspect(connection).has_table(version.name):
        found = connection.execute(select(version.c.version)).scalar_one()
    if found > len(MIGRATIONS):
        raise StorageError(
            f"was written by a newer program (version {found}, this one knows {len(MIGRATIONS)})",
            field="service.data_directory",
            remedy="Use the newer program, or another data directory.",
        )
    for step in MIGRATIONS[found:]:
        step(connection)
    if found == 0:
        connection.execute(version.insert().values(version=len(MIGRATIONS)))
    elif found < len(MIGRATIONS):
        connection.execute(version.update().values(version=len(MIGRATIONS)))
