"""How an older database becomes the present one.

Rules of this file:

1. A step that was released is never changed, so it describes its tables by itself; a change of the tables is a further
   step at the end of `STEPS`, and one in `autotuner.store.schema`.
2. All steps are one transaction: a database is of the old version or of the new one.
3. The audit is append-only: the database itself refuses to change or delete a row, where we know how to tell it.
4. A database of a newer program is refused, not guessed at.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sqlalchemy import Column, Float, Integer, LargeBinary, MetaData, String, Table, Text, inspect, select

from autotuner.errors import StorageError
from autotuner.store.schema import version

if TYPE_CHECKING:
    from sqlalchemy import Connection

REFUSAL = "the audit is append-only"
APPEND_ONLY = {
    "sqlite": (
        f"CREATE TRIGGER audit_no_update BEFORE UPDATE ON audit BEGIN SELECT RAISE(ABORT, '{REFUSAL}'); END",
        f"CREATE TRIGGER audit_no_delete BEFORE DELETE ON audit BEGIN SELECT RAISE(ABORT, '{REFUSAL}'); END",
    ),
    "postgresql": (
        f"""CREATE FUNCTION audit_append_only() RETURNS trigger LANGUAGE plpgsql AS
        'BEGIN RAISE EXCEPTION ''{REFUSAL}''; END'""",
        """CREATE TRIGGER audit_append_only BEFORE UPDATE OR DELETE OR TRUNCATE ON audit
        FOR EACH STATEMENT EXECUTE FUNCTION audit_append_only()""",
    ),
}


def _tunings_recordings_events_audit(connection: Connection) -> None:
    metadata = MetaData()
    Table("schema_version", metadata, Column("version", Integer, nullable=False))
    Table(
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
    tuning = ("tuning_id", String(64))
    first = Column("first", Integer, primary_key=True)
    Table(
        "recording_chunks",
        metadata,
        Column(*tuning, primary_key=True),
        first,
        Column("samples", LargeBinary, nullable=False),
    )
    number = Column("number", Integer, primary_key=True)
    data = (Column("t_s", Float, nullable=False), Column("data", Text, nullable=False))
    Table("events", metadata, Column(*tuning, primary_key=True), number, *data)
    Table(
        "audit",
        metadata,
        Column("number", Integer, primary_key=True, autoincrement=True),
        Column("at", String(40), nullable=False),
        Column("actor", String(200), nullable=False),
        Column("action", String(400), nullable=False),
        Column("status", Integer, nullable=False),
    )
    metadata.create_all(connection)
    for statement in APPEND_ONLY.get(connection.dialect.name, ()):
        connection.exec_driver_sql(statement)


def _gains_and_what_a_list_shows(connection: Connection) -> None:
    for column in ("code VARCHAR(60)", "phase VARCHAR(20)", "versions TEXT"):
        connection.exec_driver_sql(f"ALTER TABLE tunings ADD COLUMN {column}")
    metadata = MetaData()
    Table(
        "gains",
        metadata,
        Column("number", Integer, primary_key=True, autoincrement=True),
        Column("tuning_id", String(64), nullable=False, index=True),
        Column("loop", String(200), nullable=False),
        Column("at", String(40), nullable=False),
        Column("action", String(20), nullable=False),
        Column("before", Text, nullable=False),
        Column("after", Text, nullable=False),
    )
    metadata.create_all(connection)


def _what_the_audit_is_about(connection: Connection) -> None:
    for column in ("loop VARCHAR(200)", "tuning_id VARCHAR(64)"):
        connection.exec_driver_sql(f"ALTER TABLE audit ADD COLUMN {column}")
    connection.exec_driver_sql("CREATE INDEX ix_audit_loop ON audit (loop)")


STEPS = (_tunings_recordings_events_audit, _gains_and_what_a_list_shows, _what_the_audit_is_about)
"""From version k to k + 1."""


def migrate(connection: Connection) -> None:
    """Bring a database, or an empty one, to the present version, in the connection's transaction.

    Raises
    ------
    StorageError
        It was written by a newer program.
    """
    found = 0
    if inspect(connection).has_table(version.name):
        found = connection.execute(select(version.c.version)).scalar_one()
    if found > len(STEPS):
        raise StorageError(
            f"was written by a newer program (version {found}, this one knows {len(STEPS)})",
            field="service.data_directory",
            remedy="Use the newer program, or another data directory.",
        )
    if found == len(STEPS):
        return
    for step in STEPS[found:]:
        step(connection)
    given = {"version": len(STEPS)}
    connection.execute(version.update().values(given) if found else version.insert().values(given))
