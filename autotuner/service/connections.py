"""Connections of the service, limited in number and in waiting time.

Invariants:

1. No more sockets are accepted than `Connections.limit`, which is below the file limit of the process: a flood of
   connections takes no file from a device, the journal or the database.
2. A connection without a complete request is closed after `REQUEST_LIMIT_S`, or earlier when a new one needs its place:
   that of the address with most of them, the oldest first. So a request to abort is always accepted.
3. A client that does not read its answer is disconnected after `ANSWER_LIMIT_S`.
4. Of the refusals for too many requests, one is sent every `REFUSAL_INTERVAL_S`: a flood whose clients wait for their
   answers then costs little time. Meanwhile such a connection is closed as one without a request would be.
5. A socket is identified by the address of its client, which the request has too: no internals of the server are used.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import socket
import sys
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if sys.platform != "win32":
    import resource

if TYPE_CHECKING:
    from collections.abc import Iterator

    from starlette.types import ASGIApp, Message, Receive, Scope, Send

REQUEST_LIMIT_S = 10.0
"""Longest time without a complete request head: after connecting, or after the previous answer, s."""
ANSWER_LIMIT_S = 30.0
"""Longest time for which a client may leave an answer unread, s."""
REFUSAL_INTERVAL_S = 0.02
"""Shortest time between two answers that a client sends too many requests, s."""
REFUSALS = frozenset({429, 503})
"""Statuses of those answers."""
RESERVED = 1792
"""Connections in addition to the concurrent requests: for aborts, for health checks, and for new ones.

So many that a flood of a thousand waits on its connections: where these are too few, each that gives way comes again at
once, which costs more than all else."""
OTHER_FILES = 256
"""Files that the process needs for all else: devices, journals, the database, pipes of other processes."""
FEWEST = 32
"""Connections below which a service is of no use."""
ROOM_SHARE = 0.1
"""Share of all connections that are closed together when there is no place for a new one, to make a flood cheap."""
ACCEPTED_AT_ONCE = 16
"""Connections accepted in a row before those that are open have their turn: their requests arrive meanwhile."""

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class Connection:
    """An accepted connection.

    Attributes
    ----------
    socket : socket.socket
        The server's end.
    host : str
        Address of the client.
    since_s : float
        When it was accepted, or its last answer ended, s on the clock of the event loop.
    requests : int
        Concurrent requests.
    """

    socket: socket.socket
    host: str
    since_s: float
    requests: int = 0

    @property
    def closed(self) -> bool:
        """Whether the server has closed it."""
        return self.socket.fileno() < 0

    @contextlib.contextmanager
    def idle(self) -> Iterator[None]:
        """Let it count as one without a request."""
        self.requests -= 1
        try:
            yield
        finally:
            self.requests += 1

    def cut(self) -> None:
        """End it; the server then sees its end, and closes it."""
        with contextlib.suppress(OSError):  # the client was faster
            self.socket.shutdown(socket.SHUT_RDWR)


class Connections:
    """The accepted connections of one listener.

    Parameters
    ----------
    limit : int
        Most connections.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self._open: dict[tuple[str, int], Connection] = {}
        self._refused_s = -math.inf
        self._ending = asyncio.Event()

    def admit(self, accepted: socket.socket, address: tuple[Any, ...], now_s: float) -> bool:
        """Register a connection; return whether there is a place for it."""
        if len(self._open) >= self.limit:
            self._forget_closed()
        if len(self._open) >= self.limit and not self._make_room():
            return False
        self._open[address[:2]] = Connection(accepted, address[0], now_s)
        return True

    @contextlib.contextmanager
    def request(self, client: tuple[str, int] | None) -> Iterator[Connection | None]:
        """Mark a request of a client as running."""
        connection = self._open.get(client) if client else None
        if connection is None:
            yield None
            return
        connection.requests += 1
        try:
            yield connection
        finally:
            connection.requests -= 1
            connection.since_s = asyncio.get_running_loop().time()

    def end(self) -> None:
        """Send delayed answers: the server ends, and waits for them."""
        self._ending.set()

    def refusal_delay_s(self, now_s: float) -> float:
        """Return how long a refusal waits for its turn, s."""
        self._refused_s = max(self._refused_s + REFUSAL_INTERVAL_S, now_s)
        return self._refused_s - now_s

    def cut_idle(self, now_s: float) -> None:
        """End the connections that have waited for a request too long."""
        self._forget_closed()
        for connection in self._open.values():
            if not connection.requests and now_s - connection.since_s > REQUEST_LIMIT_S:
                connection.cut()

    def paced(self, send: Send, connection: Connection | None) -> Send:
        """Return `send` that delays refusals, and ends the connection of a client that does not read its answer."""
        if connection is None:
            return send

        async def sending(message: Message) -> None:
            if message.get("status") in REFUSALS:
                with connection.idle(), contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(self.refusal_delay_s(asyncio.get_running_loop().time())):
                        await self._ending.wait()
            try:
                async with asyncio.timeout(ANSWER_LIMIT_S):
                    await send(message)
            except TimeoutError:
                connection.cut()

        return sending

    def _forget_closed(self) -> None:
        self._open = {address: one for address, one in self._open.items() if not one.closed}

    def _make_room(self) -> bool:
        """End some connections without a request; return whether there was one."""
        idle = [(address, one) for address, one in self._open.items() if not one.requests]
        of_a_host = Counter(one.host for _, one in idle)
        idle.sort(key=lambda pair: (-of_a_host[pair[1].host], pair[1].since_s))
        for address, victim in idle[: max(1, round(ROOM_SHARE * self.limit))]:
            victim.cut()
            del self._open[address]
        return bool(idle)


