"""The leases of a data directory: what is disturbed is on the disk before it is disturbed.

A tuning has one, a verification, a run over operating points, and a change of gains.

Invariants:

1. Before the first write, the marker of the device and the found values are on the disk itself. A level beyond those
   written before is on the disk before it is written; where that fails, the marker is widened to the whole envelope
   of the loop, in place. So a disk that fills or fails later does not change what a recovery does.
2. The control loop does not wait for the disk otherwise: a thread of the store writes, and many loops share a commit.
3. A disk that fails refuses a new tuning; a running one, and a restore, go on without it.
4. One device, one lease: a lock that dies with its process keeps two programs from driving the same output, and shows
   an interrupted tuning from one that runs elsewhere. A run over operating points shares its lock with its tunings.
5. What a marker names and the store cannot show is unresolved: its loop is held, and nothing is written, until a person
   has confirmed how the loop is.
"""

from __future__ import annotations

import contextlib
import json
import logging
import secrets
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from autotuner.configuration import state_directory
from autotuner.control.records import device_lock
from autotuner.control.records.lease_record import (
    INTERRUPTED,
    VERSION,
    DamagedRecordError,
    Kind,
    LeaseRecord,
    read_record,
)
from autotuner.control.records.open_journal import OpenJournal, storage_error
from autotuner.control.records.store import LEASES, Store, row
from autotuner.errors import LoopBusyError, OutputUnknownError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.control.records.device_lock import DeviceLock

