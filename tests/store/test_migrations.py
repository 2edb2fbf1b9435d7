"""A database of an older version, made by the statements of that time, becomes the present one with all it holds."""

import json
import sqlite3
import struct
import sys
from contextlib import closing

import pytest
from sqlalchemy import create_engine, inspect

from autotuner.errors import StorageError
from autotuner.service.archive.storage.database_address import FILE
from autotuner.service.archive.storage.migrations import STEPS

VERSION_1 = """
CREATE TABLE schema_version (version INTEGER NOT NULL);
CREATE TABLE tunings (
    id VARCHAR(64) NOT NULL, loop VARCHAR(200) NOT NULL, started_at VARCHAR(40) NOT NULL, actor VARCHAR(200) NOT NULL,
    request TEXT NOT NULL, told TEXT NOT NULL, recording_settings TEXT NOT NULL, outcome VARCHAR(20), PRIMARY KEY (id));
CREATE INDEX ix_tunings_loop ON tunings (loop);
CREATE INDEX ix_tunings_started_at ON tunings (started_at);
CREATE TABLE recording_chunks (
    tuning_id VARCHAR(64) NOT NULL, first INTEGER NOT NULL, samples BLOB NOT NULL, PRIMARY KEY (tuning_id, first));
CREATE TABLE events (
    tuning_id VARCHAR(64) NOT NULL, number INTEGER NOT NULL, t_s FLOAT NOT NULL, data TEXT NOT NULL,
    PRIMARY KEY (tuning_id, number));
CREATE TABLE audit (
    number INTEGER NOT NULL, at VARCHAR(40) NOT NULL, actor VARCHAR(200) NOT NULL, action VARCHAR(400) NOT NULL,
    status INTEGER NOT NULL, PRIMARY KEY (number));
CREATE TRIGGER audit_no_update BEFORE UPDATE ON audit BEGIN SELECT RAISE(ABORT, 'the audit is append-only'); END;
CREATE TRIGGER audit_no_delete BEFORE DELETE ON audit BEGIN SELECT RAISE(ABORT, 'the audit is append-only'); END;
INSERT INTO schema_version VALUES (1);
"""
ROW = [0.1, 20.5, 40.0, float("nan"), 0.001, 0.12]


@pytest.fixture
def old(tmp_path):
    """A file of version 1 with a tuning in it."""
    told = {"id": "old", "verdict": {"outcome": "done", "code": "done"}, "phase": "ended"}
    with closing(sqlite3.connect(tmp_path / FILE)) as connection, connection:
        connection.executescript(VERSION_1)
        row = ("old", "heater", "2025-06-01", "alice", json.dumps({"goal": "fast"}), json.dumps(told), "{}", "done")
        connection.execute("INSERT INTO tunings VALUES (?, ?, ?, ?, ?, ?, ?, ?)", row)
        connection.execute("INSERT INTO recording_chunks VALUES ('old', 0, ?)", [struct.pack("<6d", *ROW)])
        connection.execute("""INSERT INTO events VALUES ('old', 0, 0.0, '{"type": "phase", "t": 0.0}')""")
        connection.execute("INSERT INTO audit VALUES (1, '2025-06-01', 'alice', 'POST', 202)")
    return tmp_path / FILE


def test_what_an_old_file_holds_is_there(old, database):
    one = database()
    kept = one.find("old")
    (sample,) = kept.samples
    assert (sample.t, sample.pv, sample.output, sample.lateness_s, sample.written_s) == (0.1, 20.5, 40.0, 0.001, 0.12)
    assert kept.head.request == {"goal": "fast"}
    assert kept.events == [(0, {"type": "phase", "t": 0.0})]
    assert kept.versions == {}
    assert [row.outcome for row in one.listed(None, 10)] == ["done"]
    assert one.audit(10)[0]["actor"] == "alice"
    assert one.gains("old") == []


@pytest.mark.parametrize("begun", ["old", "new"])
def test_every_way_leads_to_the_same_tables(begun, request, database, tables, tmp_path):
    if begun == "old":
        request.getfixturevalue("old")
    database().close()
    engine = create_engine(f"sqlite:///{tmp_path / FILE}")
    found = inspect(engine)
    assert set(found.get_table_names()) == set(tables)
    for name, table in tables.items():
        columns = {column["name"]: (str(column["type"]), column["nullable"]) for column in found.get_columns(name)}
        wanted = {column.name: (column.type.compile(engine.dialect), column.nullable) for column in table.columns}
        assert columns == wanted, name
        indexed = {tuple(index["column_names"]) for index in found.get_indexes(name)}
        assert indexed == {tuple(index.columns.keys()) for index in table.indexes}, name
    engine.dispose()


def test_a_newer_database_is_refused_and_left_as_it_is(old, database):
    database().close()
    with closing(sqlite3.connect(old)) as connection, connection:
        connection.execute("UPDATE schema_version SET version = 99")
    before = old.read_bytes()
    with pytest.raises(StorageError, match=f"newer program .version 99, this one knows {len(STEPS)}.") as told:
        database()
    assert "Use the newer program" in str(told.value)
    assert old.read_bytes() == before


def test_a_migration_that_fails_changes_nothing(old, database, monkeypatch):
    broken = (*STEPS[1], "CREATE TABLE tunings (x)")
    monkeypatch.setattr("autotuner.service.archive.storage.migrations.STEPS", (STEPS[0], broken))
    with pytest.raises(StorageError, match="already exists"):
        database()
    with closing(sqlite3.connect(old)) as connection:
        assert connection.execute("SELECT version FROM schema_version").fetchall() == [(1,)]
        assert "code" not in [row[1] for row in connection.execute("PRAGMA table_info(tunings)")]
        assert connection.execute("SELECT count(*) FROM sqlite_master WHERE name = 'gains'").fetchone() == (0,)


def test_tunings_are_numbered_by_their_times_and_nothing_is_lost(old_database, database, tmp_path, head):
    one = old_database(f"sqlite:///{tmp_path / FILE}").check_that_nothing_is_lost(database)
    assert one.begin(head("new", "2001-01-01")).number == 5
    assert [row.id for row in one.listed(None, 1)] == ["new"]


@pytest.mark.skipif(sys.platform == "win32", reason="there is no SIGKILL")
@pytest.mark.parametrize("at", ["UPDATE tunings", "DROP INDEX", "UPDATE schema_version"])
def test_killed_in_a_migration_it_is_of_the_old_version_and_then_of_the_new(
    at, old_database, database, killed_at, tmp_path
):
    old = old_database(f"sqlite:///{tmp_path / FILE}")
    killed_at(old.address, at)
    assert (old.version(), old.held()) == (3, old.before)
    old.check_that_nothing_is_lost(database)
