"""What stood in a device before its gains were changed, on disk before the first of them is changed.

One JSON object a line, in the order in which it happened:

    {"apply": {"tuning": .., "at": .., "form": .., "old": {"kp": 1.0, ..}, "wanted": {..}}}     before the first write
    {"held": {"kp": 3.21, ..}, "at": ..}                   written, and read back
    {"undone": "..", "at": ..}                             the old ones are back, by a rollback or after a failure

Rules of this file:

1. An `apply` without `undone` behind it can be rolled back; with several, the latest first.
2. A line counts when it is whole: what the end of a killed program left of its last line is dropped.
"""

from __future__ import annotations

import asyncio
import json
import os
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from autotuner.errors import StorageError
from autotuner.runtime.journal_file import line, whole_bytes
from autotuner.runtime.ticker import utc_now

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

APPEND = os.O_WRONLY | os.O_CREAT | os.O_APPEND | getattr(os, "O_BINARY", 0)


@dataclass(frozen=True, slots=True)
class Change:
    """One change of a device's gains.

    Attributes
    ----------
    tuning : str
        The tuning that the gains came from; empty for gains given by hand.
    at : str
        When it began, UTC.
    form : str
        The device's form.
    old, wanted : mapping of str to float
        Number of each signal before, and as it was to be.
    held : mapping of str to float or None
        As it was read back; None when that was not reached.
    """

    tuning: str
    at: str
    form: str
    old: Mapping[str, float]
    wanted: Mapping[str, float]
    held: Mapping[str, float] | None = None


@dataclass(slots=True)
class GainsLedger:
    """The changes of one loop's gains that can be undone.

    Attributes
    ----------
    path : Path or None
        The file; None for a device that does not outlive the program.
    in_place : bool
        Whether to wait for the disk instead of leaving the event loop to others meanwhile: in virtual time.
    """

    path: Path | None
    in_place: bool = False
    _kept: list[Change] = field(default_factory=list)

    async def latest(self) -> Change | None:
        """Return the latest change that is still in the device; raise `StorageError` when the file cannot be read.

        The file is read anew: another program may have changed the gains since.
        """
        await self._away(self._load)
        return self._kept[-1] if self._kept else None

    async def begin(self, change: Change) -> None:
        """Put a change on the disk that is about to be made; raise `StorageError` when that cannot be done."""
        await self.latest()
        await self._put({"apply": {name: value for name, value in asdict(change).items() if name != "held"}})

    async def finish(self, held: Mapping[str, float]) -> None:
        """Take note of what was read back after the latest change."""
        await self._put({"held": dict(held), "at": utc_now()})

    async def undo(self, why: str) -> None:
        """Take note that the latest change is undone."""
        await self._put({"undone": why, "at": utc_now()})

    async def _put(self, entry: dict[str, object]) -> None:
        await self._away(self._write, line(entry))
        _take(self._kept, entry)

    async def _away(self, function: Any, *args: object) -> None:
        if self.path is None:
            return
        try:
            if self.in_place:
                function(*args)
            else:
                await asyncio.to_thread(function, *args)
        except OSError as error:
            raise StorageError(
                f"cannot be used: {error.strerror}",
                field=str(self.path),
                remedy="Make room, or set service.data_directory to a folder that can be written.",
            ) from error

    def _load(self) -> None:
        assert self.path is not None  # noqa: S101 - asked by the caller
        kept: list[Change] = []
        if self.path.exists():
            for text in self.path.read_bytes()[: whole_bytes(self.path)].splitlines():
                _take(kept, json.loads(text))
        self._kept = kept

    def _write(self, text: bytes) -> None:
        assert self.path is not None  # noqa: S101 - asked by the caller
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self.path.exists():
            os.truncate(self.path, whole_bytes(self.path))
        file = os.open(self.path, APPEND, 0o644)
        try:
            os.write(file, text)
            os.fsync(file)
        finally:
            os.close(file)


def _take(kept: list[Change], entry: Mapping[str, Any]) -> None:
    """Take the next line into the changes that are still in the device."""
    match entry:
        case {"apply": change}:
            kept.append(Change(**change))
        case {"held": held} if kept:
            kept[-1] = replace(kept[-1], held=held)
        case {"undone": _} if kept:
            kept.pop()


def ledger_of(folder: Path, loop: str, *, kept: bool, in_place: bool) -> GainsLedger:
    """Return the ledger of a loop in a data directory; one in memory only where nothing is to be kept."""
    return GainsLedger(folder / "gains" / f"{quote(loop, safe='')}.jsonl" if kept else None, in_place)
