"""Another database by its address: a real PostgreSQL server, started by the test where one is installed."""

import os
import pwd
import shutil
import socket
import subprocess
import tempfile
from pathlib import Path

import pytest
from sqlalchemy import create_engine, inspect, text
from sqlalchemy.exc import SQLAlchemyError

from autotuner.errors import ConfigurationError, StorageError
from autotuner.service.archive.archive import Archive
from autotuner.service.archive.archive_record import Deed, GainsChange, News, Progress, TuningSnapshot
from autotuner.service.archive.retention import Retention
from autotuner.service.archive.storage.database import Database
from autotuner.service.archive.storage.database_address import address_of, shown

pytestmark = pytest.mark.realtime

PLACES = ("/usr/lib/postgresql/*/bin", "/usr/pgsql-*/bin", "/opt/homebrew/opt/postgresql*/bin")
"""Where packages put the programs that are on no search path."""
SECRET = "no-one-sees-this"  # noqa: S105 - of a server that lives as long as the test


def program(name):
    """Return the path of a program of PostgreSQL; skip where there is none."""
    beside = [path for place in PLACES for path in sorted(Path("/").glob(f"{place[1:]}/{name}"))]
    found = shutil.which(name) or next(map(str, beside), None)
    if found is None:
        pytest.skip(f"no PostgreSQL server is installed: there is no {name}")
    return found


def as_user(folder):
    """Return what runs a program as somebody whom the server accepts: it refuses root."""
    if os.geteuid() != 0:
        return {}
    try:
        no_others = pwd.getpwnam("nobody")
    except KeyError:
        pytest.skip("PostgreSQL does not run as root, and there is no other user")
    os.chown(folder, no_others.pw_uid, no_others.pw_gid)
    return {"user": no_others.pw_uid, "group": no_others.pw_gid, "extra_groups": []}


@pytest.fixture(scope="module")
def folder():
    """A folder that another user may reach, which those of the test runner are not."""
    with tempfile.TemporaryDirectory(prefix="postgresql-") as name:
        yield Path(name)


@pytest.fixture(scope="module")
def server(folder):
    """The address of an empty server on loopback."""
    pytest.importorskip("pg8000", reason="the driver pg8000 is not installed: relay-autotuner[postgresql]")
    initdb, control = program("initdb"), program("pg_ctl")
    who = as_user(folder)
    data, password = folder / "data", folder / "password"
    password.write_text(SECRET)
    password.chmod(0o644)
    quiet = {"capture_output": True, "text": True, "cwd": folder, **who}
    words = ["--username=tuner", "--auth=scram-sha-256", f"--pwfile={password}", "--no-sync", "--encoding=UTF8"]
    made = subprocess.run([initdb, "-D", data, *words], check=False, **quiet)
    if made.returncode:
        pytest.skip(f"no PostgreSQL server can be made here: {made.stderr.strip()}")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    options = f"-c listen_addresses=127.0.0.1 -c port={port} -c unix_socket_directories= -c fsync=off"
    begun = subprocess.run(
        [control, "-D", data, "-w", "-l", folder / "log", "-o", options, "start"],
        check=False,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        cwd=folder,
        **who,
    )
    if begun.returncode:
        pytest.skip("the PostgreSQL server does not start here")
    yield f"postgresql+pg8000://tuner:{SECRET}@127.0.0.1:{port}/postgres"
    subprocess.run([control, "-D", data, "-m", "immediate", "stop"], check=True, **quiet)


@pytest.fixture
def url(server):
    """The address of the server, emptied after the test."""
    yield server
    engine = create_engine(server)
    with engine.begin() as connection:
        connection.execute(text("DROP SCHEMA public CASCADE"))
        connection.execute(text("CREATE SCHEMA public"))
    engine.dispose()


TOLD = TuningSnapshot(
    {"id": "t1", "verdict": {"code": "done"}}, {"relay": 3.0}, "done", "done", "ended", {"numpy": "2"}
)


