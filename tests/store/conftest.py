"""Shared by the tests of the store: databases in a folder of the test, and a tuning to be kept."""

import contextlib
import math
import signal
import subprocess
import sys

import pytest
from sqlalchemy import Column, Float, Integer, LargeBinary, MetaData, String, Table, Text

from autotuner.application.tuning_run import TuningRequest, TuningRun
from autotuner.configuration import parse_configuration
from autotuner.control.devices.plugins import make_backend
from autotuner.core.recording import Sample
from autotuner.errors import InputError
from autotuner.service.archive.archive import Archive
from autotuner.service.archive.archive_record import Head
from autotuner.service.archive.retention import Retention
from autotuner.service.archive.storage import migrations
from autotuner.service.archive.storage.database import Database
from autotuner.service.archive.storage.database_address import address_of, opened
from autotuner.service.archive.storage.packed import pack

HEATER = {
    "driver": "simulated",
    "sample_time_s": 0.5,
    "limits": {"output": [0.0, 100.0], "pv": [0.0, 250.0]},
    "relay": {"amplitude": 10.0, "check": False},
    "device": {
        "plant": {"structure": "fopdt", "K": 2.0, "T": 10.0, "D": 1.5},
        "output0": 40.0,
        "pv0": 80.0,
        "noise": 0.05,
        "seed": 1,
    },
}
"""A loop whose tuning is over after some hundred samples."""


@pytest.fixture
def database(tmp_path):
    """Return a function that opens the database of the test; all are closed at its end."""
    opened = []

    def open_it(url=None):
        opened.append(Database(address_of(tmp_path, url)))
        return opened[-1]

    yield open_it
    for one in opened:
        one.close()


@pytest.fixture
def head():
    """Return a function that makes the head of a tuning."""

    def make(name="t1", at="2026-01-01T00:00:00.000+00:00", loop="heater"):
        return Head(name, loop, at, "alice", {"structure": "auto", "goal": "balanced", "rule": None})

    return make


@pytest.fixture
def samples():
    """Return a function that makes samples with every kind of number that one may hold."""

    def make(first, count):
        return [
            Sample(0.1 * k, math.nan if k % 7 == 3 else 1.0 / 3.0 + k, -0.0 if k % 2 else 40.0, 5e-324, 1e-3, 0.1 * k)
            for k in range(first, first + count)
        ]

    return make


@pytest.fixture
def shown():
    """Return a function that shows samples as texts, so that nan equals nan and -0.0 differs from 0.0."""
    return lambda many: [repr(sample) for sample in many]


THIRD = 3
"""The version before tunings had a number."""
AGES = [("c", "2026-01-02"), ("b", "2026-01-01"), ("d", "2026-01-02"), ("a", "2026-01-03")]
"""Tunings and their times, in no order."""
IN_ORDER = ["b", "c", "d", "a"]
FILLED_BY = (
    """INSERT INTO tunings VALUES
    (:id, 'heater', :day, 'alice', '{}', '{"a": 1}', '{}', 'done', 'done', 'ended', '{}')""",
    "INSERT INTO recording_chunks VALUES (:id, 0, :samples)",
    """INSERT INTO events VALUES (:id, 1, 0.5, '{"type": "phase"}')""",
    """INSERT INTO gains (tuning_id, loop, at, action, before, after)
    VALUES (:id, 'heater', :day, 'applied', '{}', '{}')""",
    "INSERT INTO audit (at, actor, action, status, tuning_id) VALUES (:day, 'alice', 'POST', 202, :id)",
)
READ_BY = {
    "tunings": "SELECT * FROM tunings",
    "recording_chunks": "SELECT * FROM recording_chunks",
    "events": "SELECT * FROM events",
    "gains": "SELECT * FROM gains",
    "audit": "SELECT * FROM audit",
}


class OldDatabase:
    """A database as an earlier program has left it: made by the steps of its time, with rows in every table."""

    def __init__(self, address, monkeypatch):
        self.address = address
        with monkeypatch.context() as earlier, self._connected(writing=True) as connection:
            earlier.setattr(migrations, "STEPS", migrations.STEPS[:THIRD])
            migrations.migrate(connection)
            for name, day in AGES:
                self._fill(connection, name, day)
        self.before = self.held()

    @contextlib.contextmanager
    def _connected(self, **kinds):
        with contextlib.closing(opened(self.address)) as engine, engine.transaction(**kinds) as connection:
            yield connection

    def _fill(self, connection, name, day):
        row = {"id": name, "day": day, "samples": pack([Sample(0.1, 20.5, 40.0)])}
        for statement in FILLED_BY:
            connection.rows(statement, {key: value for key, value in row.items() if f":{key}" in statement})

    def held(self):
        """Return every row of every table."""
        with self._connected() as connection:
            return {name: sorted(connection.rows(asked), key=repr) for name, asked in READ_BY.items()}

    def version(self):
        with self._connected() as connection:
            return connection.rows("SELECT version FROM schema_version")[0]["version"]

    def check_that_nothing_is_lost(self, database):
        """Open it as it is now, and compare."""
        one = database(self.address)
        assert [row.id for row in one.listed(None, 10)] == IN_ORDER[::-1]
        assert [name for name, _ in one.sizes()] == IN_ORDER[::-1]
        assert self.version() == len(migrations.STEPS)
        held = self.held()
        numbers = {row["id"]: row.pop("number") for row in held["tunings"]}
        assert {row.pop("result") for row in held["tunings"]} == {None}  # what a list shows is not known of them
        assert [numbers[name] for name in IN_ORDER] == [1, 2, 3, 4]
        assert held == self.before
        return one


