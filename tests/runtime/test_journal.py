"""The journal: what is on the disk at which moment, and what happens when the disk is not there."""

import asyncio
import errno
import json
import math
import os
import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotuner.core.recording import Sample
from autotuner.core.settings import ExperimentSettings, Limits
from autotuner.core.verdict import aborted
from autotuner.errors import LoopBusyError, StorageError
from autotuner.ports import OUTPUT
from autotuner.runtime import journal as journal_module
from autotuner.runtime.events import PhaseChanged, SampleTaken
from autotuner.runtime.journal import Journal
from autotuner.runtime.journal_file import line, read_journal, sample_entry, settings_of
from autotuner.runtime.restore import Before

DONE = aborted("aborted", "stopped by the operator", "Start it again.")


def head(tuning="T1", device="abc", loop="TIC-101"):
    request = {"settings": ExperimentSettings().to_dict(), "structure": "auto", "goal": "balanced", "rule": None}
    return {"tuning": tuning, "loop": loop, "device": device, "started_at": "now", "request": request}


@pytest.fixture
def journal(tmp_path):
    return Journal(tmp_path / "data", in_place=True)


@pytest.fixture
def begun(journal, virtual):
    """A journal that has been begun, and is closed by the end of the test."""
    one = journal.begin(head())
    yield one
    if not one._thread._shutdown:
        virtual(one.end(None))


def entries(journal, tuning="T1"):
    return [json.loads(text) for text in (journal.folder / "journal" / f"{tuning}.jsonl").read_text().splitlines()]


def test_nothing_is_made_where_nothing_was_disturbed(journal):
    assert journal.interrupted() == []
    assert not journal.folder.exists()


def test_what_is_disturbed_is_synced_before_the_call_returns(journal, begun, virtual, monkeypatch):
    synced = []
    monkeypatch.setattr(os, "fsync", lambda file: synced.append(str(Path(f"/proc/self/fd/{file}").readlink())))
    virtual(begun.disturb(Before(40.0, 1.0)))
    assert entries(journal)[-1] == {"before": {"output": 40.0, "auto": 1.0, "set_point": None}}
    files = journal.folder / "journal"
    assert synced == [str(files / "T1.jsonl"), str(files)]


def test_a_command_is_with_the_system_when_the_call_returns(journal, begun, virtual):
    virtual(begun.command(53.5))
    assert entries(journal)[-1] == {"command": 53.5}


def test_samples_reach_the_disk_itself_every_second(begun, monkeypatch):
    synced = []
    monkeypatch.setattr(os, "fsync", synced.append)
    for k in range(45):
        begun.note(SampleTaken(0.1 * k, 80.0, 40.0, math.nan, 0.0, math.nan))
    begun._thread.submit(int).result()
    begun._syncer.shutdown()
    assert len(synced) == 4


def test_no_sample_queues_up_behind_a_slow_disk(journal, begun, virtual, monkeypatch):
    """A kill would lose what waits; what is with the operating system stays."""
    free = threading.Event()
    monkeypatch.setattr(os, "fsync", lambda _: free.wait())
    begun.note(PhaseChanged(0.0, "relay"))
    begun.note(SampleTaken(0.5, 81.0, 53.5, 85.0, 0.0, 0.52))
    virtual(begun.command(46.5))  # returns when the writing thread has come as far, or after its longest wait
    begun._thread.submit(int).result()
    assert [next(iter(entry)) for entry in entries(journal)[-3:]] == ["t", "sample", "command"]
    free.set()


def test_a_journal_tells_what_was_put_in(journal, begun, virtual):
    virtual(begun.disturb(Before(40.0, 0.0)))
    begun.note(PhaseChanged(0.0, "quiet"))
    begun.note(SampleTaken(0.25, 80.5, 40.0, math.nan, 0.001, math.nan))
    virtual(begun.command(53.5))
    begun.note(SampleTaken(0.5, 81.0, 53.5, 85.0, 0.0, 0.52))
    virtual(begun.end(None))  # the writing thread has put everything when it is gone; no verdict: still interrupted
    (kept,) = journal.interrupted()
    assert (kept.tuning, kept.loop, kept.device) == ("T1", "TIC-101", "abc")
    assert kept.before == Before(40.0, 0.0)
    assert kept.commanded == {40.0, 53.5}
    assert kept.samples[1] == Sample(0.5, 81.0, 53.5, 85.0, written_s=0.52)
    assert math.isnan(kept.samples[0].set_point)
    assert math.isnan(kept.samples[0].written_s)
    assert kept.settings == ExperimentSettings()
    assert kept.verdict is None
    assert not kept.restored


def test_an_ended_journal_is_not_interrupted(journal, begun, virtual):
    virtual(begun.end(DONE))
    assert journal.interrupted() == []
    assert read_journal(journal.folder / "journal" / "T1.jsonl").verdict == DONE


