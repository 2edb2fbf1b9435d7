"""One device, one lease: a lock on a file, and the name of the lease in that file.

    <folder>/<device identity>      empty: the loop was released      otherwise: "<width><name of the lease>"

A second lock, in the state directory of the platform, counts for every data directory: two programs that are started in
two folders, or with two data directories, cannot drive one device.

The operating system releases the locks with their process. The name stays until the loop is released, also after a
kill: it is the evidence, apart from the store, that the loop is disturbed.

Invariants:

1. A loop is disturbed only once the name of its lease is on the disk itself; clearing it needs no room on the disk.
2. `width` is one byte that is overwritten in place, so that a full disk does not prevent it: `NARROW` while the store
   holds every level that was written, `WIDE` once it does not.
3. The folder and its files belong to the user of the service alone: another user could hold the lock, and block a
   recovery.
"""

from __future__ import annotations

import contextlib
import os
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

NARROW, WIDE = ".", "W"

if sys.platform == "win32":
    import msvcrt

    def _lock(file: int) -> None:
        msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
else:
    import fcntl

    def _lock(file: int) -> None:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


class DeviceLock:
    """A lock that is held until `release`, or until the process ends.

    Parameters
    ----------
    file : int
        Open file with the lock and the name of the lease.
    machine : int, optional
        Open file with the lock that counts for every data directory.
    """

    def __init__(self, file: int, machine: int | None = None) -> None:
        self.file, self.machine = file, machine

    @property
    def files(self) -> tuple[int, ...]:
        """The open files."""
        return (self.file,) if self.machine is None else (self.file, self.machine)

    def mark(self, name: str) -> None:
        """Write the name of a lease; raise `OSError` where that fails."""
        os.ftruncate(self.file, 0)
        os.lseek(self.file, 0, os.SEEK_SET)
        os.write(self.file, f"{NARROW}{name}".encode())

    def sync(self) -> None:
        """Flush the file to disk; raise `OSError` on failure."""
        os.fsync(self.file)

    def widen(self) -> None:
        """Record that levels were written that the store does not hold; raise `OSError` where that fails."""
        os.lseek(self.file, 0, os.SEEK_SET)
        os.write(self.file, WIDE.encode())

    def clear(self) -> None:
        """Record that the loop was released; a file system that is read-only keeps the name."""
        with contextlib.suppress(OSError):
            os.ftruncate(self.file, 0)

    def shared(self) -> DeviceLock:
        """Return the lock once more: it is held until both are released."""
        return DeviceLock(os.dup(self.file), None if self.machine is None else os.dup(self.machine))

    def release(self) -> None:
        """Release it; where another process has the same file open, that process still holds the lock."""
        os.close(self.file)
        if self.machine is not None:
            os.close(self.machine)


def acquire(path: Path, machine: Path | None = None) -> DeviceLock | None:
    """Return the lock, or None when it is held.

    `machine` is the lock of the device for all data directories of this user; where its folder cannot be used, as in a
    container that keeps nothing else, the lock in the data directory counts alone.

    Raises
    ------
    OSError
        The file can neither be made nor opened.
    """
    file = _locked_file(path)
    if file is None:
        return None
    if machine is None:
        return DeviceLock(file)
    try:
        of_machine = _locked_file(machine)
    except OSError:
        return DeviceLock(file)
    if of_machine is None:
        os.close(file)
        return None
    with contextlib.suppress(OSError):
        os.ftruncate(of_machine, 0)
        os.write(of_machine, f"{path.parent.parent}".encode())
    return DeviceLock(file, of_machine)


def _locked_file(path: Path) -> int | None:
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    with contextlib.suppress(OSError):  # a folder of another user
        path.parent.chmod(0o700)
    file = _open(path)
    try:
        _lock(file)
    except OSError:
        os.close(file)
        return None
    return file


def marker(path: Path) -> tuple[str, bool] | None:
    """Return the lease name in the file and whether it is wide; None without a file, an empty name after a release."""
    try:
        text = path.read_bytes().decode(errors="replace")
    except FileNotFoundError:
        return None
    except OSError:
        return "?", True
    return text[1:], text[:1] != NARROW


def holder(path: Path, machine: Path | None = None) -> str:
    """Return the name of the lease that holds the lock, as far as the files show it."""
    found = marker(path)
    if found and found[0]:
        return found[0]
    if machine is None:
        return "unknown"
    try:
        return f"unknown (data directory {machine.read_text()})"
    except OSError:
        return "unknown"


def _open(path: Path) -> int:
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o600)
    except OSError:
        return os.open(path, os.O_RDONLY)
