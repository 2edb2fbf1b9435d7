"""Computations of requests, in separate worker processes.

Invariants:

1. A tuning never waits for a request: its analysis has other workers (`Manager.pool`).
2. The queue of each client is bounded, and so is that of all clients: beyond it a request is refused at once.
3. Uploaded recordings are processed one at a time: a worker remains for all other requests, and few are in memory.
"""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, ParamSpec, TypeVar

from autotuner.service.security.limits import Places

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from autotuner.control.compute_port import ComputePool

P = ParamSpec("P")
R = TypeVar("R")

MOST, MOST_OF_A_CLIENT = 32, 8
"""Computations queued or running: of all clients, and of one."""
UPLOADS, UPLOADS_OF_A_CLIENT = 4, 2
"""Uploaded recordings in memory: of all clients, and of one."""


class ComputeQueue:
    """The computations of all clients.

    Parameters
    ----------
    pool : ComputePool
        Where they run.
    """

    def __init__(self, pool: ComputePool) -> None:
        self._pool = pool
        self._computations = Places(MOST, MOST_OF_A_CLIENT)
        self._uploads = Places(UPLOADS, UPLOADS_OF_A_CLIENT)
        self._upload_turn = asyncio.Lock()

    def of(self, client: str) -> ClientComputations:
        """Return the computations of a client."""
        return ClientComputations(self, client)

    async def run(self, client: str, function: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> R:
        """Return the function's value, or raise its exception.

        Raises
        ------
        TooManyRequestsError, OverloadedError
            The client, or all of them together, have too many queued.
        """
        with self._computations.place(client):
            return await self._pool.run(function, *args, **kwargs)

    @asynccontextmanager
    async def upload(self, client: str) -> AsyncIterator[asyncio.Lock]:
        """Reserve a place for an uploaded recording, from its first byte on until its computation ends.

        Raises
        ------
        TooManyRequestsError, OverloadedError
            As `run` does.
        """
        with self._uploads.place(client):
            yield self._upload_turn

    def interrupt(self) -> None:
        """End the worker processes now; waiting requests get `ShuttingDownError`."""
        self._pool.interrupt()

    def close(self) -> None:
        """End the worker processes, and wait until they are gone."""
        self._pool.close()


class ClientComputations:
    """The computations of one client.

    Parameters
    ----------
    queue : ComputeQueue
        That of all clients.
    client : str
        Its name there.
    """

    def __init__(self, queue: ComputeQueue, client: str) -> None:
        self._queue, self._client = queue, client

    async def run(self, function: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> R:
        """Return the function's value; see `ComputeQueue.run`."""
        return await self._queue.run(self._client, function, *args, **kwargs)

    @asynccontextmanager
    async def upload(self) -> AsyncIterator[asyncio.Lock]:
        """Hold a place for an uploaded recording; see `ComputeQueue.upload`."""
        async with self._queue.upload(self._client) as turn:
            yield turn