def test_a_journal_that_could_not_be_marked_goes_with_its_loop_given_back(journal, begun, virtual, monkeypatch):
    full = OSError(errno.ENOSPC, "No space left on device")
    monkeypatch.setattr(os, "write", lambda *_: (_ for _ in ()).throw(full))
    virtual(begun.end(DONE))
    assert journal.interrupted() == []
    assert list((journal.folder / "journal").iterdir()) == []


def test_a_loop_that_was_not_given_back_stays_interrupted(journal, begun, virtual):
    virtual(begun.end(None))
    assert [kept.tuning for kept in journal.interrupted("TIC-101")] == ["T1"]
    assert journal.interrupted("FIC-7") == []


def test_the_restored_loop_is_known_from_the_phase(journal, begun):
    begun.note(PhaseChanged(9.0, "ended"))
    begun._thread.submit(int).result()
    assert journal.interrupted()[0].restored


@given(cut=st.integers(0, 400), samples=st.integers(0, 5))
def test_a_torn_line_is_dropped_and_all_before_it_is_kept(tmp_path_factory, cut, samples):
    """Cut anywhere after the first line, as a power failure does: what is whole counts."""
    path = tmp_path_factory.mktemp("torn") / "T1.jsonl"
    lines = [line({"journal": 1, **head()}), *(line(sample_entry(Sample(k, 80.0, 40.0))) for k in range(samples))]
    whole = b"".join(lines)
    kept_bytes = min(len(lines[0]) + cut, len(whole))
    path.write_bytes(whole[:kept_bytes])
    expected = sum(len(b"".join(lines[: k + 1])) <= kept_bytes for k in range(1, len(lines)))
    assert len(read_journal(path).samples) == expected


def test_going_on_begins_a_new_line(journal, begun, virtual):
    virtual(begun.end(None))
    path = journal.folder / "journal" / "T1.jsonl"
    with path.open("ab") as file:
        file.write(b'{"sample": [1.0, 80')
    (kept,) = journal.interrupted()
    resumed = journal.resume(kept)
    virtual(resumed.end(DONE))
    assert entries(journal)[-1] == {"ended": DONE.to_dict()}


def test_a_foreign_file_is_passed_over(journal, begun, virtual, caplog):
    virtual(begun.end(None))
    (journal.folder / "journal" / "notes.jsonl").write_text('{"journal": 99}\n')
    assert [kept.tuning for kept in journal.interrupted()] == ["T1"]
    assert "notes.jsonl" in caplog.text


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
def test_settings_survive_the_file(limits, amplitude):
    settings = ExperimentSettings(limits=limits, amplitude=amplitude)
    assert settings_of(json.loads(line(settings.to_dict()))) == settings


def test_two_programs_do_not_move_one_device(journal, begun, tmp_path):
    """A lock of another open file conflicts as that of another process does."""
    with pytest.raises(LoopBusyError) as caught:
        journal.begin(head("T2", loop="other-name"))
    assert caught.value.tuning_id == "T1"
    (kept,) = journal.interrupted()
    with pytest.raises(LoopBusyError):
        journal.resume(kept)
    assert not (journal.folder / "journal" / "T2.jsonl").exists()


def test_another_device_is_free(journal, begun, virtual):
    other = journal.begin(head("T2", device="def"))
    virtual(other.end(None))


def test_the_lock_goes_with_the_journal(journal, begun, virtual):
    virtual(begun.end(DONE))
    virtual(journal.begin(head("T2")).end(DONE))


def test_a_folder_that_cannot_be_made_refuses_a_new_tuning(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StorageError, match=r"service.data_directory"):
        Journal(tmp_path / "file" / "data").begin(head())


def no_space(*_args):
    raise OSError(28, "No space left on device")


def test_a_full_disk_refuses_to_disturb(journal, begun, virtual, monkeypatch):
    monkeypatch.setattr(os, "write", no_space)
    with pytest.raises(StorageError, match="No space left"):
        virtual(begun.disturb(Before(40.0, None)))


def test_a_disk_that_fills_up_does_not_disturb_a_running_tuning(journal, begun, virtual, monkeypatch):
    virtual(begun.disturb(Before(40.0, None)))
    monkeypatch.setattr(os, "write", no_space)
    virtual(begun.command(53.5))
    begun.note(SampleTaken(0.0, 80.0, 53.5, math.nan, 0.0, math.nan))
    virtual(begun.end(None))
    assert "No space left" in begun.trouble
    assert entries(journal)[-1] == {"before": {"output": 40.0, "auto": None, "set_point": None}}


def test_a_disk_that_hangs_does_not_hang_the_control_loop(begun, virtual, monkeypatch):
    """The call comes back while the disk is still busy with it."""
    write, free = os.write, threading.Event()
    monkeypatch.setattr(os, "write", lambda file, text: free.wait() and write(file, text))
    virtual(begun.command(53.5))
    assert not free.is_set()
    free.set()


