"""Tunings are kept as they happen, and a database that cannot be written disturbs none of them."""

import asyncio
import logging
import shutil
import sqlite3
from types import SimpleNamespace

import pytest

from autotuner.application.computing.compute_pool import InPlace
from autotuner.application.recovery import earlier_tuning
from autotuner.control.records.lease_record import LeaseRecord
from autotuner.control.reporting.events import Ended, OutputRestored, PhaseChanged, SampleTaken
from autotuner.errors import ConfigurationError, StorageError
from autotuner.service.archive import archive as archive_module
from autotuner.service.archive.archive_record import Deed
from autotuner.service.archive.storage.database_address import FILE

pytestmark = pytest.mark.virtual_time


def told(events):
    return [one.to_dict() for one in events]


async def test_a_tuning_is_kept_with_all_that_happened(archive, shop):
    keeping = archive()
    keeping.open(shop)
    tuning = await shop.conduct(pool=InPlace())
    await keeping.flush()
    past = await keeping.find("t1")
    assert past.to_dict() == tuning.to_dict()
    assert told(past.events) == told(tuning.events)
    assert [one.to_dict() async for one in past.follow()] == told(tuning.events)
    assert past.recording().to_csv() == tuning.recording().to_csv()
    assert past.recording().settings == tuning.recording().settings
    assert past.model == tuning.analysis.identification.model
    assert (past.kept.head.actor, past.kept.head.request["goal"]) == ("local", "balanced")
    (row,) = await keeping.listed(None, 10, ())
    assert (row.id, row.outcome, row.code, row.phase) == ("t1", "done", "identified", "ended")
    await keeping.close()


async def test_samples_are_written_while_it_runs(archive, shop, monkeypatch):
    monkeypatch.setattr(archive_module, "IN_PLACE_PERIOD_S", 25.0)
    keeping = archive()
    tuning, table, backend = shop.make()
    shop.busy = True
    keeping.open(shop)
    running = asyncio.create_task(tuning.conduct(table, backend, None))
    await asyncio.sleep(30.0)
    past = await keeping.find("t1")
    missing_s = tuning.samples[-1].t - past.kept.samples[-1].t
    assert 0.0 <= missing_s <= archive_module.IN_PLACE_PERIOD_S + 0.5
    assert past.to_dict()["verdict"]["code"] == "interrupted"
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    shop.busy = False
    await keeping.close()


async def test_gains_before_and_after_are_kept(archive, shop):
    keeping = archive()
    keeping.open(shop)
    tuning = await shop.conduct()
    await keeping.flush()
    applied = SimpleNamespace(loop="heater", at="now", old={"kp": 1.0}, now={"kp": 2.0}, to_dict=lambda: {"form": "x"})
    tuning.applied = applied
    await keeping.flush()
    assert (await keeping.find("t1")).to_dict()["applied"] == {"form": "x"}
    tuning.applied, tuning.device_gains = None, {"kp": 1.0}
    await keeping.flush()
    await keeping.flush()
    rows = [(row["action"], row["before"], row["after"]) for row in await keeping.gains("t1")]
    assert rows == [("applied", {"kp": 1.0}, {"kp": 2.0}), ("rolled back", {"kp": 2.0}, {"kp": 1.0})]
    await keeping.close()


async def test_an_interrupted_tuning_is_gone_on_with(archive, shop, tmp_path):
    """Its journal has samples that the killed archive had not written; the way back is told behind them."""
    first = archive()
    tuning = await shop.conduct()
    all_samples = list(tuning.samples)
    tuning.events = [one for one in tuning.events if not isinstance(one, Ended)][:60]
    tuning.verdict = None
    first.open(shop)
    await first.flush()
    await first.close()
    before = len((await kept_by(archive, "t1")).kept.samples)
    again = earlier_tuning(
        LeaseRecord(tmp_path, "t1", "heater", "key", tuning.started_at, {"settings": {}}, samples=all_samples),
        shop.make("other")[1],
    )
    shop.tunings = {"t1": again}
    second = archive()
    second.open(shop)
    again.publish(OutputRestored(0.0, 40.0, verified=True))
    await second.flush()
    past = await second.find("t1")
    assert before < len(all_samples) == len(past.kept.samples)
    assert isinstance(again.events[len(all_samples) - 1], SampleTaken)
    restored = [one for one in told(past.events) if one["type"] == "restored"]
    assert restored == [{"type": "restored", "t": 0.0, "output": 40.0, "verified": True}]
    phases = sum(isinstance(one, PhaseChanged) for one in tuning.events)
    assert sum(one["type"] == "phase" for one in told(past.events)) == phases
    await second.close()


async def test_with_a_clock_that_was_set_back_the_newest_are_still_kept(archive, shop):
    keeping = archive(tunings=2)
    keeping.open(shop)
    for k, day in enumerate(["2026-03-02", "2026-03-01", "2026-02-01", "2026-01-01"]):
        tuning, table, backend = shop.make(f"t{k}")
        tuning.started_at = day
        await tuning.conduct(table, backend, shop.pool)
        await keeping.flush()
    assert [row.id for row in await keeping.listed(None, 10, ())] == ["t3", "t2"]
    assert [keeping.number_of(name) for name in ("t0", "t3", "none")] == [1, 4, None]
    await keeping.close()


async def kept_by(archive, tuning_id):
    keeping = archive()
    past = await keeping.find(tuning_id)
    await keeping.close()
    return past


