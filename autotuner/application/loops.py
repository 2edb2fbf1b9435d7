"""Interface of the manager for the runs besides tunings: `autotuner.application.manager` implements it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, TypeVar

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Coroutine

    from autotuner.application.operations import Operations
    from autotuner.application.tuning_run import TuningRequest, TuningRun
    from autotuner.configuration import Configuration, LoopTable
    from autotuner.control.compute_port import ComputePool
    from autotuner.control.records.journal import Journal
    from autotuner.control.records.open_journal import OpenJournal
    from autotuner.ports import Backend

T = TypeVar("T")


class Loops(Protocol):
    """Operations of the manager that a run over operating points, a monitor and a recovery need."""

    @property
    def configuration(self) -> Configuration:
        """The loops."""

    @property
    def pool(self) -> ComputePool:
        """Compute pool."""

    @property
    def tunings(self) -> dict[str, TuningRun]:
        """The tunings by identifier."""

    @property
    def journal(self) -> Journal:
        """Journal of disturbed loops."""

    @property
    def closing(self) -> bool:
        """Whether the service is being stopped."""

    def new_id(self) -> str:
        """Return a new identifier."""

    def start(self, loop: str, request: TuningRequest, *, within: OpenJournal | None = None) -> TuningRun:
        """Start a tuning; `within` is the journal of the run that it belongs to."""

    def operations(self, loop: str) -> Operations:
        """Return the operations of a loop."""

    def device(self, loop: str) -> tuple[LoopTable, Backend]:
        """Return a loop's table and device; raise `UnknownLoopError` when there is no such loop."""

    def must_be_given_back(self, loop: str) -> None:
        """Raise `LoopBusyError` where a tuning or a recovery holds the loop."""

    async def until_free(self, tuning: TuningRun) -> None:
        """Wait until a tuning has ended and holds its loop no more."""

    async def visit(self, loop: str, work: Callable[[], Coroutine[object, object, T]], *, restores: bool = False) -> T:
        """Do short work on the device of a loop that is not being tuned."""

    def hold(self, tuning: TuningRun, work: Coroutine[object, object, object]) -> asyncio.Task[object]:
        """Let a tuning hold its loop until `work` is done."""

    async def leave(self, loop: str) -> None:
        """End the visits to a device."""
