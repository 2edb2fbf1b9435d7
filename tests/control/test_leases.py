"""The leases of a data directory: what is on the disk at which moment; disks and records that fail."""

import asyncio
import gc
import logging
import math
import random
import shutil
import sqlite3
import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotuner.control.records import device_lock
from autotuner.control.records import journal as journal_module
from autotuner.control.records.journal import Journal
from autotuner.control.records.lease_record import Before, DamagedRecordError, read_record, settings_of
from autotuner.control.records.open_journal import OpenJournal
from autotuner.control.records.store import ENTRIES, Store, row
from autotuner.control.reporting.events import PhaseChanged, SampleTaken
from autotuner.core.experiment.settings import ExperimentSettings, Limits
from autotuner.core.jsonable import jsonable
from autotuner.core.recording import Sample
from autotuner.core.verdict import aborted
from autotuner.errors import LoopBusyError, OutputUnknownError, StorageError
from autotuner.ports import OUTPUT

DONE = aborted("aborted", "stopped by the operator", "Start it again.")


def head(tuning="T1", device="abc", loop="TIC-101"):
    request = {"settings": ExperimentSettings().to_dict(), "structure": "auto", "goal": "balanced", "rule": None}
    return {"tuning": tuning, "loop": loop, "device": device, "started_at": "now", "request": request}


def sample(t, output=40.0, set_point=math.nan, written_s=math.nan):
    return SampleTaken(t, 80.0, output, set_point, 0.0, written_s)


@pytest.fixture
def journal(tmp_path):
    journal = Journal(tmp_path / "data", in_place=True)
    yield journal
    while journal.store._users > 0:  # leases that their test leaves open
        journal.store.close()


@pytest.fixture
def begun(journal):
    return journal.begin(head())


def entries(journal, lease="T1"):
    return journal.store.rows(ENTRIES, lease).values


def full(monkeypatch):
    """Have every commit fail, as on a full disk."""

    def no_space(*_args, **_keys):
        raise sqlite3.OperationalError("database or disk is full")

    monkeypatch.setattr(Store, "_commit", no_space)


def marker(journal, device="abc"):
    return device_lock.marker(journal.folder / "leases" / device)


def test_nothing_is_made_where_nothing_was_disturbed(journal):
    assert journal.interrupted() == []
    assert not journal.folder.exists()


def test_marker_and_found_values_are_synced_before_the_call_returns(journal, begun, virtual, monkeypatch):
    done = []
    commit = Store._commit
    monkeypatch.setattr(device_lock.os, "fsync", lambda _file: done.append("marker"))
    monkeypatch.setattr(
        Store, "_commit", lambda store, rows, *, safe: (done.append(("commit", safe)), commit(store, rows, safe=safe))
    )
    virtual(begun.disturb(Before(40.0, 1.0)))
    assert done == ["marker", ("commit", True)]
    assert entries(journal)[-1] == {"before": {"output": 40.0, "auto": 1.0, "set_point": None}}
    assert marker(journal) == ("T1", False)


def test_only_a_level_beyond_those_before_is_recorded(journal, begun, virtual):
    virtual(begun.disturb(Before(40.0, None)))
    for output in (53.5, 45.0, 33.0, 50.0, 40.0):
        virtual(begun.command(output))
    assert [entry["command"] for entry in entries(journal)[1:]] == [53.5, 33.0]


def test_a_record_holds_what_was_put_in(journal, begun, virtual):
    virtual(begun.disturb(Before(40.0, 0.0)))
    begun.note(PhaseChanged(0.0, "quiet"))
    begun.note(SampleTaken(0.25, 80.5, 40.0, math.nan, 0.001, math.nan))
    virtual(begun.command(53.5))
    begun.note(SampleTaken(0.5, 81.0, 53.5, 85.0, 0.0, 0.52))
    virtual(begun.end(None))
    (kept,) = journal.interrupted()
    assert (kept.tuning, kept.loop, kept.device) == ("T1", "TIC-101", "abc")
    assert (kept.before, kept.commanded, kept.wide) == (Before(40.0, 0.0), {40.0, 53.5}, False)
    assert kept.samples[1] == Sample(0.5, 81.0, 53.5, 85.0, written_s=0.52)
    assert math.isnan(kept.samples[0].set_point)
    assert kept.settings == ExperimentSettings()
    assert (kept.verdict, kept.restored) == (None, False)


