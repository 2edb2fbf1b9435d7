"""The database of a service: plain reading and writing, one call one transaction.

Invariants:

1. Every failure is a `StorageError` with advice; this layer is independent of asyncio and of tunings.
2. The newest is the one that was kept last: a time is shown, never sorted by, because a clock may be set back.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from autotuner.core.jsonable import jsonable
from autotuner.errors import StorageError
from autotuner.service.archive.archive_record import GainsChange, Head, KeptTuning, Progress, Summary, result_of
from autotuner.service.archive.storage import schema
from autotuner.service.archive.storage.database_address import opened
from autotuner.service.archive.storage.migrations import migrate
from autotuner.service.archive.storage.packed import pack, packed_length, unpack

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from autotuner.core.recording import Sample
    from autotuner.service.archive.archive_record import Deed, News
    from autotuner.service.archive.storage.connection import Connection, Row

JsonObject = dict[str, Any]
PROBE = "probe"
"""No identifier of a tuning, which has twelve digits."""


class Database:
    """The tunings, their recordings, events and gains, and the audit.

    Parameters
    ----------
    address : str
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

    def __init__(self, address: str, *, durable: bool = True) -> None:
        self._engine = opened(address, durable=durable)
        try:
            with self._engine.transaction(writing=True) as connection:
                migrate(connection)
        except StorageError:
            self.close()
            raise

    def close(self) -> None:
        """Close the connections."""
        self._engine.close()

    def probe(self) -> None:
        """Write something and remove it again; raise `StorageError` when that is not possible.

        A row that comes and goes: SQLite does not touch the disk for an update that changes nothing.
        """
        with self._engine.transaction(writing=True) as connection:
            _delete(connection, "events", "tuning_id", [PROBE])
            _insert(connection, "events", [{"tuning_id": PROBE, "number": 0, "t_s": 0.0, "data": "{}"}])
            _delete(connection, "events", "tuning_id", [PROBE])

    def begin(self, head: Head) -> Progress:
        """Begin a tuning; return how much of it is stored already."""
        row = {name: getattr(head, name) for name in Head.__slots__} | {"request": _text(head.request)}
        with self._engine.transaction(writing=True) as connection:
            known = connection.rows("SELECT number, code FROM tunings WHERE id = :id", {"id": head.id})
            if known:
                return _progress(connection, head.id, **known[0])
            (last,) = connection.rows("SELECT max(number) AS number FROM tunings")  # it is never the one forgotten
            number = (last["number"] or 0) + 1
            _insert(connection, "tunings", [{**row, "number": number, "told": "{}", "recording_settings": "{}"}])
            return Progress(number)

    def write(self, changes: Sequence[News]) -> None:
        """Write the changes of all tunings in one transaction; earlier values are overwritten."""
        with self._engine.transaction(writing=True) as connection:
            for one in changes:
                _write(connection, one)

    def note(self, action: Deed) -> None:
        """Append to the audit; a missing loop is looked up by its tuning."""
        with self._engine.transaction(writing=True) as connection:
            _note(connection, action)

    def audit(
        self, limit: int, before: int | None = None, loop: str | None = None, actor: str | None = None
    ) -> list[JsonObject]:
        """Return entries of the audit, the newest first; `before` continues after the entry of that number."""
        filters = {"number <": before, "loop =": loop, "actor =": actor}
        given = {f"v{k}": (test, value) for k, (test, value) in enumerate(filters.items()) if value is not None}
        where = " AND ".join(["1 = 1", *(f"{test} :{name}" for name, (test, _) in given.items())])
        values = {name: value for name, (_, value) in given.items()}
        return self._rows(
            f"SELECT * FROM audit WHERE {where} ORDER BY number DESC LIMIT :limit", values | {"limit": limit}
        )

    def gains(self, tuning_id: str) -> list[JsonObject]:
        """Return the changes of gains of a tuning, the oldest first."""
        rows = self._rows("SELECT * FROM gains WHERE tuning_id = :id ORDER BY number", {"id": tuning_id})
        return [{**row, "before": json.loads(row["before"]), "after": json.loads(row["after"])} for row in rows]

    def listed(self, loop: str | None, limit: int, without: Collection[str] = ()) -> list[Summary]:
        """Return tunings, of one loop or of all, the newest first; `without` those."""
        names, values = _listed(without)
        of_the_loop = "" if loop is None else "AND loop = :loop"
        statement = (
            f"SELECT {', '.join(Summary.__slots__)} FROM tunings WHERE id NOT IN ({names}) {of_the_loop} "
            "ORDER BY number DESC, id LIMIT :limit"
        )
        rows = self._rows(statement, values | {"limit": limit} | ({} if loop is None else {"loop": loop}))
        return [
            Summary(**{**row, "phase": row["phase"] or "arm", "result": json.loads(row["result"] or "{}")})
            for row in rows
        ]

    def find(self, tuning_id: str) -> KeptTuning | None:
        """Return an archived tuning; None when there is none."""
        with self._engine.transaction() as connection:
            rows = connection.rows("SELECT * FROM tunings WHERE id = :id", {"id": tuning_id})
            if not rows:
                return None
            try:
                return _kept(rows[0], _samples(connection, tuning_id), _events(connection, tuning_id))
            except (ValueError, TypeError, KeyError, RecursionError) as error:
                raise StorageError(
                    f"has a damaged record ({type(error).__name__})",
                    field=f"tuning {tuning_id}",
                    remedy="Check that disk, and keep the others: GET /v1/tunings/ID/export of each that is listed.",
                ) from error

    def sizes(self) -> list[tuple[str, int]]:
        """Return identifier and bytes of every tuning, the newest first."""
        with self._engine.transaction() as connection:
            held = _bytes(connection, "recording_chunks", "samples")
            reported = _bytes(connection, "events", "data")
            rows = connection.rows("SELECT id, length(told) AS size FROM tunings ORDER BY number DESC, id")
        return [(row["id"], row["size"] + held.get(row["id"], 0) + reported.get(row["id"], 0)) for row in rows]

    def forget(self, tuning_ids: Sequence[str]) -> None:
        """Delete tunings, and give the room back."""
        with self._engine.transaction(writing=True) as connection:
            for table, name in schema.OF_A_TUNING:
                _delete(connection, table, name, tuning_ids)
        self._engine.give_room_back()

    def _rows(self, statement: str, values: Mapping[str, Any]) -> list[Row]:
        with self._engine.transaction() as connection:
            return connection.rows(statement, values)