async def test_only_the_newest_are_kept_and_never_a_running_one_is_lost(archive, shop):
    keeping = archive(tunings=2)
    keeping.open(shop)
    running, _, _ = shop.make("running")
    await keeping.flush()
    for k in range(4):
        await shop.conduct(f"t{k}")
        await keeping.flush()
    assert [row.id for row in await keeping.listed(None, 10, ())] == ["t3", "t2", "running"]
    assert not running.ended
    await keeping.close()


def fill(keeping):
    """Let the disk be full for SQLite; return what makes room again."""
    engine, full = keeping._database._engine, [True]
    connected = engine._connected

    def limited():
        connection = connected()
        if full[0]:
            pages = connection.execute("PRAGMA page_count").fetchone()[0]
            connection.execute(f"PRAGMA max_page_count = {pages}")
        else:
            connection.execute("PRAGMA max_page_count = 1000000")
        return connection

    def make_room():
        full[0] = False
        engine.close()

    engine.give_room_back()  # what making the tables has left
    engine._connected = limited
    engine.close()
    return make_room


async def test_a_full_disk_disturbs_no_tuning_and_loses_nothing_once_there_is_room(archive, shop, caplog):
    keeping = archive()
    keeping.open(shop)
    await keeping.room()
    make_room = fill(keeping)
    tuning = await shop.conduct()
    assert tuning.verdict.code == "no_result"
    assert tuning.controller.restored
    await keeping.flush()
    assert "disk is full" in str(keeping.trouble)
    assert "Make room" in keeping.trouble.remedy
    assert caplog.text.count("are not kept now") == 1
    caplog.set_level(logging.INFO)
    make_room()
    await keeping.flush()
    assert keeping.trouble is None
    assert "are kept again" in caplog.text
    await keeping.room()
    assert told((await keeping.find("t1")).events) == told(tuning.events)
    await keeping.close()


async def test_too_little_room_refuses_a_start(archive, shop, monkeypatch):
    keeping = archive()
    keeping.open(shop)
    await keeping.room()
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=10 * 2**20))
    with pytest.raises(StorageError, match="10 MiB are left"):
        await keeping.room()
    await keeping.close()


def garbage(path):
    path.write_bytes(b"no database" * 1000)


def half(path):
    with sqlite3.connect(path) as connection:
        connection.executescript(
            "CREATE TABLE schema_version (version INTEGER); INSERT INTO schema_version VALUES (2); CREATE TABLE x (y);"
            "WITH RECURSIVE n (k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n WHERE k < 2000) "
            "INSERT INTO x SELECT randomblob(100) FROM n;"
        )
    connection.close()
    content = bytearray(path.read_bytes())
    content[100:4096] = b"\xff" * 3996
    path.write_bytes(content)


def newer(path):
    with sqlite3.connect(path) as connection:
        connection.executescript("CREATE TABLE schema_version (version INTEGER); INSERT INTO schema_version VALUES (9)")
    connection.close()


def a_folder(path):
    path.mkdir()


@pytest.mark.parametrize(
    ("harm", "says", "advises"),
    [
        (garbage, "not a database", "move the file"),
        (half, "malformed", "move the file"),
        (newer, "newer program", "Use the newer program"),
        (a_folder, "unable to open", "Let the service write there"),
    ],
)
async def test_a_database_that_cannot_be_used_refuses_starts_and_disturbs_none(
    harm, says, advises, archive, shop, tmp_path
):
    harm(tmp_path / FILE)
    keeping = archive()
    keeping.open(shop)
    for ask in (keeping.room, lambda: keeping.find("t1"), lambda: keeping.listed(None, 1, ())):
        with pytest.raises(StorageError, match=says) as refusal:
            await ask()
        assert advises in refusal.value.remedy
        assert str(tmp_path) in str(refusal.value) or harm is newer
    tuning = await shop.conduct()
    assert tuning.verdict.code == "no_result"
    await keeping.note(Deed("now", "alice", "POST", 202))
    await keeping.flush()
    assert says in str(keeping.trouble)
    await keeping.close()


async def test_a_fault_of_ours_is_told_and_the_next_look_comes(archive, shop, caplog, monkeypatch):
    keeping = archive()
    keeping.open(shop)
    tuning = await shop.conduct()
    with monkeypatch.context() as broken:
        broken.setattr(type(tuning), "to_dict", lambda _: 1 / 0)
        await keeping.flush()
    assert "ZeroDivisionError in this program" in str(keeping.trouble)
    assert "could not be archived" in caplog.text
    await keeping.flush()
    assert keeping.trouble is None
    assert (await keeping.find("t1")).to_dict()["verdict"]["code"] == "no_result"
    await keeping.close()


def test_a_database_without_its_driver_is_refused_at_the_start(archive):
    with pytest.raises(ConfigurationError, match="driver that is not installed"):
        archive(url="oracle+cx_oracle_none://me@host/name")


async def test_a_read_only_database_refuses_starts_and_can_be_read(archive, shop, tmp_path):
    writing = archive()
    writing.open(shop)
    await shop.conduct()
    await writing.flush()
    await writing.close()
    reading = archive(url=f"sqlite:///file:{tmp_path / FILE}?mode=ro&uri=true")
    with pytest.raises(StorageError, match="readonly") as refusal:
        await reading.room()
    assert "Let the service write there" in refusal.value.remedy
    await reading.close()


async def test_a_folder_that_cannot_be_made_refuses_starts(archive, shop, tmp_path):
    (tmp_path / "file").write_text("")
    keeping = archive(tmp_path / "file" / "data")
    keeping.open(shop)
    with pytest.raises(StorageError, match="Not a directory"):
        await keeping.room()
    assert (await shop.conduct()).verdict.code == "no_result"
    await keeping.close()