def test_an_ended_lease_is_not_interrupted(journal, begun, virtual):
    virtual(begun.end(DONE))
    assert journal.interrupted() == []
    assert marker(journal)[0] == ""
    assert read_record(journal.store, "T1").verdict == DONE


def test_a_lease_that_could_not_be_marked_as_ended_is_known_by_its_marker(journal, begun, virtual, monkeypatch):
    virtual(begun.disturb(Before(40.0, None)))
    full(monkeypatch)
    virtual(begun.end(DONE))
    assert marker(journal)[0] == ""
    assert [lease.restored for lease in Journal(journal.folder).interrupted()] == [True]


def test_a_loop_that_was_not_given_back_stays_interrupted(journal, begun, virtual):
    virtual(begun.end(None))
    assert [kept.tuning for kept in journal.interrupted("TIC-101")] == ["T1"]
    assert journal.interrupted("FIC-7") == []


def test_the_restored_loop_is_known_from_the_phase(journal, begun):
    begun.note(PhaseChanged(9.0, "ended"))
    assert journal.interrupted()[0].restored


def test_going_on_appends(journal, begun, virtual):
    virtual(begun.disturb(Before(40.0, None)))
    virtual(begun.end(None))
    (kept,) = journal.interrupted()
    virtual(journal.resume(kept).end(DONE))
    assert entries(journal) == [
        {"before": {"output": 40.0, "auto": None, "set_point": None}},
        {"ended": DONE.to_dict()},
    ]


LIMITS = st.builds(
    lambda low, span, pv, slew, safe: Limits(
        (low, low + span), (-math.inf, math.inf) if pv is None else (-pv, pv), slew or math.inf, low if safe else None
    ),
    st.floats(-100.0, 100.0),
    st.floats(50.0, 100.0),
    st.one_of(st.none(), st.floats(1.0, 1e3)),
    st.one_of(st.none(), st.floats(0.1, 10.0)),
    st.booleans(),
)


@given(limits=LIMITS, amplitude=st.one_of(st.none(), st.floats(0.1, 20.0)))
def test_settings_survive_the_store(limits, amplitude):
    settings = ExperimentSettings(limits=limits, amplitude=amplitude)
    assert settings_of(jsonable(settings.to_dict())) == settings


def test_two_programs_do_not_drive_one_device(journal, begun):
    """A lock of another open file conflicts as that of another process does."""
    with pytest.raises(LoopBusyError) as caught:
        journal.begin(head("T2", loop="other-name"))
    assert caught.value.tuning_id == "T1"
    (kept,) = journal.interrupted()
    with pytest.raises(LoopBusyError):
        journal.resume(kept)
    assert journal.store.owners() == ["T1"]


def test_another_device_is_free(journal, begun, virtual):
    virtual(journal.begin(head("T2", device="def")).end(None))


def test_the_lock_goes_with_the_lease(journal, begun, virtual):
    virtual(begun.end(DONE))
    virtual(journal.begin(head("T2")).end(DONE))


def test_locks_and_store_belong_to_their_user_alone(journal, begun):
    """Another user who can open a lock can hold it, and block a recovery."""
    modes = {path.name: path.stat().st_mode & 0o777 for path in journal.folder.rglob("*")}
    assert modes["leases"] == 0o700
    assert {mode for name, mode in modes.items() if name != "leases"} == {0o600}


def test_a_folder_that_cannot_be_made_refuses_a_new_tuning(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StorageError, match=r"service.data_directory"):
        Journal(tmp_path / "file" / "data").begin(head())


def test_a_full_disk_refuses_to_disturb(begun, virtual, monkeypatch):
    full(monkeypatch)
    with pytest.raises(StorageError, match="disk is full"):
        virtual(begun.disturb(Before(40.0, None)))


