"""The database of a service: plain reading and writing, one call one transaction.

Rules of this file: every failure is a `StorageError` with advice; nothing here knows asyncio, or what a tuning is.
"""

from __future__ import annotations

import json
import sqlite3
from typing import TYPE_CHECKING, Any

from sqlalchemy import func, select

from autotuner.core.jsonable import jsonable
from autotuner.errors import StorageError
from autotuner.store import schema
from autotuner.store.connection import opened, storage_error, transaction
from autotuner.store.kept import Deed, GainsChange, Head, KeptTuning, News, Progress, Summary
from autotuner.store.migrations import migrate
from autotuner.store.packed import pack, packed_length, unpack

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from sqlalchemy import URL, Connection, Row, Select

    from autotuner.core.recording import Sample

JsonObject = dict[str, Any]
PROBE = "probe"
"""No identifier of a tuning, which has twelve digits."""


class Database:
    """The tunings, their recordings, events and gains, and the audit.

    Parameters
    ----------
    address : URL
        Where it is.
    durable : bool
        Whether a transaction waits for the disk.

    Raises
    ------
    StorageError
        It cannot be used, is damaged, or was written by a newer program.
    ConfigurationError
        Its driver is not installed.
    """

    def __init__(self, address: URL, *, durable: bool = True) -> None:
        self.address = address
        self._engine = opened(address, durable=durable)
        try:
            with transaction(self._engine, writing=True) as connection:
                migrate(connection)
        except StorageError:
            self.close()
            raise

    def close(self) -> None:
        """Close the connections."""
        self._engine.dispose()

    def probe(self) -> None:
        """Write something that leaves nothing behind; raise `StorageError` when that is not possible.

        A row that comes and goes: SQLite does not touch the disk for an update that changes nothing.
        """
        table = schema.events
        with transaction(self._engine, writing=True) as connection:
            connection.execute(table.delete().where(table.c.tuning_id == PROBE))
            connection.execute(table.insert().values(tuning_id=PROBE, number=0, t_s=0.0, data="{}"))
            connection.execute(table.delete().where(table.c.tuning_id == PROBE))

    def begin(self, head: Head) -> Progress:
        """Take up a tuning; return how much of it is kept already."""
        row = {name: getattr(head, name) for name in Head.__slots__} | {"request": _text(head.request)}
        query = select(schema.tunings.c.outcome).where(schema.tunings.c.id == head.id)
        with transaction(self._engine, writing=True) as connection:
            if (known := connection.execute(query).first()) is not None:
                return _progress(connection, head.id, ended=known.outcome is not None)
            connection.execute(schema.tunings.insert().values(**row, told="{}", recording_settings="{}"))
            return Progress()

    def write(self, news: Sequence[News]) -> None:
        """Write what is new of all tunings, or nothing of it; what was written before is written over."""
        with transaction(self._engine, writing=True) as connection:
            for one in news:
                _write(connection, one)

    def note(self, deed: Deed) -> None:
        """Append to the audit; the loop of a tuning is looked up where it is not told."""
        with transaction(self._engine, writing=True) as connection:
            _note(connection, deed)

    def audit(
        self, limit: int, before: int | None = None, loop: str | None = None, actor: str | None = None
    ) -> list[JsonObject]:
        """Return entries of the audit, the newest first; `before` goes on behind the one of that number."""
        columns = schema.audit.c
        query = select(schema.audit).order_by(columns.number.desc()).limit(limit)
        query = query if before is None else query.where(columns.number < before)
        for column, wanted in ((columns.loop, loop), (columns.actor, actor)):
            query = query if wanted is None else query.where(column == wanted)
        return self._rows(query)

    def gains(self, tuning_id: str) -> list[JsonObject]:
        """Return the changes of gains of a tuning, the oldest first."""
        table = schema.gains
        rows = self._rows(select(table).where(table.c.tuning_id == tuning_id).order_by(table.c.number))
        return [{**row, "before": json.loads(row["before"]), "after": json.loads(row["after"])} for row in rows]

    def listed(self, loop: str | None, limit: int, without: Collection[str] = ()) -> list[Summary]:
        """Return tunings, of one loop or of all, the newest first; `without` those."""
        table = schema.tunings
        columns = [table.c[name] for name in Summary.__slots__]
        query = select(*columns).order_by(table.c.started_at.desc(), table.c.id).limit(limit)
        query = query if loop is None else query.where(table.c.loop == loop)
        rows = self._rows(query.where(table.c.id.not_in(without)))
        return [Summary(**{**row, "phase": row["phase"] or "arm"}) for row in rows]

    def find(self, tuning_id: str) -> KeptTuning | None:
        """Return a tuning with all that is kept of it; None when there is none."""
        query = select(schema.tunings).where(schema.tunings.c.id == tuning_id)
        with transaction(self._engine) as connection:
            row = connection.execute(query).first()
            return None if row is None else _kept(row, _samples(connection, tuning_id), _events(connection, tuning_id))

    def sizes(self) -> list[tuple[str, int]]:
        """Return identifier and bytes of every tuning, the newest first."""
        chunks, events, tunings = schema.chunks, schema.events, schema.tunings
        with transaction(self._engine) as connection:
            held = _bytes(connection, select(chunks.c.tuning_id, func.sum(func.length(chunks.c.samples))))
            told = _bytes(connection, select(events.c.tuning_id, func.sum(func.length(events.c.data))))
            query = select(tunings.c.id, func.length(tunings.c.told)).order_by(tunings.c.started_at.desc())
            rows = connection.execute(query).all()
        return [(key, size + held.get(key, 0) + told.get(key, 0)) for key, size in rows]

    def forget(self, tuning_ids: Sequence[str]) -> None:
        """Delete tunings, and give the room back."""
        with transaction(self._engine, writing=True) as connection:
            for table, name in schema.OF_A_TUNING:
                connection.execute(table.delete().where(table.c[name].in_(tuning_ids)))
        if self._engine.dialect.name == "sqlite":
            self._give_room_back()

    def _give_room_back(self) -> None:
        connection = self._engine.raw_connection()
        try:
            connection.cursor().executescript("PRAGMA incremental_vacuum")  # `execute` would stop after one page
        except sqlite3.Error as error:
            raise storage_error(self.address, error) from error
        finally:
            connection.close()

    def _rows(self, query: Select[Any]) -> list[JsonObject]:
        with transaction(self._engine) as connection:
            return [dict(row) for row in connection.execute(query).mappings()]


