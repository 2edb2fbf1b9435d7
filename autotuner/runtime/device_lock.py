"""One device, one tuning, across programs: a lock on a file, which the operating system takes back with its process.

Rule of this file: the lock protects programs that share a data directory; what the file says is for messages only.
"""

from __future__ import annotations

import contextlib
import os
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

if sys.platform == "win32":
    import msvcrt

    def _lock(file: int) -> None:
        msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
else:
    import fcntl

    def _lock(file: int) -> None:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


class DeviceLock:
    """A lock that is held until `release`, or until the process ends."""

    def __init__(self, file: int) -> None:
        self.file = file

    def shared(self) -> DeviceLock:
        """Return the lock once more: it is held until both are released."""
        return DeviceLock(os.dup(self.file))

    def release(self) -> None:
        """Give it back; where another process has the same file open, it holds the lock on."""
        os.close(self.file)


def acquire(path: Path, name: str) -> DeviceLock | None:
    """Return the lock, or None when it is held; `name` is what others are told.

    Raises
    ------
    OSError
        The file can neither be made nor opened.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    file = _open(path)
    try:
        _lock(file)
    except OSError:
        os.close(file)
        return None
    with contextlib.suppress(OSError):  # a full disk must not keep a loop from being restored
        os.ftruncate(file, 0)
        os.write(file, name.encode())
    return DeviceLock(file)


def holder(path: Path) -> str:
    """Return who holds the lock, as far as the file tells."""
    try:
        return path.read_text(encoding="utf-8") or "unknown"
    except OSError:
        return "unknown"


def _open(path: Path) -> int:
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o644)
    except OSError:
        return os.open(path, os.O_RDONLY)
