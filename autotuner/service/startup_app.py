"""The startup application: the process answers `/healthz` while the real application is still being loaded.

Invariants:

1. It imports no web framework: loading that, the database's library and NumPy takes longer than all else of a start.
2. It answers `/healthz` only, and only until the application has started; every other request waits for that.
3. An application that cannot be loaded or started ends the service: `fault` is why.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from autotuner.service.connections import Connections

if TYPE_CHECKING:
    from collections.abc import Callable

    from fastapi import FastAPI
    from starlette.types import Receive, Scope, Send

    from autotuner.service.connections import Connection

ALIVE = "/healthz"
BODY = b'{"status":"ok"}'
"""What the application answers there too."""
HEADERS = [
    (b"content-type", b"application/json"),
    (b"content-length", str(len(BODY)).encode()),
    (b"cache-control", b"no-store"),
    (b"x-content-type-options", b"nosniff"),
]


class StartupApp:
    """ASGI application in front of one that is loaded in a thread.

    Parameters
    ----------
    load : callable
        Imports and makes the application.
    connections : Connections, optional
        Those of the server.

    Attributes
    ----------
    fault : BaseException or None
        Why the application could not be loaded or started, or how it ended.
    """

    def __init__(self, load: Callable[[], FastAPI], connections: Connections | None = None) -> None:
        self.fault: BaseException | None = None
        self._connections = connections or Connections(0)
        self._load = load
        self._app: FastAPI | None = None
        self._known = asyncio.Event()

    async def application(self) -> FastAPI | None:
        """Return the application once it has started; None when it cannot."""
        await self._known.wait()
        return self._app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or let the application answer."""
        if scope["type"] == "lifespan":
            await self._live(receive, send)
            return
        with self._connections.request(scope.get("client")) as connection:
            await self._respond(scope, receive, send, connection)

    async def _respond(self, scope: Scope, receive: Receive, send: Send, connection: Connection | None) -> None:
        if self._app is None and scope["path"] == ALIVE and scope["method"] in {"GET", "HEAD"}:
            await _answer(send, 200, BODY if scope["method"] == "GET" else b"")
        elif (app := await self.application()) is not None:
            await app(scope, receive, self._connections.paced(send, connection))
        else:
            await _answer(send, 503, b"")

    async def _live(self, receive: Receive, send: Send) -> None:
        """Start the real application, and stop it when the server stops."""
        await receive()
        await send({"type": "lifespan.startup.complete"})
        try:
            app = await asyncio.to_thread(self._load)
            async with app.router.lifespan_context(app):
                self._app = app
                self._known.set()
                await receive()
        except Exception as error:  # noqa: BLE001 - raised again by the caller of the server
            self.fault = error
        finally:
            self._known.set()
        await send({"type": "lifespan.shutdown.complete"})


async def _answer(send: Send, status: int, body: bytes) -> None:
    await send({"type": "http.response.start", "status": status, "headers": HEADERS if status == 200 else []})
    await send({"type": "http.response.body", "body": body})