def _listed(values: Collection[str]) -> tuple[str, dict[str, str]]:
    """Return values for `IN (...)`: their names in the statement, and themselves."""
    named = {f"one{k}": value for k, value in enumerate(values)}
    return ", ".join(f":{name}" for name in named) or "''", named


def _insert(connection: Connection, table: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Insert rows that have the same columns."""
    names = list(rows[0])
    connection.many(
        f"INSERT INTO {table} ({', '.join(names)}) VALUES ({', '.join(f':{name}' for name in names)})", rows
    )


def _delete(connection: Connection, table: str, column: str, values: Collection[str]) -> None:
    names, given = _listed(values)
    connection.rows(f"DELETE FROM {table} WHERE {column} IN ({names})", given)


def _note(connection: Connection, action: Deed) -> None:
    loop = action.loop
    if loop is None and action.tuning_id is not None:
        found = connection.rows("SELECT loop FROM tunings WHERE id = :id", {"id": action.tuning_id})
        loop = found[0]["loop"] if found else None
    row = {"at": action.at, "actor": action.actor[:200], "action": action.action[:400], "status": action.status}
    row |= {"loop": loop and loop[:200], "tuning_id": action.tuning_id and action.tuning_id[:64]}
    _insert(connection, "audit", [row])


def _progress(connection: Connection, tuning_id: str, number: int, code: str | None) -> Progress:
    key = {"id": tuning_id}
    last = connection.rows(
        "SELECT first, samples FROM recording_chunks WHERE tuning_id = :id ORDER BY first DESC LIMIT 1", key
    )
    samples = last[0]["first"] + packed_length(last[0]["samples"]) if last else 0
    (events,) = connection.rows("SELECT count(*) AS count FROM events WHERE tuning_id = :id", key)
    return Progress(number, samples, samples + events["count"], code)


def _write(connection: Connection, changes: News) -> None:
    key = {"tuning_id": changes.tuning_id}
    if changes.samples:
        _from_on(connection, "recording_chunks", "first", key | {"from": changes.first})
        _insert(connection, "recording_chunks", [key | {"first": changes.first, "samples": pack(changes.samples)}])
    if changes.events:
        _from_on(connection, "events", "number", key | {"from": changes.events[0][0]})
        rows = [key | {"number": number, "t_s": data["t"], "data": _text(data)} for number, data in changes.events]
        _insert(connection, "events", rows)
    for change in changes.changes:
        row = {name: getattr(change, name) for name in GainsChange.__slots__}
        _insert(connection, "gains", [key | row | {"before": _text(change.before), "after": _text(change.after)}])
    if changes.since:
        row = connection.rows("SELECT told FROM tunings WHERE id = :tuning_id", key)[0]
        whole = json.loads(row["told"] or "{}") | dict(changes.since)
        since = {"told": _text(whole), "result": _text(result_of(whole))}
        connection.rows("UPDATE tunings SET told = :told, result = :result WHERE id = :tuning_id", key | since)
    if verdict := changes.since.get("verdict"):
        ended = {name: verdict[name] for name in ("outcome", "code")}
        connection.rows("UPDATE tunings SET outcome = :outcome, code = :code WHERE id = :tuning_id", key | ended)
    if (reported := changes.reported) is not None:
        values: JsonObject = {"told": _text(reported.whole), "versions": _text(reported.versions)}
        values |= {"result": _text(result_of(reported.whole))}
        values |= {"outcome": reported.outcome, "code": reported.code, "phase": reported.phase}
        values |= {"recording_settings": _text(reported.recording_settings)} if reported.recording_settings else {}
        assigned = ", ".join(f"{name} = :{name}" for name in values)
        connection.rows(f"UPDATE tunings SET {assigned} WHERE id = :tuning_id", values | key)


def _from_on(connection: Connection, table: str, column: str, values: Mapping[str, Any]) -> None:
    """Delete rows from a number on, which are written again."""
    connection.rows(f"DELETE FROM {table} WHERE tuning_id = :tuning_id AND {column} >= :from", values)


def _samples(connection: Connection, tuning_id: str) -> list[Sample]:
    rows = connection.rows(
        "SELECT samples FROM recording_chunks WHERE tuning_id = :id ORDER BY first", {"id": tuning_id}
    )
    return [sample for row in rows for sample in unpack(row["samples"])]


def _events(connection: Connection, tuning_id: str) -> list[tuple[int, JsonObject]]:
    rows = connection.rows("SELECT number, data FROM events WHERE tuning_id = :id ORDER BY number", {"id": tuning_id})
    return [(row["number"], json.loads(row["data"])) for row in rows]


def _bytes(connection: Connection, table: str, column: str) -> dict[str, int]:
    rows = connection.rows(f"SELECT tuning_id, sum(length({column})) AS size FROM {table} GROUP BY tuning_id")
    return {row["tuning_id"]: int(row["size"] or 0) for row in rows}


def _kept(row: Row, samples: list[Sample], events: list[tuple[int, JsonObject]]) -> KeptTuning:
    head = Head(row["id"], row["loop"], row["started_at"], row["actor"], json.loads(row["request"]))
    reported, settings, versions = (
        json.loads(row[name] or "{}") for name in ("told", "recording_settings", "versions")
    )
    return KeptTuning(head, reported, settings, versions, samples, events)


def _text(value: object) -> str:
    return json.dumps(jsonable(value), allow_nan=False)
