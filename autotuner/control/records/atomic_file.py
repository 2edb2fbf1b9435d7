"""Atomic files: written under a temporary name, then renamed in one step.

Invariant: an incomplete file is deleted; the file of a killed program is deleted later, when no
program can be writing it any more.
"""

from __future__ import annotations

import contextlib
import os
from typing import TYPE_CHECKING

from autotuner.control.clock.ticker import seconds_since

if TYPE_CHECKING:
    from pathlib import Path

UNFINISHED = ".new"
STALE_S = 60.0
"""Age from which an unfinished file has no writer any more, s."""
CREATE = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | getattr(os, "O_BINARY", 0)


def write_whole(path: Path, data: bytes, *, mode: int = 0o666, sync: bool = False) -> None:
    """Write a file atomically; raise `OSError` on failure and keep the previous content.

    Parameters
    ----------
    path : Path
        Where; its folder is made when needed.
    data : bytes
        All of it.
    mode : int
        Permissions of a new file, before the umask.
    sync : bool
        Whether to wait for the disk itself.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_suffix(UNFINISHED)
    try:
        with os.fdopen(os.open(unfinished, CREATE, mode), "wb") as file:
            file.write(data)
            if sync:
                file.flush()
                os.fsync(file.fileno())
        unfinished.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            unfinished.unlink()
        raise


def clear_unfinished(folder: Path) -> None:
    """Delete temporary files of killed programs in a folder; ignore files that cannot be deleted."""
    with contextlib.suppress(OSError):  # another program was quicker, or the disk cannot be read
        for path in folder.glob(f"*{UNFINISHED}"):
            if seconds_since(path.stat().st_mtime) > STALE_S:
                path.unlink()
