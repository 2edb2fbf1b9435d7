"""What is done with one loop: its work as a value, and the station at which it is done.

    Work -> begin(Station) -> Operation: run, abort

A work is a frozen value, so that it can be ordered from the loop process. The same operation is run in place in virtual
time, and where there are no other processes.

Invariant: an operation that ends leaves its loop as it was found, as its work requires, or reports why not. One
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
    """What an operation works with.

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
        Takes what is published meanwhile.
    journal : OpenJournal or None
        Where what is disturbed is recorded; None where nothing outlives the program.
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
        """Return what writes the gains; raise `InputError` where the configuration does not state where they are."""
        form = required_form(self.loop, self.backend, self.name)
        return DeviceGainsWriter(self.name, self.loop, self.backend, form, self.ledger)


class Operation(Protocol):
    """Something that is done with a loop."""

    async def run(self) -> object:
        """Do it; return the result."""

    def abort(self, verdict: Verdict) -> None:
        """Request the end: the loop is released."""


class Work(Protocol):
    """What is to be done, as a frozen value."""

    @property
    def kind(self) -> Kind:
        """What its record is of."""

    def begin(self, station: Station) -> Operation:
        """Return the operation."""


@runtime_checkable
class Answering(Protocol):
    """An operation that carries out one request after the other, until its release."""

    async def ask(self, name: str, *values: object) -> object:
        """Carry out a request; return the answer."""
