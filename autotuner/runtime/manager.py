"""The loops and their tunings: who may start what, and how everything ends.

Rules of this file: one tuning a loop at a time; a tuning that was started is found under its identifier as long as the
manager lives; closing the manager ends every running tuning and waits until its output is restored; from then on
nothing is started.
"""

from __future__ import annotations

import asyncio
import secrets
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from autotuner.core.verdict import aborted
from autotuner.errors import LoopBusyError, ShuttingDownError, UnknownTuningError
from autotuner.runtime.plugins import make_backend
from autotuner.runtime.tuning import Tuning, TuningRequest

if TYPE_CHECKING:
    from collections.abc import Callable

    from autotuner.configuration import Configuration
    from autotuner.ports import Backend
    from autotuner.runtime.arithmetic import Arithmetic

KEPT = 200
"""Ended tunings that are remembered; the oldest go first."""


def random_id() -> str:
    """Return a new identifier that nobody guesses."""
    return secrets.token_hex(6)


@dataclass(slots=True)
class Manager:
    """All loops of one service.

    Attributes
    ----------
    configuration : Configuration
        The loops.
    arithmetic : Arithmetic
        Where identification runs.
    new_id : callable
        Makes identifiers of tunings.
    tunings : dict of str to Tuning
        The tunings by identifier, oldest first.
    closing : bool
        Whether the manager is being closed.
    """

    configuration: Configuration
    arithmetic: Arithmetic
    new_id: Callable[[], str] = random_id
    tunings: dict[str, Tuning] = field(default_factory=dict)
    closing: bool = False
    _backends: dict[str, Backend] = field(default_factory=dict)
    _tasks: dict[str, asyncio.Task[object]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._backends = {
            name: make_backend(loop.driver, loop.device, f"loops.{name}")
            for name, loop in self.configuration.loops.items()
        }

    def running(self, loop: str) -> Tuning | None:
        """Return the tuning that holds the loop, or None."""
        self.configuration.loop(loop)
        return next((t for t in self.tunings.values() if t.loop == loop and t.id in self._tasks), None)

    def start(self, loop: str, request: TuningRequest) -> Tuning:
        """Start a tuning.

        Raises
        ------
        UnknownLoopError
            No such loop.
        LoopBusyError
            Another tuning holds the loop; its identifier is in the error.
        ShuttingDownError
            The manager is being closed.
        """
        table = self.configuration.loop(loop)
        if self.closing:
            raise ShuttingDownError
        if (holder := self.running(loop)) is not None:
            raise LoopBusyError(loop, holder.id)
        tuning = Tuning(self.new_id(), loop, request)
        self.tunings[tuning.id] = tuning
        self._forget_oldest()
        work = tuning.conduct(table, self._backends[loop], self.arithmetic)
        task = self._tasks[tuning.id] = asyncio.create_task(work, name=f"tuning-{tuning.id}")
        task.add_done_callback(lambda _: self._tasks.pop(tuning.id, None))
        return tuning

    def tuning(self, tuning_id: str) -> Tuning:
        """Return a tuning; raise `UnknownTuningError` when there is none."""
        if tuning_id not in self.tunings:
            raise UnknownTuningError(
                "is not a known tuning", field="tuning", value=tuning_id, remedy="List the tunings of the loop."
            )
        return self.tunings[tuning_id]

    async def close(self) -> None:
        """End every running tuning, wait until its output is restored, and give the workers back; may be repeated."""
        self.closing = True
        for tuning in self.tunings.values():
            if not tuning.ended:
                tuning.abort(aborted("shutdown", "the service was stopped", "Start the tuning again."))
        await asyncio.gather(*self._tasks.values(), return_exceptions=True)
        self.arithmetic.close()

    def _forget_oldest(self) -> None:
        ended = [tuning_id for tuning_id, tuning in self.tunings.items() if tuning.ended]
        for tuning_id in ended[: max(len(self.tunings) - KEPT, 0)]:
            del self.tunings[tuning_id]
