"""The audit: every request that moves, writes or changes something is recorded, and so is every refused one.

Invariants:

1. A request that was carried out, or failed while it was, is always recorded.
2. Refused requests (failed logins included) are recorded as long as they are few; of many, some are, with the number of
   those that were left out: no client can fill the disk.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

from starlette.datastructures import Headers

from autotuner.control.clock.ticker import utc_now
from autotuner.service.archive.archive_record import Deed
from autotuner.service.security.access import COMPUTING, LOCAL, SAFE_METHODS
from autotuner.service.security.limits import Buckets, Thinning

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from starlette.types import ASGIApp, Message, Receive, Scope, Send

    from autotuner.application.manager import Manager

REFUSED = range(400, 500)
DENIED = frozenset({400, 401, 403, 408, 421, 429})
"""Status of requests that access control refused, whatever they were to do."""
TUNINGS = "/v1/tunings/"
OF_A_CLIENT = (1.0 / 30.0, 10.0)
"""Refused requests of one client that are recorded: per second, and at once."""
IN_ALL = (1.0, 100.0)
"""The same of all clients: at most some 25 MB a day, under attempts from thousands of addresses."""
LONGEST = 300
"""Longest path that is recorded in full, characters."""


class Audit:
    """ASGI middleware before the gate, which names the caller.

    Parameters
    ----------
    app : ASGIApp
        The gate and the application.
    note : callable
        Takes an entry.
    manager : Manager
        Knows the loops of tunings and of runs.
    """

    def __init__(self, app: ASGIApp, note: Callable[[Deed], Awaitable[None]], manager: Manager) -> None:
        self._app = app
        self._note = note
        self._manager = manager
        self._thinning = Thinning(Buckets(*OF_A_CLIENT), Buckets(*IN_ALL))

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, and record it before its answer is sent."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        reading = scope["method"] in SAFE_METHODS or bool(COMPUTING.fullmatch(scope["path"]))

        async def recording(message: Message) -> None:
            if message["type"] == "http.response.start":
                await self._record(scope, message, reading=reading)
            await send(message)

        await self._app(scope, receive, recording)

    async def _record(self, scope: Scope, answer: Message, *, reading: bool) -> None:
        if answer["status"] in REFUSED:
            if not reading or answer["status"] in DENIED:
                await self._record_refusal(scope, answer)
        elif not reading:
            await self._note(self._entry(scope, answer))

    async def _record_refusal(self, scope: Scope, answer: Message) -> None:
        client = scope.get("client_key", "")
        left_out = self._thinning.recorded(client, asyncio.get_running_loop().time())
        if left_out is not None:
            await self._note(self._entry(scope, answer, f" ({left_out} refused before)" if left_out else ""))

    def _entry(self, scope: Scope, answer: Message, addition: str = "") -> Deed:
        actor, action = scope.get("actor", LOCAL), f"{scope['method']} {scope['path'][:LONGEST]}{addition}"
        location = Headers(raw=answer.get("headers", [])).get("location", "")
        loop, tuning_id = _subject(self._manager, scope.get("path_params", {}), location)
        return Deed(utc_now(), actor, action, answer["status"], loop, tuning_id)


def _subject(manager: Manager, named: Mapping[str, Any], location: str) -> tuple[str | None, str | None]:
    """Return the loop and the tuning of a path, or those of a reported start."""
    tuning_id = named.get("tuning_id") or (unquote(location[len(TUNINGS) :]) if location.startswith(TUNINGS) else None)
    tuning = manager.tunings.get(tuning_id or "")
    loop = named.get("loop") or (tuning.loop if tuning else manager.schedules.loop_of(named.get("schedule_id")))
    return loop, tuning_id
