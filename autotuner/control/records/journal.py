"""Write-ahead journal of the leases in a data directory: a disturbance is on disk before it happens.

A tuning, a verification, a run over operating points and a change of gains each have a lease.

Invariants:

1. Before the first write, the marker of the device and the found values are on disk. A level beyond the
   earlier ones is on disk before it is written; where that fails, the marker is widened to the whole envelope
   of the loop, in place. A disk that fills or fails later therefore does not change a recovery.
2. The control loop does not wait for the disk otherwise: a thread of the store writes, and many loops share a commit.
3. A disk failure refuses a new tuning; a running tuning, and a restore, continue without the disk.
4. One device, one lease: a lock that ends with its process keeps two programs from driving the same output, and
   distinguishes an interrupted tuning from one that runs elsewhere. A run over operating points shares its lock with
   its tunings.
5. A marker without a matching record in the store is unresolved: the loop is held, and nothing is written, until an
   operator has confirmed its state.
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

    def resume(self, record: LeaseRecord) -> OpenJournal:
        """Go on with an interrupted lease, as far as the disk allows.

        Raises
        ------
        StorageError
            The data directory cannot be used at all.
        LoopBusyError
            It was not interrupted: its tuning runs in another program.
        """
        try:
            lock = self._locked({"device": record.device, "loop": record.loop})
        except OSError as error:
            raise storage_error(self.folder, error) from error
        try:
            self.store.open()
        except OSError as error:
            lock.release()
            raise storage_error(self.folder, error) from error
        return OpenJournal(self.store, record.name, lock, in_place=self.in_place, here=self._here, resumed=True)

    def interrupted(self, loop: str | None = None) -> list[LeaseRecord]:
        """Return the leases, of one loop or of all, that have no end; the oldest first.

        One that runs in another program is among them; `resume` distinguishes it.
        """
        last = self._last_entries()
        kept = (self._read(name) for name in self._names() if "ended" not in last.get(name, {}))
        left = [record for record in kept if record is not None and loop in {None, record.loop}]
        for record in left:
            record.restored = record.restored or self._is_released(record)
        return left

    def left(self, loop: str | None = None) -> list[LeaseRecord]:
        """Return the interrupted leases that this program neither runs nor has ended; those within a run come first."""
        left = [record for record in self.interrupted(loop) if record.name not in self._here]
        return sorted(left, key=lambda record: record.kind is Kind.SCHEDULE)

    def unresolved(self, loop: str, device: str) -> Unresolved | None:
        """Return the marker of a device without a matching record in the store; None where there is none."""
        older = (record for record in self._of_older_version() if record.is_of(loop, device))
        found = self._unresolved_in(device) or next(older, None)
        return None if found is None or self._is_driven(device) else found

    def confirm(self, loop: str, device: str) -> None:
        """Record that an operator has set a loop right: its interrupted leases are not restored any more.

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
                for record in self._of_older_version():
                    if record.is_of(loop, device):
                        older = self.folder / "journal" / record.name
                        older.rename(older.with_suffix(".confirmed"))
            finally:
                lock.release()
        except OSError as error:
            raise storage_error(self.folder, error) from error

    def is_held(self, record: LeaseRecord) -> bool:
        """Return whether a program drives its device now."""
        return self._is_driven(record.device)

    def _is_driven(self, device: str) -> bool:
        with contextlib.suppress(OSError):
            lock = device_lock.acquire(self._markers / device, _of_machine(device))
            if lock is None:
                return True
            lock.release()
        return False

    def again(self, record: LeaseRecord) -> LeaseRecord:
        """Read a held record again: another program may have continued it until then."""
        return self._read(record.name) or record

    def of_tuning(self, tuning: str) -> LeaseRecord | None:
        """Return the record of a tuning; None where there is none."""
        return self._read(tuning) if tuning in self._names() else None

    def made_good(self) -> list[LeaseRecord]:
        """Return the interrupted leases whose loop was restored later; the oldest first."""
        last = self._last_entries()
        names = [name for name in self._names() if last.get(name, {}).get("ended", {}).get("code") == INTERRUPTED]
        return [record for record in map(self._read, names) if record is not None]

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
        """Return the markers of a version without the store: its journals are only found, not read."""
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

    def _is_released(self, record: LeaseRecord) -> bool:
        """Return whether the marker of its device does: on a full disk the record itself has no end."""
        found = device_lock.marker(self._markers / record.device)
        return found is not None and not found[0]

    def _names(self) -> list[str]:
        try:
            return self.store.owners()
        except OSError as error:
            _log.error("the leases in %s cannot be read: %s", self.store.path, error)
            return []

    def _read(self, name: str) -> LeaseRecord | None:
        try:
            record = read_record(self.store, name)
        except (OSError, DamagedRecordError) as error:
            _log.error("%s: it is not used", error)
            return None
        found = device_lock.marker(self._markers / record.device)
        record.wide = record.wide or (found is not None and found[1] and bool(found[0]))
        return record

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
    """Return the name of a lease: that of its tuning, with a suffix for a verification or a change of gains."""
    kind = head.get("kind", Kind.TUNING)
    beside = {Kind.VERIFICATION: f".{kind}", Kind.GAINS: f".{kind}-{secrets.token_hex(4)}"}
    return f"{head['tuning']}{beside.get(Kind(str(kind)), '')}"