def test_a_disk_that_fills_up_does_not_end_a_running_tuning_and_its_marker_is_widened(
    journal, begun, virtual, monkeypatch
):
    virtual(begun.disturb(Before(40.0, None)))
    full(monkeypatch)
    virtual(begun.command(53.5))
    begun.note(sample(0.0, 53.5))
    assert "disk is full" in begun.trouble
    (kept,) = Journal(journal.folder).interrupted()
    assert (kept.before, kept.commanded, kept.wide) == (Before(40.0, None), {40.0}, True)


def test_a_set_point_that_a_full_disk_does_not_take_widens_the_marker_too(journal, begun, virtual, monkeypatch):
    virtual(begun.disturb(Before(40.0, 1.0, 80.0)))
    full(monkeypatch)
    virtual(begun.set_point(82.0))
    (kept,) = Journal(journal.folder).interrupted()
    assert (kept.set_points, kept.wide) == ({80.0}, True)


@pytest.mark.parametrize("about_to_write", [OpenJournal.command, OpenJournal.set_point])
def test_what_cannot_be_recorded_at_all_is_not_written(begun, virtual, monkeypatch, about_to_write):
    virtual(begun.disturb(Before(40.0, None)))
    full(monkeypatch)

    def read_only(_lock):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(device_lock.DeviceLock, "widen", read_only)
    with pytest.raises(StorageError, match="Read-only"):
        virtual(about_to_write(begun, 53.5))


async def test_a_disk_that_fails_is_named_once_and_leaves_no_trace(tmp_path, monkeypatch, caplog):
    begun = Journal(tmp_path / "data").begin(head())
    await begun.disturb(Before(40.0, None))
    full(monkeypatch)
    await begun.command(53.5)
    await begun.end(None)
    gc.collect()
    assert [record.name for record in caplog.records if record.levelno >= logging.ERROR] == [OpenJournal.__module__]


async def test_a_disk_that_hangs_does_not_hang_the_control_loop(tmp_path, monkeypatch):
    journal = Journal(tmp_path).begin(head())
    await journal.disturb(Before(40.0, None))
    commit, free, served = Store._commit, threading.Event(), []

    def slow(store, rows, *, safe):
        free.wait()
        commit(store, rows, safe=safe)

    async def another_loop():
        served.append(free.is_set())

    monkeypatch.setattr(Store, "_commit", slow)
    await asyncio.gather(journal.command(53.5), another_loop())
    assert not free.is_set()
    assert served == [False]
    assert device_lock.marker(tmp_path / "leases" / "abc") == ("T1", True)
    free.set()
    await journal.end(None)


async def test_what_waits_is_committed_at_once(tmp_path, monkeypatch):
    """Many loops share a commit: the store never falls behind by one commit for each sample."""
    commits, commit, free = [], Store._commit, threading.Event()

    def counted(store, rows, *, safe):
        rows = list(rows)
        commits.append(len(rows))
        if len(commits) == 1:
            free.wait()
        commit(store, rows, safe=safe)

    journal = Journal(tmp_path)
    one = journal.begin(head())
    monkeypatch.setattr(Store, "_commit", counted)
    for k in range(50):
        one.note(sample(0.001 * k))
    free.set()
    await one.end(None)
    assert sum(commits) == 50
    assert len(commits) <= 3
    assert len(journal.interrupted()[0].samples) == 50


def test_old_leases_are_forgotten(journal, virtual, monkeypatch):
    monkeypatch.setattr(journal_module, "KEPT", 3)
    for k in range(6):
        virtual(journal.begin(head(f"T{k}")).end(DONE))
    virtual(journal.begin(head("T6")).end(None))
    assert journal.store.owners() == ["T3", "T4", "T5", "T6"]


def test_a_tuning_is_kept_as_it_goes(rig, virtual, journal):
    """The whole of control with a store: what is read back is what was recorded."""
    one = rig()
    one.tuning.journal = journal.begin(one.tuning.head(one.loop.device_key))
    virtual(one.conduct())
    kept = read_record(journal.store, "T1")
    assert kept.verdict == one.tuning.verdict
    assert kept.restored
    assert kept.before.output == 40.0
    written = [values[OUTPUT] for values in one.backend.written]
    assert (min(kept.commanded), max(kept.commanded)) == (min(*written, 40.0), max(written))
    assert [s.t for s in kept.samples] == [s.t for s in one.tuning.samples]
    assert [s.pv for s in kept.samples] == [s.pv for s in one.tuning.samples]


