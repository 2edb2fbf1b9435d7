"""One device, one program: whatever folder or data directory a second one is started in."""

import pytest

from autotuner.control.records.journal import Journal
from autotuner.errors import LoopBusyError
from tests.control.test_leases import head


def test_two_data_directories_cannot_drive_one_device(tmp_path):
    first, second = Journal(tmp_path / "a", in_place=True), Journal(tmp_path / "b", in_place=True)
    held = first.begin(head())
    with pytest.raises(LoopBusyError, match=str(tmp_path / "a")):
        second.begin(head("T2"))
    other = second.begin(head("T3", device="another"))
    held._close(ended=True)
    second.begin(head("T4"))._close(ended=True)
    other._close(ended=True)


def test_a_lock_that_is_shared_holds_until_both_are_released(tmp_path):
    first, second = Journal(tmp_path / "a", in_place=True), Journal(tmp_path / "b", in_place=True)
    run = first.begin(head())
    within = first.begin(head("T2"), within=run)
    run._close(ended=True)
    with pytest.raises(LoopBusyError):
        second.begin(head("T3"))
    within._close(ended=True)
    second.begin(head("T4"))._close(ended=True)


def test_a_state_directory_that_cannot_be_used_leaves_the_lock_of_the_data_directory(tmp_path, monkeypatch):
    """A container that keeps nothing but its data directory."""
    file = tmp_path / "file"
    file.write_text("no folder")
    monkeypatch.setenv("XDG_STATE_HOME", str(file))
    journal = Journal(tmp_path / "a", in_place=True)
    held = journal.begin(head())
    with pytest.raises(LoopBusyError):
        journal.begin(head("T2"))
    held._close(ended=True)