@pytest.fixture
def old_database(monkeypatch):
    """Return a function that makes a database of an earlier program at an address."""
    return lambda address: OldDatabase(address, monkeypatch)


DYING = """
import os, signal, sys
from autotuner.service.archive.storage import database_address, migrations
address, at = sys.argv[1:]
class Dying:
    def __init__(self, inner):
        self.dialect, self.has_table, self._inner = inner.dialect, inner.has_table, inner
    def rows(self, statement, values=None):
        if statement.startswith(at):
            os.kill(os.getpid(), signal.SIGKILL)
        return self._inner.rows(statement, values)
with database_address.opened(address).transaction(writing=True) as inner:
    migrations.migrate(Dying(inner))
"""


@pytest.fixture
def killed_at():
    """Return a function that has a program of its own migrate a database, and be killed before a statement of it."""

    def run(address, statement):
        ran = subprocess.run([sys.executable, "-c", DYING, address, statement], check=False, capture_output=True)
        assert ran.returncode == -signal.SIGKILL, ran.stderr

    return run


class Nothing:
    """ComputePool that finds nothing, at once."""

    async def run(self, *_):
        raise InputError("nothing was found", remedy="None.")

    async def aside(self, function):
        return function()


class Shop:
    """Tunings in memory, as the service has them."""

    pool = Nothing()

    def __init__(self):
        self.tunings = {}
        self.busy = False
        self.recovered_loops = []

    def make(self, name="t1", loop="heater"):
        table = parse_configuration({"loops": {loop: HEATER}}, "test").loop(loop)
        tuning = self.tunings[name] = TuningRun(name, loop, TuningRequest(table.experiment_settings()))
        return tuning, table, make_backend("simulated", table.device, "loops.heater")

    async def conduct(self, name="t1", pool=None):
        """Run a tuning to its end; without arithmetic it ends with `no_result`."""
        tuning, table, backend = self.make(name)
        self.busy = True
        await tuning.conduct(table, backend, pool or self.pool)
        self.busy = False
        return tuning


@pytest.fixture(scope="session")
def new_shop():
    return Shop


@pytest.fixture
def shop():
    return Shop()


@pytest.fixture
def archive(tmp_path):
    """Return a function that makes an archive for virtual time."""

    def make(folder=tmp_path, url=None, tunings=1000, size_bytes=10**9):
        return Archive(url, folder, Retention(tunings, size_bytes), in_place=True)

    return make


@pytest.fixture(scope="session")
def tables():
    """Return the tables of the present version, as SQLAlchemy describes them: the judge of our own statements."""
    metadata = MetaData()
    Table("schema_version", metadata, Column("version", Integer, nullable=False))
    Table(
        "tunings",
        metadata,
        Column("id", String(64), primary_key=True),
        Column("loop", String(200), nullable=False, index=True),
        Column("started_at", String(40), nullable=False),
        Column("actor", String(200), nullable=False),
        Column("request", Text, nullable=False),
        Column("told", Text, nullable=False),
        Column("recording_settings", Text, nullable=False),
        Column("outcome", String(20)),
        Column("code", String(60)),
        Column("phase", String(20)),
        Column("versions", Text),
        Column("result", Text),
        Column("number", Integer, nullable=False, index=True),
    )
    Table(
        "recording_chunks",
        metadata,
        Column("tuning_id", String(64), primary_key=True),
        Column("first", Integer, primary_key=True),
        Column("samples", LargeBinary, nullable=False),
    )
    Table(
        "events",
        metadata,
        Column("tuning_id", String(64), primary_key=True),
        Column("number", Integer, primary_key=True),
        Column("t_s", Float, nullable=False),
        Column("data", Text, nullable=False),
    )
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
    Table(
        "audit",
        metadata,
        Column("number", Integer, primary_key=True, autoincrement=True),
        Column("at", String(40), nullable=False),
        Column("actor", String(200), nullable=False),
        Column("action", String(400), nullable=False),
        Column("status", Integer, nullable=False),
        Column("loop", String(200), index=True),
        Column("tuning_id", String(64)),
    )
    return metadata.tables
