"""What is written comes back, bit by bit and in its order; the audit is only added to."""

import contextlib
import sqlite3

import pytest

from autotuner.service.archive.archive_record import Deed, GainsChange, News, Progress, TuningSnapshot
from autotuner.service.archive.storage.database_address import FILE

ENDED = TuningSnapshot(
    {"id": "t1", "verdict": {"code": "done"}}, {"relay": 3.0}, "done", "done", "ended", {"numpy": "2"}
)


def test_a_tuning_comes_back_bit_by_bit(database, head, samples, shown):
    first, then = samples(0, 5), samples(5, 3)
    event = {"type": "phase", "t": 0.2, "phase": "relay"}
    change = GainsChange("heater", "now", "applied", {"kp": 1.0}, {"kp": 1.25})
    one = database()
    assert one.begin(head()) == Progress(1)
    one.write([News("t1", 0, first, [(2, event)])])
    one.write([News("t1", 5, then, reported=ENDED, changes=[change])])
    one.close()
    kept = database().find("t1")
    assert kept.head == head()
    assert shown(kept.samples) == shown([*first, *then])
    assert kept.events == [(2, event)]
    assert (kept.reported, kept.recording_settings, kept.versions) == (ENDED.whole, {"relay": 3.0}, {"numpy": "2"})
    (row,) = database().gains("t1")
    assert (row["before"], row["after"], row["action"]) == ({"kp": 1.0}, {"kp": 1.25}, "applied")


def test_what_is_written_twice_is_there_once(database, head, samples, shown):
    """A transaction whose success was not heard of is repeated."""
    one = database()
    one.begin(head())
    news = News("t1", 0, samples(0, 4), [(1, {"type": "link", "t": 0.1, "message": "a"})])
    one.write([news])
    one.write([news])
    kept = one.find("t1")
    assert shown(kept.samples) == shown(samples(0, 4))
    assert len(kept.events) == 1


def test_a_tuning_that_is_known_is_gone_on_with(database, head, samples):
    one = database()
    one.begin(head())
    one.write([News("t1", 0, samples(0, 4), [(1, {"type": "link", "t": 0.1, "message": "a"})])])
    assert one.begin(head()) == Progress(1, 4, 5)
    one.write([News("t1", reported=ENDED)])
    assert one.begin(head()) == Progress(1, 4, 5, ENDED.code)


def test_lists_are_of_the_newest_first(database, head):
    """By the order in which they were kept: the clock was set back after the first, and forward again."""
    one = database()
    for name, day, loop in [("t1", 9, "a"), ("t2", 1, "a"), ("t3", 3, "b")]:
        one.begin(head(name, f"2026-01-0{day}", loop))
    assert one.begin(head("t1")).number == 1
    assert [row.id for row in one.listed(None, 10)] == ["t3", "t2", "t1"]
    assert [name for name, _ in one.sizes()] == ["t3", "t2", "t1"]
    assert [row.id for row in one.listed("a", 10)] == ["t2", "t1"]
    assert [row.id for row in one.listed(None, 1)] == ["t3"]
    assert [row.id for row in one.listed(None, 10, {"t3"})] == ["t2", "t1"]
    assert one.find("t9") is None


def test_a_number_is_given_once(database, head):
    """Also where the oldest, and all but the newest, are forgotten."""
    one = database()
    numbers = [one.begin(head(f"t{k}")).number for k in range(3)]
    one.forget(["t0", "t1"])
    assert [*numbers, one.begin(head("t3")).number] == [1, 2, 3, 4]


def test_the_audit_is_only_added_to(database, tmp_path):
    one = database()
    for k in range(5):
        one.note(Deed(f"2026-01-0{k + 1}", "bob", f"POST /v1/tunings/{k}/abort", 202))
    assert [row["at"] for row in one.audit(2)] == ["2026-01-05", "2026-01-04"]
    assert [row["at"] for row in one.audit(2, before=4)] == ["2026-01-03", "2026-01-02"]
    one.close()
    with sqlite3.connect(tmp_path / FILE) as past_us:
        for statement in ("DELETE FROM audit", "UPDATE audit SET actor = 'eve'"):
            with pytest.raises(sqlite3.IntegrityError, match="append-only"):
                past_us.execute(statement)
    past_us.close()
    assert [row["actor"] for row in database().audit(10)] == ["bob"] * 5


def test_the_audit_is_asked_by_loop_and_by_actor(database, head):
    one = database()
    one.begin(head("t1", loop="heater"))
    for k, deed in enumerate([
        ("bob", "heater", "t1"), ("alice", None, "t1"), ("bob", "furnace", None),
        ("bob", None, None), ("bob", None, "t2"),
    ]):  # fmt: skip
        actor, loop, tuning_id = deed
        one.note(Deed(f"2026-01-0{k + 1}", actor, "POST", 200, loop, tuning_id))
    assert [(row["loop"], row["tuning_id"]) for row in one.audit(10)[::-1]] == [
        ("heater", "t1"), ("heater", "t1"), ("furnace", None), (None, None), (None, "t2"),
    ]  # fmt: skip
    assert [row["actor"] for row in one.audit(10, loop="heater")] == ["alice", "bob"]
    assert [row["number"] for row in one.audit(10, loop="heater", actor="bob")] == [1]
    assert [row["number"] for row in one.audit(2, before=5, actor="bob")] == [4, 3]


def test_what_is_forgotten_gives_its_room_back(database, head, samples, tmp_path):
    one = database()
    for name in ("t1", "t2"):
        one.begin(head(name))
        for first in range(0, 20000, 1000):
            one.write([News(name, first, samples(first, 1000))])
    one.note(Deed("now", "bob", "POST", 202))
    assert dict(one.sizes()) == {"t1": 20000 * 48 + 2, "t2": 20000 * 48 + 2}
    one.close()
    before = (tmp_path / FILE).stat().st_size
    one = database()
    one.forget(["t1"])
    one.close()
    assert (tmp_path / FILE).stat().st_size < 0.6 * before
    assert database().find("t1") is None
    assert len(database().find("t2").samples) == 20000
    assert len(database().audit(10)) == 1


def test_a_probe_writes_and_leaves_nothing_behind(database, tmp_path):
    """SQLite counts for every connection what another has written: a probe that wrote nothing would tell nothing."""
    one = database()
    with contextlib.closing(sqlite3.connect(tmp_path / FILE)) as beside:
        seen = [beside.execute("PRAGMA data_version").fetchone()]
        for _ in range(2):
            one.probe()
            seen.append(beside.execute("PRAGMA data_version").fetchone())
        assert len(set(seen)) == 3
        assert beside.execute("SELECT count(*) FROM events").fetchone() == (0,)


def test_a_transaction_is_on_the_disk(database):
    """What the rules of the file say of SQLite, asked of SQLite."""
    with database()._engine.transaction() as connection:
        ask = {name: connection.rows(f"PRAGMA {name}")[0][name] for name in ("journal_mode", "synchronous")}
    assert ask == {"journal_mode": "wal", "synchronous": 2}