KEPT = 200
"""Ended leases that are kept; the oldest go first."""
DEVICES = "devices"
"""Folder of the locks that count for all data directories, in the state directory of the platform."""
MARKERS = "leases"
"""Folder of the locks and markers of the devices."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Unresolved:
    """A device that was disturbed, without a record of its found values.

    Attributes
    ----------
    device, loop : str
        Its identity, `device_key` of its loop, or the name of the loop; empty where that is not known.
    name : str
        The lease, as the marker of the device names it.
    why : str
        What is wrong with its record.
    """

    device: str
    loop: str
    name: str
    why: str

    def is_of(self, loop: str, device: str) -> bool:
        """Return whether it is the device of that loop."""
        return (self.device or device) == device and (self.loop or loop) == loop


@dataclass(frozen=True, slots=True)
class Journal:
    """The leases of one data directory.

    Attributes
    ----------
    folder : Path
        The data directory; made when first needed.
    in_place : bool
        Whether writes wait for the disk in the caller's thread: in virtual time.
    """

    folder: Path
    in_place: bool = False
    store: Store = field(init=False, repr=False, compare=False)
    _here: set[str] = field(default_factory=set, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "store", Store(self.folder, in_place=self.in_place))

    def begin(self, head: Mapping[str, object], within: OpenJournal | None = None) -> OpenJournal:
        """Begin a lease; `head` describes its operation, `within` is the lease of the run that it belongs to.

        Raises
        ------
        StorageError
            The data directory cannot be written.
        LoopBusyError
            Another program drives the same device.
        OutputUnknownError
            What was disturbed there before is unresolved.
        """
        name = _name(head)
        try:
            lock = within.lock.shared() if within else self._locked(head)
        except OSError as error:
            raise storage_error(self.folder, error) from error
        with contextlib.ExitStack() as undo:
            undo.callback(lock.release)
            if within is None and (held := self._unresolved_in(str(head["device"]))) is not None:
                raise OutputUnknownError(str(head["loop"]), held.name, held.why)
            try:
                self._forget_oldest()
                self.store.open()
                undo.callback(self.store.close)
                self.store.submit([row(LEASES, name, 0, {"record": VERSION, **head})]).result()
                if within is None:
                    lock.mark(name)
            except OSError as error:
                raise storage_error(self.folder, error) from error
            undo.pop_all()
        return OpenJournal(self.store, name, lock, in_place=self.in_place, here=self._here, within=within is not None)

    def resume(self, kept: LeaseRecord) -> OpenJournal:
        """Go on with an interrupted lease, as far as the disk allows.

        Raises
        ------
        StorageError
            The data directory cannot be used at all.
        LoopBusyError
            It was not interrupted: its tuning runs in another program.
        """
        try:
            lock = self._locked({"device": kept.device, "loop": kept.loop})
        except OSError as error:
            raise storage_error(self.folder, error) from error
        try:
            self.store.open()
        except OSError as error:
            lock.release()
            raise storage_error(self.folder, error) from error
        return OpenJournal(self.store, kept.name, lock, in_place=self.in_place, here=self._here, resumed=True)

    def interrupted(self, loop: str | None = None) -> list[LeaseRecord]:
        """Return the leases, of one loop or of all, that have no end; the oldest first.

        One that runs in another program is among them; `resume` distinguishes it.
        """
        last = self._last_entries()
        kept = (self._read(name) for name in self._names() if "ended" not in last.get(name, {}))
        left = [one for one in kept if one is not None and loop in {None, one.loop}]
        for one in left:
            one.restored = one.restored or self._is_released(one)
        return left

    def left(self, loop: str | None = None) -> list[LeaseRecord]:
        """Return those of `interrupted` that this program neither runs nor has ended; what was in a run before it."""
        left = [kept for kept in self.interrupted(loop) if kept.name not in self._here]
        return sorted(left, key=lambda kept: kept.kind is Kind.SCHEDULE)

    def unresolved(self, loop: str, device: str) -> Unresolved | None:
        """Return what the marker of a device names as disturbed and the store cannot show; None where there is none."""
        older = (one for one in self._of_older_version() if one.is_of(loop, device))
        found = self._unresolved_in(device) or next(older, None)
        return None if found is None or self._is_driven(device) else found

    def confirm(self, loop: str, device: str) -> None:
        """Record that a person has set a loop right: what was interrupted there is not restored any more.

        Raises
        ------
        LoopBusyError
            Another program drives it.
        StorageError
            The data directory cannot be used at all.
        """
        try:
            lock = self._locked({"device": device, "loop": loop})
            try:
                lock.clear()
                for one in self._of_older_version():
                    if one.is_of(loop, device):
                        older = self.folder / "journal" / one.name
                        older.rename(older.with_suffix(".confirmed"))
            finally:
                lock.release()
        except OSError as error:
            raise storage_error(self.folder, error) from error

    def is_held(self, kept: LeaseRecord) -> bool:
        """Return whether a program drives its device now."""
        return self._is_driven(kept.device)

    def _is_driven(self, device: str) -> bool:
        with contextlib.suppress(OSError):
            lock = device_lock.acquire(self._markers / device, _of_machine(device))
            if lock is None:
                return True
            lock.release()
        return False

    def again(self, kept: LeaseRecord) -> LeaseRecord:
        """Return what the store holds now that it is held: another program may have gone on with it until then."""
        return self._read(kept.name) or kept

    def of_tuning(self, tuning: str) -> LeaseRecord | None:
        """Return the record of a tuning; None where there is none."""
        return self._read(tuning) if tuning in self._names() else None

    def made_good(self) -> list[LeaseRecord]:
        """Return what was interrupted and whose loop was restored later; the oldest first."""
        last = self._last_entries()
        names = [name for name in self._names() if last.get(name, {}).get("ended", {}).get("code") == INTERRUPTED]
        return [kept for kept in map(self._read, names) if kept is not None]

    @property
    def _markers(self) -> Path:
        return self.folder / MARKERS

    def _locked(self, head: Mapping[str, object]) -> DeviceLock:
        at, machine = self._markers / str(head["device"]), _of_machine(str(head["device"]))
        lock = device_lock.acquire(at, machine)
        if lock is None:
            raise LoopBusyError(str(head["loop"]), device_lock.holder(at, machine))
        return lock

    def _unresolved_in(self, device: str) -> Unresolved | None:
        found = device_lock.marker(self._markers / device)
        if found is None or not found[0]:
            return None
        name, _ = found
        try:
            read_record(self.store, name)
        except (OSError, DamagedRecordError) as error:
            return Unresolved(device, "", name, str(error))
        return None

    def _of_older_version(self) -> list[Unresolved]:
        """Return what a version before the store left disturbed: its journals are not read, only found."""
        left = []
        with contextlib.suppress(OSError):
            for path in sorted((self.folder / "journal").glob("*.jsonl")):
                lines = path.read_bytes().splitlines()
                if not lines or b'"ended"' not in lines[-1]:
                    loop = ""
                    with contextlib.suppress(ValueError, AttributeError, IndexError):
                        loop = str(json.loads(lines[0]).get("loop", ""))
                    left.append(Unresolved("", loop, path.name, f"{path} is of an older version, and has no end"))
        return left

    def _is_released(self, kept: LeaseRecord) -> bool:
        """Return whether the marker of its device does: on a full disk the record itself has no end."""
        found = device_lock.marker(self._markers / kept.device)
        return found is not None and not found[0]

    def _names(self) -> list[str]:
        try:
            return self.store.owners()
        except OSError as error:
            _log.error("the leases in %s cannot be read: %s", self.store.path, error)
            return []

    def _read(self, name: str) -> LeaseRecord | None:
        try:
            kept = read_record(self.store, name)
        except (OSError, DamagedRecordError) as error:
            _log.error("%s: it is not used", error)
            return None
        found = device_lock.marker(self._markers / kept.device)
        kept.wide = kept.wide or (found is not None and found[1] and bool(found[0]))
        return kept

    def _last_entries(self) -> Mapping[str, Mapping[str, dict[str, object]]]:
        try:
            return self.store.last_entries()
        except OSError:
            return {}

    def _forget_oldest(self) -> None:
        last = self._last_entries()
        ended = [name for name in self._names() if "ended" in last.get(name, {})]
        if len(ended) > KEPT:
            self.store.delete(ended[:-KEPT])


def _of_machine(device: str) -> Path:
    """Return the file of the lock that counts for all data directories."""
    return Path(state_directory()) / DEVICES / device


def _name(head: Mapping[str, object]) -> str:
    """Return the name of a lease; a verification has one beside that of its tuning, each change of gains its own."""
    kind = head.get("kind", Kind.TUNING)
    beside = {Kind.VERIFICATION: f".{kind}", Kind.GAINS: f".{kind}-{secrets.token_hex(4)}"}
    return f"{head['tuning']}{beside.get(Kind(str(kind)), '')}"
