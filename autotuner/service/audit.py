"""Who did what: every request that moves, writes or changes something is told to the audit, with its answer.

Rule of this file: a request that was refused (4xx) has done nothing and is not told; one that failed may have.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.service.access import COMPUTING, LOCAL, SAFE_METHODS

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from starlette.types import ASGIApp, Message, Receive, Scope, Send

REFUSED = range(400, 500)


class Audit:
    """ASGI middleware behind the gate, which tells who asks.

    Parameters
    ----------
    app : ASGIApp
        What lies behind.
    note : callable
        Takes actor, action and status.
    """

    def __init__(self, app: ASGIApp, note: Callable[[str, str, int], Awaitable[None]]) -> None:
        self._app = app
        self._note = note

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, and tell of it before its answer is sent."""
        if scope["type"] != "http" or scope["method"] in SAFE_METHODS or COMPUTING.fullmatch(scope["path"]):
            await self._app(scope, receive, send)
            return
        action = f"{scope['method']} {scope['path']}"

        async def telling(message: Message) -> None:
            if message["type"] == "http.response.start" and message["status"] not in REFUSED:
                await self._note(scope.get("actor", LOCAL), action, message["status"])
            await send(message)

        await self._app(scope, receive, telling)
