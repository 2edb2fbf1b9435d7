"""Result files of a command: checked before the loop is moved, and never lost afterwards.

Invariants:

1. A file that cannot be written is refused before the first device is opened.
2. What cannot be written after an experiment is written to the data directory instead, and reported by its path.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from autotuner.commands.terminal.output import say
from autotuner.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

PICTURES = (".png", ".svg", ".pdf")
"""Endings of pictures."""
REFUGE = "results"
"""Folder of the data directory for results whose own path cannot be written."""


def check_writable(field: str, path: Path, endings: Sequence[str] = ()) -> None:
    """Refuse a file that cannot be written, by opening it; its content is kept.

    Raises
    ------
    InputError
        Its ending is not one of `endings`, or it cannot be opened.
    """
    if endings and path.suffix.lower() not in endings:
        raise InputError("has another ending", field=field, value=str(path), remedy=f"Use one of {', '.join(endings)}.")
    existed = path.exists()
    try:
        with path.open("ab"):
            pass
        if not existed:
            path.unlink()
    except OSError as error:
        raise _unwritable(field, path, error) from error


def write_file(field: str, path: Path, write: Callable[[Path], object]) -> None:
    """Write a file; raise `InputError` when that fails."""
    try:
        write(path)
    except OSError as error:
        raise _unwritable(field, path, error) from error


@dataclass(frozen=True, slots=True)
class Results:
    """Results of a run, with the folder for those whose own path fails; `name` identifies the run."""

    data_directory: Path
    name: str

    def write(self, field: str, path: Path | None, write: Callable[[Path], object]) -> int:
        """Write a result where a path was given; return the exit code, 1 when it is somewhere else."""
        if path is None:
            return 0
        try:
            write_file(field, path, write)
        except InputError as error:
            say(error)
            self.keep(path.name, write)
            return 1
        return 0

    def keep(self, name: str, write: Callable[[Path], object]) -> None:
        """Write a result to the data directory, and report its path."""
        path = self.data_directory / REFUGE / f"{re.sub(r'[^A-Za-z0-9._-]+', '-', self.name)}-{name}"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write(path)
        except OSError as error:
            say(_unwritable("result", path, error))
        else:
            say(f"the result is in {path}")


def _unwritable(field: str, path: Path, error: OSError) -> InputError:
    return InputError(
        f"cannot be written: {error.strerror or error}", field=field, value=str(path), remedy="Choose another place."
    )
