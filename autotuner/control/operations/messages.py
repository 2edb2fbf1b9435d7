"""The wire between a front and the loop process, one for each operation: whole values, both ways.

    4 bytes length, big-endian | pickle

Invariants:

1. Both ends are this program, over a pair of sockets that no other program can open; therefore pickle is safe.
2. A sender never waits: unread data stays in memory.
3. A lost end is None, never an exception: each side continues without the other.
"""

from __future__ import annotations

import asyncio
import pickle
import select
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from autotuner.core.verdict import aborted

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable

    from autotuner.configuration import LoopTable
    from autotuner.control.operations.operation import Work
    from autotuner.control.records.lease_record import Before
    from autotuner.control.records.open_journal import HandedJournal
    from autotuner.control.reporting.events import Event
    from autotuner.core.model.process import Integrating
    from autotuner.core.recording import Sample
    from autotuner.core.verdict import Verdict

HEADER_BYTES = 4
"""Bytes of the length in front of each message."""
TAKEN_S = 5.0
"""Longest time for which an end that closes waits until the other one has taken the last message, s."""
ALONE = aborted(
    "service_lost",
    "the program that had this loop tuned has gone, or was stopped for longer than front_timeout_s",
    "Start it, and the tuning, again.",
)
"""The end of an operation without a front."""


@dataclass(frozen=True, slots=True)
class Order:
    """Request to the loop process for one operation.

    Attributes
    ----------
    loop : str
        Its name.
    table : LoopTable
        Its table.
    work : Work
        What is to be done.
    carried : object
        The device itself, where it lives in memory (`autotuner.ports.Carried`); None for hardware.
    journal : HandedJournal or None
        Journal of disturbances; None where nothing outlives the program.
    """

    loop: str
    table: LoopTable
    work: Work
    carried: object = None
    journal: HandedJournal | None = None


class Abort(NamedTuple):
    """To the process: end, and give the loop back."""

    verdict: Verdict


class Alive(NamedTuple):
    """To the process: the front is there."""


class WaitNoMore(NamedTuple):
    """To the process: leave the loop as it is where its device does not answer."""


class Inform(NamedTuple):
    """To the process: uncertainty of a model that explains the record so far, see `Experiment.inform`."""

    relative_error: float
    expected_loss: float = 0.0
    integrating: Integrating | None = None


class MethodCall(NamedTuple):
    """To the process: next step of the operation, by the name of its method."""

    name: str
    values: tuple[object, ...]


class Answered(NamedTuple):
    """To the caller: the value, or the error."""

    number: int
    value: object
    error: Exception | None = None


class Compute(NamedTuple):
    """From the process: a pure function for the front to call in its compute pool."""

    number: int
    work: Callable[[], object]


class Published(NamedTuple):
    """From the process: a published message of the operation."""

    what: object


class Done(NamedTuple):
    """From the process: end of the operation with a value or an error; `journal_trouble` is an error of its record."""

    value: object
    error: Exception | None = None
    journal_trouble: str | None = None


class ExperimentState(NamedTuple):
    """Published state of an experiment besides its samples."""

    warnings: tuple[str, ...]
    settings: dict[str, object]


class Report(NamedTuple):
    """Changes of an experiment.

    `events` are in their order; `corrected` are samples that differ from what was published, by their place in the
    record; `state` is None where nothing of it has changed.
    """

    events: list[Event]
    corrected: list[tuple[int, Sample]]
    before: Before | None
    state: ExperimentState | None


class Logged(NamedTuple):
    """From the process: a line for the log."""

    logger: str
    level: int
    text: str


class Closing(NamedTuple):
    """End of an experiment; `carried` is the device where it lives in memory."""

    verdict: Verdict | None
    restored: bool | None
    carried: object


class Wire:
    """One end of a wire, over a socket."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self._writer = reader, writer
        self._due_bytes: int | None = None
        self._hang_up = select.poll()
        self._hang_up.register(writer.get_extra_info("socket"), 0)

    def send(self, message: object) -> None:
        """Send a message; one to an end that is gone is lost.

        No attempt is made: a failed write would close this end, and lose pending messages of the other one.
        """
        data = pickle.dumps(message, pickle.HIGHEST_PROTOCOL)
        if not (self._writer.is_closing() or self._hang_up.poll(0)):
            self._writer.write(len(data).to_bytes(HEADER_BYTES, "big") + data)

    async def receive(self) -> object | None:
        """Return the next message; None when the other end is gone. Cancelled, it loses nothing."""
        try:
            if self._due_bytes is None:
                self._due_bytes = int.from_bytes(await self._reader.readexactly(HEADER_BYTES), "big")
            data = await self._reader.readexactly(self._due_bytes)
        except (asyncio.IncompleteReadError, OSError):
            return None
        self._due_bytes = None
        message: object = pickle.loads(data)  # noqa: S301 - rule 1
        return message

    async def close(self) -> None:
        """Close this end when all has been read, or the other end is closed, or after `TAKEN_S`."""
        self._writer.close()
        try:
            async with asyncio.timeout(TAKEN_S):
                await self._writer.wait_closed()
        except TimeoutError:
            self._writer.transport.abort()
        except OSError:  # the other end is gone
            pass


async def wire_over(end: socket.socket) -> Wire:
    """Return the wire over one of a pair of sockets, which is closed with it."""
    return Wire(*await asyncio.open_unix_connection(sock=end))