def test_a_tuning_that_cannot_be_kept_moves_nothing(rig, virtual, journal, monkeypatch):
    one = rig()
    one.tuning.journal = journal.begin(one.tuning.head(one.loop.device_key))
    full(monkeypatch)
    verdict = virtual(one.conduct())
    assert (verdict.outcome, verdict.code) == ("failed", "storage_error")
    assert one.backend.written == []


def test_a_disk_that_fills_up_in_the_middle_is_a_warning(rig, virtual, journal, monkeypatch):
    one = rig()
    one.tuning.journal = journal.begin(one.tuning.head(one.loop.device_key))
    commit, left = Store._commit, iter(range(40))

    def fills_up(store, rows, *, safe):
        if next(left, None) is None:
            raise sqlite3.OperationalError("database or disk is full")
        commit(store, rows, safe=safe)

    monkeypatch.setattr(Store, "_commit", fills_up)
    verdict = virtual(one.conduct())
    assert verdict.outcome == "done"
    assert any("disk is full" in warning for warning in one.tuning.warnings)


def of_a_run(journal, virtual, kind="schedule"):
    one = journal.begin(head("S1") | {"kind": kind})
    virtual(one.disturb(Before(40.0, 1.0, 80.0)))
    return one


def test_what_a_moved_set_point_leaves_is_recorded(journal, virtual):
    one = of_a_run(journal, virtual, "verification")
    virtual(one.unproved())
    virtual(one.set_point(82.5))
    virtual(one.command(46.0))
    virtual(one.mode(0.0))
    virtual(one.command(44.0))
    virtual(one.end(None))
    (kept,) = journal.interrupted()
    assert (kept.name, kept.tuning, kept.kind) == ("S1.verification", "S1", "verification")
    assert (kept.before, kept.set_points, kept.mode) == (Before(40.0, 1.0, 80.0), {80.0, 82.5}, 0.0)
    assert (kept.commanded, kept.target, kept.proved) == ({44.0}, None, False)


def test_gains_that_are_proved_stay_so(journal, virtual):
    one = of_a_run(journal, virtual, "verification")
    virtual(one.unproved())
    virtual(one.proved())
    virtual(one.end(None))
    assert journal.interrupted()[0].proved is True


def test_a_tuning_within_a_run_shares_its_lock_and_its_marker(journal, virtual):
    run = of_a_run(journal, virtual)
    inner = journal.begin(head("T1"), within=run)
    virtual(inner.end(DONE))
    assert marker(journal) == ("S1", False)
    with pytest.raises(LoopBusyError):
        journal.begin(head("T2"))
    virtual(run.end(DONE))
    virtual(journal.begin(head("T2")).end(DONE))


def test_what_this_program_runs_was_not_left_behind(journal, virtual):
    run = of_a_run(journal, virtual)
    assert [kept.tuning for kept in journal.interrupted()] == ["S1"]
    assert journal.left() == []
    assert [kept.tuning for kept in Journal(journal.folder).left()] == ["S1"]
    virtual(run.end(DONE))
    assert journal.interrupted() == []


def test_what_was_not_given_back_is_left_behind(journal, virtual):
    virtual(of_a_run(journal, virtual).end(None))
    assert [kept.tuning for kept in journal.left()] == ["S1"]


def disturbed(folder, virtual):
    """A data directory as a kill in the relay leaves it; its values."""
    journal = Journal(folder, in_place=True)
    one = journal.begin(head())
    virtual(one.disturb(Before(40.0, 0.0)))
    virtual(one.command(53.5))
    virtual(one.command(33.5))
    one.note(PhaseChanged(1.0, "relay"))
    for k in range(20):
        one.note(sample(0.1 * k, 53.5))
    one.store.close()
    one.lock.release()


def damage(data, chance, kind):
    """One flipped bit, 200 of them, a cut, 512 random bytes, nothing left."""
    start, length = chance.randrange(len(data)), len(data)
    for _ in range({0: 1, 1: 200}.get(kind, 0)):
        data[chance.randrange(length)] ^= 1 << chance.randrange(8)
    if kind == 3:
        data[start : start + 512] = chance.randbytes(len(data[start : start + 512]))
    return data[: {2: start, 4: 0}.get(kind, length)]


