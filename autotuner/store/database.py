"""The database of one data directory: plain reading and writing, one call one transaction.

Rules of this file: a commit is on disk when the call returns (SQLite, write-ahead log, `synchronous=FULL`); every
failure is a `StorageError` with advice; nothing here knows asyncio.
"""

from __future__ import annotations

import contextlib
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from sqlalchemy import create_engine, event, select
from sqlalchemy.exc import SQLAlchemyError

from autotuner.core.recording import Sample
from autotuner.errors import StorageError
from autotuner.store import schema

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from sqlalchemy import Connection, Row

FILE = "tunings.sqlite"
FIELDS = ("t", "pv", "output", "set_point", "lateness_s", "written_s")
"""The numbers of a sample, in the order in which they are packed."""


@dataclass(frozen=True, slots=True)
class Kept:
    """A tuning as the database holds it; `told` is what it told last."""

    id: str
    loop: str
    started_at: str
    actor: str
    request: dict[str, Any]
    told: dict[str, Any]
    recording_settings: dict[str, Any]
    outcome: str | None


class Database:
    """The tunings, events, recordings and the audit.

    Parameters
    ----------
    folder : Path
        The data directory; made when needed.

    Raises
    ------
    StorageError
        It cannot be opened, is damaged, or was written by a newer program.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / FILE
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise _storage_error(self.path, str(error.strerror)) from error
        self._engine = create_engine(f"sqlite:///{self.path}", connect_args={"check_same_thread": False})
        event.listen(self._engine, "connect", _prepare)
        try:
            with self._transaction() as connection:
                schema.migrate(connection)
        except StorageError:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._engine.dispose()

    def begin(self, kept: Kept) -> None:
        """Take up a tuning that is about to start; one that is known is left as it is."""
        with self._transaction() as connection:
            known = connection.execute(select(schema.tunings.c.id).where(schema.tunings.c.id == kept.id)).first()
            if known is None:
                connection.execute(schema.tunings.insert().values(**_row(kept)))

    def put(self, tuning_id: str, first: int, samples: Sequence[Sample], events: Sequence[tuple[int, Any]]) -> None:
        """Append samples, the first of which has the number `first`, and numbered events (JSON-ready)."""
        with self._transaction() as connection:
            if samples:
                row = {"tuning_id": tuning_id, "first": first, "samples": pack(samples)}
                connection.execute(schema.chunks.insert().prefix_with("OR IGNORE").values(**row))
            for number, data in events:
                row = {"tuning_id": tuning_id, "number": number, "t_s": data.get("t") or 0.0, "data": json.dumps(data)}
                connection.execute(schema.events.insert().prefix_with("OR IGNORE").values(**row))

    def tell(
        self, tuning_id: str, told: dict[str, Any], recording_settings: dict[str, Any], outcome: str | None
    ) -> None:
        """Replace what a tuning tells."""
        values = {"told": json.dumps(told), "recording_settings": json.dumps(recording_settings), "outcome": outcome}
        with self._transaction() as connection:
            connection.execute(schema.tunings.update().where(schema.tunings.c.id == tuning_id).values(**values))

    def note(self, at: str, actor: str, action: str, status: int) -> None:
        """Append to the audit."""
        with self._transaction() as connection:
            row = {"at": at, "actor": actor[:200], "action": action[:400], "status": status}
            connection.execute(schema.audit.insert().values(**row))

    def audit(self, limit: int) -> list[dict[str, Any]]:
        """Return the latest entries of the audit, the newest first."""
        with self._transaction() as connection:
            rows = connection.execute(select(schema.audit).order_by(schema.audit.c.number.desc()).limit(limit))
            return [dict(row._mapping) for row in rows]  # noqa: SLF001 - SQLAlchemy's documented name

    def listed(self, loop: str | None, limit: int) -> list[Kept]:
        """Return tunings, of one loop or of all, the newest first."""
        query = select(schema.tunings).order_by(schema.tunings.c.started_at.desc()).limit(limit)
        with self._transaction() as connection:
            rows = connection.execute(query if loop is None else query.where(schema.tunings.c.loop == loop))
            return [_kept(row) for row in rows]

    def find(self, tuning_id: str) -> Kept | None:
        """Return a tuning; None when there is none."""
        with self._transaction() as connection:
            row = connection.execute(select(schema.tunings).where(schema.tunings.c.id == tuning_id)).first()
            return None if row is None else _kept(row)

    def samples(self, tuning_id: str) -> list[Sample]:
        """Return the recorded samples of a tuning in their order."""
        table = schema.chunks
        query = select(table.c.samples).where(table.c.tuning_id == tuning_id).order_by(table.c.first)
        with self._transaction() as connection:
            return [sample for (packed,) in connection.execute(query) for sample in unpack(packed)]

    def events(self, tuning_id: str) -> list[dict[str, Any]]:
        """Return the events of a tuning beside its samples, in their order."""
        table = schema.events
        query = select(table.c.data).where(table.c.tuning_id == tuning_id).order_by(table.c.number)
        with self._transaction() as connection:
            return [json.loads(data) for (data,) in connection.execute(query)]

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[Connection]:
        try:
            with self._engine.begin() as connection:
                yield connection
        except SQLAlchemyError as error:
            raise _storage_error(self.path, str(getattr(error, "orig", None) or error)) from error


def pack(samples: Sequence[Sample]) -> bytes:
    """Return samples as rows of six little-endian float64, in the order of `FIELDS`."""
    rows = [[getattr(sample, name) for name in FIELDS] for sample in samples]
    return np.array(rows, dtype="<f8").tobytes()


def unpack(packed: bytes) -> list[Sample]:
    """Return the samples that `pack` packed, bit by bit the same."""
    rows = np.frombuffer(packed, dtype="<f8").reshape(-1, len(FIELDS))
    return [Sample(**dict(zip(FIELDS, row, strict=True))) for row in rows.tolist()]


def _prepare(connection: Any, _: object) -> None:
    cursor = connection.cursor()
    cursor.execute("PRAGMA journal_mode=WAL")
    cursor.execute("PRAGMA synchronous=FULL")
    cursor.execute("PRAGMA busy_timeout=5000")
    cursor.close()


def _row(kept: Kept) -> dict[str, Any]:
    whole = {name: getattr(kept, name) for name in Kept.__slots__}
    packed = {name: json.dumps(whole[name]) for name in ("request", "told", "recording_settings")}
    return whole | packed


def _kept(row: Row[Any]) -> Kept:
    whole = dict(row._mapping)  # noqa: SLF001 - SQLAlchemy's documented name
    parsed = {name: json.loads(whole[name]) for name in ("request", "told", "recording_settings")}
    return Kept(**whole | parsed)


def _storage_error(path: Path, why: str) -> StorageError:
    return StorageError(
        f"cannot be used: {why}",
        field=str(path),
        remedy="Make room, or check the permissions of service.data_directory; a damaged file can be moved away.",
    )
