"""Ledger of the previous gains of a device, on disk before the first gain is changed.

Values in the order in which it happened:

    {"apply": {"tuning": .., "at": .., "form": .., "old": {"kp": 1.0, ..}, "wanted": {..}}}     before the first write
    {"held": {"kp": 3.21, ..}, "at": ..}                   written, and read back
    {"undone": "..", "at": ..}                             the old ones are restored, by a rollback or after a failure

Invariants:

1. An `apply` without a later `undone` can be rolled back; with several, the latest first.
2. A ledger with a damaged row is refused: gains of which it is not known which are the old ones are not written.
"""

from __future__ import annotations

import asyncio
import errno
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

from autotuner.control.clock.ticker import utc_now
from autotuner.control.records.store import CHANGES, row
from autotuner.errors import StorageError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.control.records.store import Store


@dataclass(frozen=True, slots=True)
class Change:
    """A change of a device's gains.

    Attributes
    ----------
    tuning : str
        The tuning of the gains; empty for gains entered by hand.
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
    store : Store or None
        Where they are; None for a device that does not outlive the program.
    loop : str
        The loop's name.
    in_place : bool
        Whether to wait for the disk instead of leaving the event loop to others meanwhile: in virtual time.
    """

    store: Store | None
    loop: str = ""
    in_place: bool = False
    _kept: list[Change] = field(default_factory=list)

    async def latest(self) -> Change | None:
        """Return the latest change that is still in the device; raise `StorageError` when it cannot be read.

        The store is read again: another program may have changed the gains.
        """
        await self._aside(self._load)
        return self._kept[-1] if self._kept else None

    async def begin(self, change: Change) -> None:
        """Put a change on the disk that is about to be made; raise `StorageError` when that cannot be done."""
        await self.latest()
        await self._put({"apply": {name: value for name, value in asdict(change).items() if name != "held"}})

    async def finish(self, held: Mapping[str, float]) -> None:
        """Record the gains read back after the latest change."""
        await self._put({"held": dict(held), "at": utc_now()})

    async def undo(self, reason: str) -> None:
        """Record that the latest change is undone."""
        await self._put({"undone": reason, "at": utc_now()})

    async def _put(self, entry: dict[str, object]) -> None:
        await self._aside(self._write, entry)
        _take(self._kept, entry)

    async def _aside(self, function: Any, *args: object) -> None:
        if self.store is None:
            return
        try:
            if self.in_place:
                function(*args)
            else:
                await asyncio.to_thread(function, *args)
        except OSError as error:
            raise StorageError(
                f"cannot be used: {error.strerror}",
                field=str(self.store.path),
                remedy="Make room, or set service.data_directory to a folder that can be written.",
            ) from error

    def _load(self) -> None:
        assert self.store is not None  # noqa: S101 - asked by the caller
        rows = self.store.rows(CHANGES, self.loop)
        if rows.damaged:
            raise OSError(
                errno.EIO, f"the gains ledger of loop {self.loop} is damaged; compare the device's gains by hand"
            )
        changes: list[Change] = []
        for entry in rows.values:
            _take(changes, entry)
        self._kept = changes

    def _write(self, entry: dict[str, object]) -> None:
        assert self.store is not None  # noqa: S101 - asked by the caller
        self.store.open()
        try:
            place = self.store.count(CHANGES, self.loop)
            self.store.submit([row(CHANGES, self.loop, place, entry)], safe=True).result()
        finally:
            self.store.close()


def _take(changes: list[Change], entry: Mapping[str, Any]) -> None:
    """Take the next value into the changes that are still in the device."""
    match entry:
        case {"apply": change}:
            changes.append(Change(**change))
        case {"held": held} if changes:
            changes[-1] = replace(changes[-1], held=held)
        case {"undone": _} if changes:
            changes.pop()