async def test_other_loops_are_served_while_a_command_waits_for_the_disk(tmp_path, monkeypatch):
    journal = Journal(tmp_path).begin(head("T1"))
    write, free, turns = os.write, threading.Event(), []

    def slow(file, text):
        free.wait()
        return write(file, text)

    async def another_loop():
        turns.append(free.is_set())
        free.set()

    monkeypatch.setattr(os, "write", slow)
    await asyncio.gather(journal.command(53.5), another_loop())
    await journal.end(None)
    assert turns == [False]


def test_old_journals_are_forgotten(journal, virtual, monkeypatch):
    monkeypatch.setattr(journal_module, "KEPT", 3)
    for k in range(6):
        virtual(journal.begin(head(f"T{k}")).end(DONE))
        path = journal.folder / "journal" / f"T{k}.jsonl"
        os.utime(path, (1e9 + k, 1e9 + k))
    virtual(journal.begin(head("T6")).end(None))
    left = sorted(path.stem for path in (journal.folder / "journal").iterdir())
    assert left == ["T3", "T4", "T5", "T6"]


def test_a_tuning_is_kept_as_it_goes(rig, virtual, journal):
    """The whole runtime with a journal: what is read back is what was recorded."""
    one = rig()
    one.tuning.journal = journal.begin(one.tuning.head(one.loop.device_key))

    async def main():
        await one.conduct()
        return await one.now(OUTPUT)

    virtual(main())
    kept = read_journal(journal.folder / "journal" / "T1.jsonl")
    assert kept.verdict == one.tuning.verdict
    assert kept.restored
    assert kept.before.output == 40.0
    assert {values[OUTPUT] for values in one.backend.written} <= kept.commanded
    assert [s.t for s in kept.samples] == [s.t for s in one.tuning.samples]
    assert [s.pv for s in kept.samples] == [s.pv for s in one.tuning.samples]


def test_a_tuning_that_cannot_be_kept_moves_nothing(rig, virtual, journal, monkeypatch):
    one = rig()
    one.tuning.journal = journal.begin(one.tuning.head(one.loop.device_key))
    monkeypatch.setattr(os, "write", no_space)
    verdict = virtual(one.conduct())
    assert (verdict.outcome, verdict.code) == ("failed", "storage_error")
    assert one.backend.written == []


def test_a_disk_that_fills_up_in_the_middle_is_a_warning(rig, virtual, journal, monkeypatch):
    one = rig()
    one.tuning.journal = journal.begin(one.tuning.head(one.loop.device_key))
    write = os.write
    left = iter(range(40))

    def fills_up(file, text):
        return write(file, text) if next(left, None) is not None else no_space()

    monkeypatch.setattr(os, "write", fills_up)
    verdict = virtual(one.conduct())
    assert verdict.outcome == "done"
    assert any("No space left" in warning for warning in one.tuning.warnings)


def of_a_run(journal, virtual, kind="schedule"):
    one = journal.begin(head("S1") | {"kind": kind})
    virtual(one.disturb(Before(40.0, 1.0, 80.0)))
    return one


def test_what_a_moved_set_point_leaves_is_told(journal, virtual):
    one = of_a_run(journal, virtual, "verification")
    virtual(one.unproved())
    virtual(one.set_point(82.5))
    virtual(one.command(46.0))
    virtual(one.mode(0.0))
    virtual(one.command(44.0))
    virtual(one.end(None))
    (kept,) = journal.interrupted()
    assert (kept.path.name, kept.tuning, kept.kind) == ("S1.verification.jsonl", "S1", "verification")
    assert (kept.before, kept.set_points, kept.mode) == (Before(40.0, 1.0, 80.0), {80.0, 82.5}, 0.0)
    assert (kept.commanded, kept.target, kept.proved) == ({44.0}, None, False)


def test_gains_that_are_proved_stay_so(journal, virtual):
    one = of_a_run(journal, virtual, "verification")
    virtual(one.unproved())
    virtual(one.proved())
    virtual(one.end(None))
    assert journal.interrupted()[0].proved is True


def test_a_tuning_within_a_run_shares_its_lock(journal, virtual):
    run = of_a_run(journal, virtual)
    inner = journal.begin(head("T1"), within=run)
    virtual(inner.end(DONE))
    with pytest.raises(LoopBusyError):
        journal.begin(head("T2"))
    virtual(run.end(DONE))
    virtual(journal.begin(head("T2")).end(DONE))


def test_what_this_program_runs_or_has_ended_was_not_left_behind(journal, virtual, monkeypatch):
    run = of_a_run(journal, virtual)
    assert [kept.tuning for kept in journal.interrupted()] == ["S1"]
    assert journal.left() == []
    assert [kept.tuning for kept in Journal(journal.folder).left()] == ["S1"]
    monkeypatch.setattr(os, "write", no_space)
    monkeypatch.setattr("pathlib.Path.unlink", no_space)
    virtual(run.end(DONE))
    assert [kept.tuning for kept in journal.interrupted()] == ["S1"]
    assert journal.left() == []


def test_what_was_not_given_back_is_left_behind(journal, virtual):
    virtual(of_a_run(journal, virtual).end(None))
    assert [kept.tuning for kept in journal.left()] == ["S1"]