def test_a_tuning_comes_back_bit_by_bit(url, database, head, samples, shown):
    one = database(url)
    assert one.begin(head()) == Progress(1)
    change = GainsChange("heater", "now", "applied", {"kp": 1.0}, {"kp": 2.0})
    event = {"type": "phase", "t": 0.1, "phase": "relay"}
    news = News("t1", 0, samples(0, 9), [(3, event)], TOLD, [change])
    one.write([news])
    one.write([News("t1", 0, samples(0, 9), [(3, event)])])
    assert one.begin(head()) == Progress(1, 9, 10, "done")
    kept = one.find("t1")
    assert shown(kept.samples) == shown(samples(0, 9))
    assert (kept.head, kept.reported, kept.events) == (head(), TOLD.whole, [(3, event)])
    assert [row["after"] for row in one.gains("t1")] == [{"kp": 2.0}]
    assert [row.code for row in one.listed("heater", 10)] == ["done"]
    assert dict(one.sizes())["t1"] >= 9 * 48
    one.probe()
    one.forget(["t1"])
    assert one.find("t1") is None


def test_the_audit_is_only_added_to(url, database):
    one = database(url)
    one.note(Deed("now", "bob", "POST /v1/reload", 200))
    engine = create_engine(url)
    for statement in ("DELETE FROM audit", "UPDATE audit SET actor = 'eve'", "TRUNCATE audit"):
        with pytest.raises(SQLAlchemyError, match="append-only"), engine.begin() as connection:
            connection.execute(text(statement))
    engine.dispose()
    assert [row["actor"] for row in one.audit(10)] == ["bob"]


def test_the_tables_are_those_of_the_present_version(url, database, tables):
    database(url)
    engine = create_engine(url)
    found = inspect(engine)
    assert set(found.get_table_names()) == set(tables)
    for name, table in tables.items():
        assert {column["name"] for column in found.get_columns(name)} == set(table.columns.keys())
    engine.dispose()


@pytest.mark.parametrize("at", ["UPDATE tunings", "UPDATE schema_version"])
def test_killed_in_a_migration_it_is_of_the_old_version_and_then_of_the_new(
    at, url, old_database, database, killed_at, head
):
    old = old_database(url)
    killed_at(url, at)
    assert (old.version(), old.held()) == (3, old.before)
    one = old.check_that_nothing_is_lost(database)
    assert one.begin(head("new", "2001-01-01")).number == 5
    assert [row.id for row in one.listed(None, 1)] == ["new"]


@pytest.mark.virtual_time
async def test_a_tuning_is_kept_there(url, shop, tmp_path):
    keeping = Archive(url, tmp_path, Retention(10, 10**9), in_place=True)
    keeping.open(shop)
    await keeping.room()
    tuning = await shop.conduct()
    await keeping.flush()
    assert keeping.trouble is None
    past = await keeping.find("t1")
    assert [one.to_dict() for one in past.events] == [one.to_dict() for one in tuning.events]
    await keeping.close()


def test_a_server_that_does_not_answer_is_told_without_its_password(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    pytest.importorskip("pg8000")
    with pytest.raises(StorageError) as refusal:
        Database(address_of(tmp_path, f"postgresql+pg8000://tuner:{SECRET}@127.0.0.1:{port}/postgres"))
    assert "service.database_url" in refusal.value.remedy
    assert SECRET not in str(refusal.value)


@pytest.mark.parametrize("given", ["no address", "oracel://me:no-one-sees-this@x/y", "postgresql+pgnone://a@b/c"])
def test_an_address_that_cannot_be_used_is_told_at_once(given, tmp_path):
    with pytest.raises(ConfigurationError) as refusal:
        Database(address_of(tmp_path, given))
    assert refusal.value.field == "service.database_url"
    assert SECRET not in str(refusal.value)


def test_a_password_is_never_shown(tmp_path):
    assert SECRET not in shown(address_of(tmp_path, f"postgresql://me:{SECRET}@host/name"))
