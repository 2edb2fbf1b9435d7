"""Files that are there whole or not at all: on a disk that takes nothing more, and after a kill."""

import os
import subprocess
import sys

import pytest

from autotuner.control.records.atomic_file import STALE_S, clear_unfinished, write_whole

FULL = """
import resource
resource.setrlimit(resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))  # every write fails, as on a full disk
from pathlib import Path
from autotuner.errors import StorageError
folder = Path({folder!r})
try:
    {work}
except StorageError as error:
    print("refused:", error)
"""
BEGIN = (
    "from autotuner.control.records.journal import Journal; "
    "Journal(folder).begin({'tuning': 'T1', 'loop': 'TIC-101', 'device': 'abc', 'started_at': 'now', 'request': {}})"
)
MADE = "from autotuner.service.security.tokens import Role, Tokens; Tokens(folder).add('eve', Role.VIEWER)"
WATCH = (
    "from autotuner.service.operations.watch_list import WatchList; "
    "WatchList(folder / 'watched.json').note('TIC-101', None)"
)


def unfinished(folder):
    return sorted(path.name for path in folder.rglob("*.new"))


@pytest.mark.skipif(sys.platform == "win32", reason="has no limit of the size of files")
@pytest.mark.parametrize(("work", "told"), [(BEGIN, "refused"), (MADE, "refused"), (WATCH, "")])
def test_a_full_disk_is_left_without_an_empty_file(tmp_path, work, told):
    text = FULL.format(folder=str(tmp_path), work=work)
    ran = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    assert ran.stdout.startswith(told)
    assert unfinished(tmp_path) == []
    assert list(tmp_path.glob("*.json")) == []


def test_what_was_there_stays_when_it_cannot_be_written_over(tmp_path, monkeypatch):
    path = tmp_path / "watched.json"
    write_whole(path, b"old")

    def no_space(_self, _target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.replace", no_space)
    with pytest.raises(OSError, match="No space"):
        write_whole(path, b"new")
    assert path.read_bytes() == b"old"
    assert unfinished(tmp_path) == []


def test_it_is_written_with_its_permissions(tmp_path):
    path = tmp_path / "folder" / "tokens.json"
    write_whole(path, b"secret", mode=0o600, sync=True)
    assert path.read_bytes() == b"secret"
    if sys.platform != "win32":
        assert path.stat().st_mode & 0o777 == 0o600


def aged(path, age_s):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"")
    stamp_s = path.stat().st_mtime - age_s
    os.utime(path, (stamp_s, stamp_s))


def test_what_a_killed_program_left_goes_with_the_next_start_and_what_is_being_written_does_not(tmp_path):
    for name, age_s in (("watched.new", 2 * STALE_S), ("tokens.new", 2 * STALE_S), ("T2.new", 0.0)):
        aged(tmp_path / name, age_s)
    clear_unfinished(tmp_path)
    assert unfinished(tmp_path) == ["T2.new"]


def test_a_folder_that_is_not_there_has_nothing_unfinished(tmp_path):
    clear_unfinished(tmp_path / "nowhere")
    assert not (tmp_path / "nowhere").exists()
