"""Who did what: every request that moves, writes or changes something is told to the audit, with its answer.

Rule of this file: a request that was refused (4xx) has done nothing and is not told; one that failed may have.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

from starlette.datastructures import Headers

from autotuner.runtime.ticker import utc_now
from autotuner.service.access import COMPUTING, LOCAL, SAFE_METHODS
from autotuner.store.kept import Deed

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from starlette.types import ASGIApp, Message, Receive, Scope, Send

    from autotuner.runtime.manager import Manager

REFUSED = range(400, 500)
TUNINGS = "/v1/tunings/"


class Audit:
    """ASGI middleware behind the gate, which tells who asks.

    Parameters
    ----------
    app : ASGIApp
        What lies behind.
    note : callable
        Takes what was done.
    manager : Manager
        Knows the loops of tunings and of runs.
    """

    def __init__(self, app: ASGIApp, note: Callable[[Deed], Awaitable[None]], manager: Manager) -> None:
        self._app = app
        self._note = note
        self._manager = manager

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, and tell of it before its answer is sent."""
        if scope["type"] != "http" or scope["method"] in SAFE_METHODS or COMPUTING.fullmatch(scope["path"]):
            await self._app(scope, receive, send)
            return

        async def telling(message: Message) -> None:
            if message["type"] == "http.response.start" and message["status"] not in REFUSED:
                await self._note(self._deed(scope, message))
            await send(message)

        await self._app(scope, receive, telling)

    def _deed(self, scope: Scope, answer: Message) -> Deed:
        actor, action = scope.get("actor", LOCAL), f"{scope['method']} {scope['path']}"
        location = Headers(raw=answer.get("headers", [])).get("location", "")
        loop, tuning_id = _subject(self._manager, scope.get("path_params", {}), location)
        return Deed(utc_now(), actor, action, answer["status"], loop, tuning_id)


def _subject(manager: Manager, named: Mapping[str, Any], location: str) -> tuple[str | None, str | None]:
    """Return the loop and the tuning that a path names, or whose start an answer tells."""
    tuning_id = named.get("tuning_id") or (unquote(location[len(TUNINGS) :]) if location.startswith(TUNINGS) else None)
    tuning = manager.tunings.get(tuning_id or "")
    loop = named.get("loop") or (tuning.loop if tuning else manager.schedules.loop_of(named.get("schedule_id")))
    return loop, tuning_id