def test_of_200_damaged_stores_none_is_trusted_and_none_keeps_a_program_from_starting(tmp_path, virtual):
    """Bits flipped, cut, overwritten, removed: the found values come out as they were put in, or not at all."""
    intact = tmp_path / "intact"
    disturbed(intact, virtual)
    whole = (intact / "state.sqlite3").read_bytes()
    chance, outcomes = random.Random(5), {"restored": 0, "held": 0}  # noqa: S311 - damage, not a secret
    for k in range(200):
        folder = tmp_path / f"damaged-{k}"
        shutil.copytree(intact, folder)
        file, data = folder / "state.sqlite3", bytearray(whole)
        file.write_bytes(damage(data, chance, k % 5))
        journal = Journal(folder, in_place=True)
        left, unresolved = journal.left(), journal.unresolved("TIC-101", "abc")
        if left:
            assert (left[0].before, left[0].target) == (Before(40.0, 0.0), 40.0)
            outcomes["restored"] += 1
        else:
            assert unresolved is not None
            assert unresolved.name == "T1"
            with pytest.raises(OutputUnknownError):
                journal.begin(head("T2"))
            outcomes["held"] += 1
    assert min(outcomes.values()) > 20


@pytest.mark.parametrize(
    "value",
    [
        {"before": {"output": "NaN", "auto": 0.0, "set_point": None}},
        {"before": {"output": 1e999, "auto": 0.0, "set_point": None}},
        {"before": {"output": 40.0, "auto": 0.0, "set_point": None, "colour": "red"}},
        {"before": {"output": True, "auto": 0.0, "set_point": None}},
        {"target": "40"},
        {"command": [53.5]},
        {"ended": {"outcome": "splendid"}},
        {"before": None},
    ],
)
def test_a_forged_entry_with_a_good_checksum_is_not_understood(journal, begun, virtual, value):
    virtual(begun.disturb(Before(40.0, 0.0)))
    text = {"body": str(value)}
    forged = row(ENTRIES, "T1", 1, value if "1e999" not in str(text) else {"before": {"output": math.inf}})
    begun.store.submit([forged])
    with pytest.raises(DamagedRecordError):
        read_record(journal.store, "T1")
    virtual(begun.end(None))
    assert Journal(journal.folder).unresolved("TIC-101", "abc").name == "T1"


def test_an_unknown_entry_of_a_later_version_is_passed_over(journal, begun, virtual):
    virtual(begun.disturb(Before(40.0, 0.0)))
    begun.store.submit([row(ENTRIES, "T1", 1, {"colour": "red"})])
    assert read_record(journal.store, "T1").before == Before(40.0, 0.0)


def test_a_record_of_another_version_is_held(journal, virtual):
    one = journal.begin(head())
    one.store.submit([row("leases", "T1", 0, {"record": 1, **head()})])
    virtual(one.end(None))
    assert journal.left() == []
    assert "version 1" in journal.unresolved("TIC-101", "abc").why


def test_a_journal_of_an_older_version_is_held_until_a_person_confirms(tmp_path):
    (tmp_path / "journal").mkdir()
    (tmp_path / "journal" / "T0.jsonl").write_text('{"journal": 1, "loop": "TIC-101"}\n{"command": 53.0}\n')
    (tmp_path / "journal" / "T1.jsonl").write_text('{"journal": 1, "loop": "TIC-101"}\n{"ended": {}}\n')
    journal = Journal(tmp_path)
    assert journal.unresolved("TIC-101", "abc").name == "T0.jsonl"
    assert journal.unresolved("FIC-7", "def") is None
    journal.confirm("TIC-101", "abc")
    assert journal.unresolved("TIC-101", "abc") is None


def test_what_a_person_has_confirmed_is_free_again(journal, begun, virtual):
    virtual(begun.disturb(Before(40.0, 0.0)))
    virtual(begun.end(None))
    begun.store.delete(["T1"])
    assert "missing" in journal.unresolved("TIC-101", "abc").why
    journal.confirm("TIC-101", "abc")
    virtual(journal.begin(head("T2")).end(DONE))