class ConnectionMiddleware:
    """ASGI middleware that notes each request at its connection, and paces its answer.

    Parameters
    ----------
    app : ASGI application
        What answers.
    connections : Connections
        Those of the server.
    """

    def __init__(self, app: ASGIApp, connections: Connections) -> None:
        self._app, self._connections = app, connections

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let the application answer."""
        with self._connections.request(scope.get("client")) as connection:
            await self._app(scope, receive, self._connections.paced(send, connection))


class Listener(socket.socket):
    """A listening socket that accepts connections only as long as there are places.

    Parameters
    ----------
    listening : socket.socket
        The socket; this one takes it over.
    connections : Connections
        The places.
    """

    def __init__(self, listening: socket.socket, connections: Connections) -> None:
        super().__init__(listening.family, listening.type, listening.proto, fileno=listening.detach())
        self._connections = connections
        self._in_a_row = 0

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept a connection; `BlockingIOError` means none, and the event loop continues with other sockets.

        Raises
        ------
        BlockingIOError
            No connection waits, or others are to be served first.
        ConnectionAbortedError
            There was no place for it.
        """
        if self._in_a_row == ACCEPTED_AT_ONCE:
            self._in_a_row = 0
            raise BlockingIOError
        try:
            accepted, address = super().accept()
        except OSError:
            self._in_a_row = 0
            raise
        self._in_a_row += 1
        if not self._connections.admit(accepted, address, asyncio.get_running_loop().time()):
            accepted.close()
            raise ConnectionAbortedError
        return accepted, address


def connections_for(requests: int) -> Connections:
    """Return the connections of a service with a limit of concurrent requests.

    The file limit of the process is raised as far as the system lets it; where that is not far enough, there are fewer
    connections, and the log reports that.
    """
    wanted = requests + RESERVED
    if sys.platform == "win32":  # where files are not limited like this
        return Connections(wanted)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = wanted + OTHER_FILES
    if soft != resource.RLIM_INFINITY and soft < needed:
        reached = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (reached, hard))
            soft = reached
    if soft == resource.RLIM_INFINITY or soft >= needed:
        return Connections(wanted)
    limit = max(soft - OTHER_FILES, FEWEST)
    _log.warning("%d connections at most, not %d: the system lets this process open %d files", limit, wanted, soft)
    return Connections(limit)