def _note(connection: Connection, deed: Deed) -> None:
    loop = deed.loop
    if loop is None and deed.tuning_id is not None:
        query = select(schema.tunings.c.loop).where(schema.tunings.c.id == deed.tuning_id)
        loop = connection.execute(query).scalar_one_or_none()
    row = {"at": deed.at, "actor": deed.actor[:200], "action": deed.action[:400], "status": deed.status}
    row |= {"loop": loop and loop[:200], "tuning_id": deed.tuning_id and deed.tuning_id[:64]}
    connection.execute(schema.audit.insert().values(**row))


def _progress(connection: Connection, tuning_id: str, *, ended: bool) -> Progress:
    chunks, events = schema.chunks, schema.events
    query = select(chunks.c.first, chunks.c.samples).where(chunks.c.tuning_id == tuning_id)
    last = connection.execute(query.order_by(chunks.c.first.desc()).limit(1)).first()
    samples = last.first + packed_length(last.samples) if last else 0
    query_events = select(func.count()).where(events.c.tuning_id == tuning_id)
    return Progress(samples, samples + connection.execute(query_events).scalar_one(), ended)


def _write(connection: Connection, news: News) -> None:
    key = news.tuning_id
    if news.samples:
        table = schema.chunks
        connection.execute(table.delete().where(table.c.tuning_id == key, table.c.first >= news.first))
        connection.execute(table.insert().values(tuning_id=key, first=news.first, samples=pack(news.samples)))
    if news.events:
        _write_events(connection, key, news.events)
    for change in news.changes:
        row = {name: getattr(change, name) for name in GainsChange.__slots__}
        row |= {"before": _text(change.before), "after": _text(change.after)}
        connection.execute(schema.gains.insert().values(tuning_id=key, **row))
    if (told := news.told) is not None:
        values: JsonObject = {"told": _text(told.whole), "versions": _text(told.versions)}
        values |= {"outcome": told.outcome, "code": told.code, "phase": told.phase}
        values |= {"recording_settings": _text(told.recording_settings)} if told.recording_settings else {}
        connection.execute(schema.tunings.update().where(schema.tunings.c.id == key).values(values))


def _write_events(connection: Connection, key: str, events: Sequence[tuple[int, JsonObject]]) -> None:
    table = schema.events
    rows = [{"tuning_id": key, "number": number, "t_s": data["t"], "data": _text(data)} for number, data in events]
    connection.execute(table.delete().where(table.c.tuning_id == key, table.c.number >= events[0][0]))
    connection.execute(table.insert(), rows)


def _samples(connection: Connection, tuning_id: str) -> list[Sample]:
    table = schema.chunks
    query = select(table.c.samples).where(table.c.tuning_id == tuning_id).order_by(table.c.first)
    return [sample for (packed,) in connection.execute(query) for sample in unpack(packed)]


def _events(connection: Connection, tuning_id: str) -> list[tuple[int, JsonObject]]:
    table = schema.events
    query = select(table.c.number, table.c.data).where(table.c.tuning_id == tuning_id).order_by(table.c.number)
    return [(number, json.loads(data)) for number, data in connection.execute(query)]


def _bytes(connection: Connection, query: Select[Any]) -> dict[str, int]:
    grouped = query.group_by(query.selected_columns[0])
    return {key: int(size or 0) for key, size in connection.execute(grouped)}


def _kept(row: Row[Any], samples: list[Sample], events: list[tuple[int, JsonObject]]) -> KeptTuning:
    head = Head(row.id, row.loop, row.started_at, row.actor, json.loads(row.request))
    versions = json.loads(row.versions or "{}")
    return KeptTuning(head, json.loads(row.told), json.loads(row.recording_settings), versions, samples, events)


def _text(value: object) -> str:
    return json.dumps(jsonable(value), allow_nan=False)
