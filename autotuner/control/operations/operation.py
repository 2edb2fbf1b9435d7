"""An operation on one loop: its work as a value, and its execution at a station.

    Work -> begin(Station) -> Operation: run, abort

A work is a frozen value, so that a loop process can execute it. The same operation runs in place in virtual
time, and where there are no other processes.

Invariant: an operation leaves its loop as it was found, or as its work requires, or reports why not. An operation
whose front is gone (`Station.alone`) leaves its record open, for the next start to report.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from autotuner.control.devices.device_gains import required_form
from autotuner.control.gains.apply import DeviceGainsWriter

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from autotuner.configuration import LoopTable
    from autotuner.control.compute_port import ComputePool
    from autotuner.control.records.gains_ledger import GainsLedger
    from autotuner.control.records.lease_record import Kind
    from autotuner.control.records.open_journal import OpenJournal
    from autotuner.core.verdict import Verdict
    from autotuner.ports import Backend


async def no_others() -> None:
    """Do not wait: nothing else is done with the loop."""


@dataclass(slots=True)
class Station:
    """Resources of an operation.

    Attributes
    ----------
    name : str
        The loop's name.
    loop : LoopTable
        The loop.
    backend : Backend
        Its device.
    ledger : GainsLedger
        Keeps the old gains.
    pool : ComputePool
        Where predictions run.
    publish : callable
        Receives published messages.
    journal : OpenJournal or None
        Journal of disturbances; None where nothing outlives the program.
    others : callable
        Waits until nothing else is done with the loop.
    alone : bool
        Whether the front is gone.
    """

    name: str
    loop: LoopTable
    backend: Backend
    ledger: GainsLedger
    pool: ComputePool
    publish: Callable[[object], None]
    journal: OpenJournal | None = None
    others: Callable[[], Awaitable[None]] = no_others
    alone: bool = False

    def writer(self) -> DeviceGainsWriter:
        """Return the writer of the gains; raise `InputError` where the configuration does not map them."""
        form = required_form(self.loop, self.backend, self.name)
        return DeviceGainsWriter(self.name, self.loop, self.backend, form, self.ledger)


class Operation(Protocol):
    """Something that is done with a loop."""

    async def run(self) -> object:
        """Do it; return the result."""

    def abort(self, verdict: Verdict) -> None:
        """Request the end: the loop is released."""


class Work(Protocol):
    """A request for an operation, as a frozen value."""

    @property
    def kind(self) -> Kind:
        """Kind of the record."""

    def begin(self, station: Station) -> Operation:
        """Return the operation."""


@runtime_checkable
class Answering(Protocol):
    """An operation that carries out one request after the other, until its release."""

    async def ask(self, name: str, *values: object) -> object:
        """Carry out a request; return the answer."""
