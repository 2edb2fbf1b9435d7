"""Shared by the tests of the store: databases in a folder of the test, and a tuning to be kept."""

import math

import pytest
from sqlalchemy import Column, Float, Integer, LargeBinary, MetaData, String, Table, Text

from autotuner.configuration import parse_configuration
from autotuner.core.recording import Sample
from autotuner.errors import InputError
from autotuner.runtime.plugins import make_backend
from autotuner.runtime.tuning import Tuning, TuningRequest
from autotuner.store.archive import Archive
from autotuner.store.connection import address_of
from autotuner.store.database import Database
from autotuner.store.kept import Head
from autotuner.store.retention import Retention

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


class Nothing:
    """Arithmetic that finds nothing, at once."""

    async def run(self, *_):
        raise InputError("nothing was found", remedy="None.")

    async def aside(self, function):
        return function()


class Shop:
    """Tunings in memory, as the service has them."""

    def __init__(self):
        self.tunings = {}
        self.busy = False
        self.given_back = []
        self.giving_back = False

    def make(self, name="t1", loop="heater"):
        table = parse_configuration({"loops": {loop: HEATER}}, "test").loop(loop)
        tuning = self.tunings[name] = Tuning(name, loop, TuningRequest(table.experiment_settings()))
        return tuning, table, make_backend("simulated", table.device, "loops.heater")

    async def conduct(self, name="t1", arithmetic=None):
        """Run a tuning to its end; without arithmetic it ends with `no_result`."""
        tuning, table, backend = self.make(name)
        self.busy = True
        await tuning.conduct(table, backend, arithmetic or Nothing())
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
        Column("started_at", String(40), nullable=False, index=True),
        Column("actor", String(200), nullable=False),
        Column("request", Text, nullable=False),
        Column("told", Text, nullable=False),
        Column("recording_settings", Text, nullable=False),
        Column("outcome", String(20)),
        Column("code", String(60)),
        Column("phase", String(20)),
        Column("versions", Text),
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
